"""Result of a drift check for cameras, points and lasers, the limits that decide on its verdict, and its history."""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.excess_residual import Change
from geometry.arrays import Array
from lab.errors import InputError
from lab.files.text.csv_text import read_table, write_table
from lab.files.text.error_text import printable_line
from lab.findings.finding import Level, level_above


@dataclass(frozen=True, slots=True)
class DriftLimits:
    """Limits and assumptions of a drift check."""

    p_false_alarm: float = 0.002  # probability per check of a false alarm: once in two years of working days
    warn_mm: float = 0.2  # mm at the screen, RMS: the error of a good spot; smaller drifts are lost in its noise
    fail_mm: float = 0.5  # mm at the screen: at 2.5 m from the vehicle 0.011 deg, more than the goal of 0.01 deg
    weak_mm: float = 2.0  # mm: a check that can miss such a shift (0.05 deg at 2.5 m) is too weak to confirm anything
    fail_px: float = 1.0  # px, if there is no value in mm because the camera's rays miss its screen
    point_sigma_px: float = 0.1  # px, of a known point without a stated sigma: a mark of some 10 px, centre fitted
    floor_px: float = 0.02  # px, of a mean spot: pixel locking and speckle do not average out while the vehicle rests
    still_px: float = 0.3  # px: largest motion of a spot in a static run; beyond it the vehicle moves
    pose_sigma_m: float = 5e-5  # m, of each coordinate of a stand's known pose: a good mechanical seat
    pose_sigma_deg: float = 0.003  # deg, about each axis: 11 arcsec, a good turntable
    power: float = 0.9  # probability with which a drift of the "detectable" size is found
    expiry_warning_days: int = 14  # days before the expiry date from which the check warns

    def __post_init__(self) -> None:
        for name in ("p_false_alarm", "power"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"{name}: expected a number between 0 and 1, got {getattr(self, name):g}")
        for name in (
            "warn_mm",
            "weak_mm",
            "fail_px",
            "point_sigma_px",
            "floor_px",
            "still_px",
            "pose_sigma_m",
            "pose_sigma_deg",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a number above 0, got {getattr(self, name):g}")
        if not self.fail_mm >= self.warn_mm:
            raise ValueError(f"fail_mm: expected at least warn_mm ({self.warn_mm:g}), got {self.fail_mm:g}")


@dataclass(frozen=True, slots=True)
class OtherChange:
    """A wrong point or a moved laser."""

    change: Change
    px: float  # RMS displacement of its pixels
    mm: float  # the same at the screen


@dataclass(frozen=True, slots=True)
class CameraDrift:
    """Result of a check for one camera with n points."""

    camera: str
    pixels: Array  # (n, 2)
    residual_px: Array  # (n, 2) measured minus predicted
    explained_px: Array  # (n, 2) part of the residual due to the camera's own change; 0 if it has none
    drift_px: float  # RMS of the fitted drift over the points
    noise_px: float  # expected RMS of the fitted drift without any change
    drift_mm: float  # at the camera's screen; nan if its rays miss it
    shift_px: Array  # (2,) mean of the fitted drift
    sigma_shift_px: Array  # (2,)
    turn_deg: Array  # (3,) rotation of the scene about the camera's x, y, z
    sigma_turn_deg: Array  # (3,)
    scale_ppm: float  # change of the focal length
    sigma_scale_ppm: float
    p_value: float  # probability of a drift of this size without any change
    detectable_px: float  # common shift that the check finds with probability DriftLimits.power
    detectable_mm: float
    change: Change | None  # the explanation of the residuals; None if nothing is significant
    unexplained_px: float  # RMS of the residuals that no explanation removes; nan if not significant
    unexplained_mm: float
    level: Level


@dataclass(frozen=True, slots=True)
class DriftResult:
    """Result of a drift check."""

    cameras: tuple[CameraDrift, ...]
    others: tuple[OtherChange, ...]  # wrong points and moved lasers
    unchecked: tuple[str, ...]  # cameras of the rig without measurements


def is_weak(detectable_mm: float, limits: DriftLimits) -> bool:
    """Whether a check can miss so large a drift that a result without drift does not confirm the calibration."""
    return not detectable_mm <= limits.weak_mm  # nan counts as weak


def level_of(px: float, mm: float, limits: DriftLimits) -> Level:
    """Verdict on a significant change of this size, by its mm at the screen, else (mm is nan) by its pixels."""
    if np.isfinite(mm):
        return level_above(mm, limits.warn_mm, limits.fail_mm)
    return Level.FAIL if px > limits.fail_px else Level.WARN


# Drift history: a CSV with one row per camera and check, which shows a slow drift before it exceeds a limit.


HISTORY_COLUMNS = ("date", "camera", "drift_px", "noise_px", "drift_mm", "verdict")


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
        table = read_table(path, HISTORY_COLUMNS)
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
    write_table(Path(path), HISTORY_COLUMNS, table)
