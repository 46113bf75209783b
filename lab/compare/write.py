"""One comparison from folders and files to an output folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lab.compare.compare import compare
from lab.compare.findings import lines_of
from lab.compare.page import write_page
from lab.compare.tables import SUMMARY, write_tables
from lab.files.text.atomic_write import atomic_folder, check_output_folder


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the command prints, and where the report is."""

    lines: tuple[str, ...]
    report: Path | None  # None without an output folder


def compare_and_write(
    result: Path,
    other: Path | None,
    reference: Path | None,
    out: Path | None,
    *,
    align: Sequence[str] | None = None,
    offset_s: float | None = None,
    sigma_m: float = 0.0,
    sigma_deg: float = 0.0,
) -> Outcome:
    """Compare, and write tables and report where `out` is given. The other arguments: `lab.compare.compare.compare`.

    Raises:
        InputError: the input cannot be compared, or `out` cannot be written.
    """
    if out is not None:
        check_output_folder(out, _is_comparison)
    found = compare(result, other, reference, align=align, offset_s=offset_s, sigma_m=sigma_m, sigma_deg=sigma_deg)
    lines = tuple(lines_of(found))
    if out is None:
        return Outcome(lines, None)
    with atomic_folder(out, _is_comparison) as folder:
        write_tables(found, folder)
        write_page(found, folder)
    return Outcome(lines, out / "report.html")


def _is_comparison(folder: Path) -> bool:
    return (folder / SUMMARY).is_file()
