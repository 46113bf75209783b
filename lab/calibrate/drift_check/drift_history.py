"""Drift history: a CSV with one row per camera and check, which shows a slow drift before it exceeds a limit."""

from __future__ import annotations

import csv
import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from calibration.findings import Level
from lab.errors import InputError
from lab.files.text.csv_text import shown_line
from lab.files.text.yaml_text import atomic_write_text
from lab.runs.tables import csv_word

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
        lines = list(csv.reader(path.read_text(encoding="utf-8").splitlines()))
    except UnicodeDecodeError:
        raise InputError(
            f"{path}: expected a history, got a file that is not text in UTF-8; name another --history"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}; name another --history") from None
    if not lines or tuple(lines[0]) != COLUMNS:
        found = shown_line(",".join(lines[0])[:80]) if lines else "an empty file"
        raise InputError(f"{path}: expected columns {','.join(COLUMNS)}, got {found}; name another --history")
    rows = []
    for number, fields in enumerate(lines[1:], 2):
        try:
            day, camera, px, noise, mm, word = fields
            row = HistoryRow(
                datetime.date.fromisoformat(day), camera, _float(px), _float(noise), _float(mm), Level[word]
            )
        except (ValueError, KeyError):
            raise InputError(
                f"{path}: line {number}: expected {','.join(COLUMNS)}, got {shown_line(','.join(fields)[:80])};"
                " correct or delete the line"
            ) from None
        rows.append(row)
    return rows


def _float(text: str) -> float:
    return float(text) if text else math.nan


def write_history(rows: Sequence[HistoryRow], path: Path) -> None:
    """Write all rows atomically: an interrupted check leaves the history unchanged."""
    lines = [",".join(COLUMNS)]
    for r in rows:
        numbers = ["" if math.isnan(v) else f"{v:.6g}" for v in (r.drift_px, r.noise_px, r.drift_mm)]
        lines.append(",".join([r.date.isoformat(), csv_word(r.camera), *numbers, r.verdict.name]))
    atomic_write_text("\n".join(lines) + "\n", Path(path))
