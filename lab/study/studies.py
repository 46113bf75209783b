"""Repetitions of published experiments, written as tables and pages."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lab.files.text.atomic_write import atomic_folder
from lab.files.text.csv_text import write_table
from lab.study.experiment_huo2015 import repeat_huo2015
from lab.study.study_page import write_study

COLUMNS = ("quantity", "unit", "paper", "conventional", "curve_switching", "beampose", "note")


@dataclass(frozen=True, slots=True)
class StudyOutcome:
    """The files written, and the lines printed."""

    lines: tuple[str, ...]
    table: Path
    report: Path


def study_huo2015(out: Path, seed: int = 1, frames: int = 600) -> StudyOutcome:
    """Repeat section 5.1 of Huo (2015); write figures.csv and report.html into the folder `out`.

    Raises:
        InputError: `out` contains other files.
    """
    study = repeat_huo2015(seed, frames)
    with atomic_folder(out, may_replace=lambda folder: (folder / "figures.csv").is_file()) as work:
        values = [[getattr(row, name) for name in COLUMNS] for row in study.rows]
        rows = [["" if v is None else f"{v:.6g}" if isinstance(v, float) else v for v in row] for row in values]
        write_table(work / "figures.csv", COLUMNS, rows)
        write_study(study, work)
    lines = tuple(
        f"{row.quantity} ({row.unit}): paper {_shown(row.paper)}, conventional {_shown(row.conventional)},"
        f" curve switching {_shown(row.curve_switching)}, beampose {_shown(row.beampose)}"
        for row in study.rows
    )
    return StudyOutcome(lines, Path(out) / "figures.csv", Path(out) / "report.html")


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
