"""Drift history: a CSV with one row per camera and check, which shows a slow drift before it exceeds a limit."""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lab.errors import InputError
from lab.files.text.csv_text import read_table, write_table
from lab.files.text.error_text import printable_line
from lab.findings.finding import Level

COLUMNS = ("date", "camera", "drift_px", "noise_px", "drift_mm", "verdict")


@dataclass(frozen=True, slots=True)
class HistoryRow:
    """Drift of one camera in one check."""

    date: datetime.date
    camera: str
    drift_px: float
    noise_px: float
    drift_mm: float
    verdict: Level


def read_history(path: Path) -> list[HistoryRow]:
    """Rows of earlier checks; none if the file does not exist.

    Raises:
        InputError: for a file that is not a drift history.
    """
    path = Path(path)
    if not path.exists():
        return []
    try:
        table = read_table(path, COLUMNS)
        table.refuse_long_lines()
    except InputError as error:
        raise InputError(f"{error}; name another --history") from None
    dates, cameras, verdicts = (table.words[c].tolist() for c in ("date", "camera", "verdict"))
    drift, noise, drift_mm = (table.optional(c).tolist() for c in ("drift_px", "noise_px", "drift_mm"))
    rows = []
    for i, (date, verdict) in enumerate(zip(dates, verdicts, strict=True)):
        try:
            day, level = datetime.date.fromisoformat(date), Level[verdict]
        except (ValueError, KeyError):
            raise table.error(
                i,
                f"expected a date and a verdict, got {printable_line(f'{date}, {verdict}')}; correct or delete the row",
            ) from None
        rows.append(HistoryRow(day, cameras[i], drift[i], noise[i], drift_mm[i], level))
    return rows


def write_history(rows: Sequence[HistoryRow], path: Path) -> None:
    """Write all rows atomically: an interrupted check leaves the history unchanged."""
    table: list[list[object]] = []
    for r in rows:
        numbers = ["" if math.isnan(v) else f"{v:.6g}" for v in (r.drift_px, r.noise_px, r.drift_mm)]
        table.append([r.date.isoformat(), r.camera, *numbers, r.verdict.name])
    write_table(Path(path), COLUMNS, table)
