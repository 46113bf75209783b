"""One run of a batch as the index shows it: its row of batch.csv, and what its result folder adds.

A result folder may be missing, damaged or of an older version: what cannot be read is left empty.
"""

from __future__ import annotations

import datetime
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from geometry.arrays import Array
from lab.errors import BeamposeError
from lab.files.run.results import read_result_table, read_summary
from lab.files.text.yaml_text import read_mapping
from lab.report.run.summary import VERDICTS, day_of, valid
from tracking.statuses import PoseStatus

NAME = ("name", "run", "run_folder")  # keys of a row, in order of preference
FOLDER = NAME[1:]
VERDICT = ("verdict", "status")
LINK = ("report", "results")
_RANKS = {"error": 0, "fail": 1, "check": 2, "pass": 3}
_ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
_POSITION = ("x_m", "y_m", "z_m")
_SIGMAS = ("sigma_yaw_deg", "sigma_pitch_deg", "sigma_roll_deg", "sigma_x_m", "sigma_y_m", "sigma_z_m")
_NONE = np.zeros((0, 3))


@dataclass(frozen=True, slots=True)
class IndexedRun:
    """A run of a batch. Numbers are None where they are not known."""

    row: Mapping[str, Any]  # of batch.csv
    name: str
    folder: str  # the run folder, as the row gives it
    href: str  # of the report, relative to the index; empty: there is none of this run
    status: str
    frames: int | None
    measured_share: float | None
    rms_px: float | None  # median over the measured frames
    sigma_attitude_deg: float | None  # median over the measured frames of the largest of the three sigmas
    sigma_position_m: float | None
    mean_residual_px: float | None  # length of the mean residual of a camera, the largest of all cameras
    recorded: datetime.date | None
    calibrated: datetime.date | None
    angles_deg: Array  # (F, 3) yaw, pitch, roll without jumps of 360 degrees; nan where lost; F = 0: not known
    position_m: Array  # (F, 3)

    @property
    def word(self) -> str:
        """The verdict as the index shows it."""
        return VERDICTS[self.status][0] if self.status in VERDICTS else self.status.upper()

    @property
    def rank(self) -> int:
        """0 for the worst verdict."""
        return _RANKS.get(self.status, 0)

    @property
    def calibration_age(self) -> int | None:
        """Days from the calibration to the recording."""
        return None if self.recorded is None or self.calibrated is None else (self.recorded - self.calibrated).days

    @property
    def badness(self) -> tuple[int, float, float, str]:
        """Sorts runs, the worst first: by verdict, by the share measured, by the residuals, by name."""
        share = -1.0 if self.measured_share is None else self.measured_share
        return self.rank, share, -(self.rms_px or 0.0), self.name


def indexed_run(row: Mapping[str, Any], out: Path) -> IndexedRun:
    """A row of batch.csv, with what its result folder below `out` adds."""
    status = first_of(row, VERDICT).lower() or "error"
    report = _report(row, out)
    folder = None if report is None else (out / report).parent
    summary = {} if folder is None else _summary(folder)
    if status == "error" and str(_at(summary, "verdict", "status")).lower() in VERDICTS:
        report, folder, summary = None, None, {}  # the folder has the results of an earlier, successful processing
    angles, position, medians = _poses(folder)
    frames = valid(int, row.get("frames"))
    share = _number(row.get("measured_share"))
    return IndexedRun(
        row=row,
        name=first_of(row, NAME) or "unnamed",
        folder=first_of(row, FOLDER),
        href="" if report is None or not (out / report).is_file() else _address(report),
        status=status,
        frames=frames if frames is not None else valid(int, _at(summary, "counts", "frames")),
        measured_share=share if share is not None else _number(_at(summary, "rates", "measured_share")),
        rms_px=medians[0],
        sigma_attitude_deg=medians[1],
        sigma_position_m=medians[2],
        mean_residual_px=_mean_residual(summary),
        recorded=_recorded(row, summary),
        calibrated=day_of(_at(summary, "calibration", "date")),
        angles_deg=angles,
        position_m=position,
    )


def first_of(row: Mapping[str, Any], keys: tuple[str, ...]) -> str:
    """The first value that is not empty, as text."""
    return next((str(row[k]) for k in keys if row.get(k) not in (None, "")), "")


def _report(row: Mapping[str, Any], out: Path) -> Path | None:
    """The report that a row names, relative to `out` if it is in it. An error's row has one only if it names it."""
    named = first_of(row, LINK)
    if not named and (first_of(row, VERDICT).lower() or "error") != "error":
        named = first_of(row, NAME)
    if not named:
        return None
    path = Path(named) if named.endswith(".html") else Path(named) / "report.html"
    if path.is_absolute() and path.is_relative_to(out.resolve()):
        path = path.relative_to(out.resolve())
    return path


def _address(report: Path) -> str:
    return report.as_uri() if report.is_absolute() else "./" + quote(os.fsencode(report.as_posix()))


def _summary(folder: Path) -> Mapping[str, Any]:
    try:
        return read_summary(folder)
    except (BeamposeError, OSError, RecursionError):
        return {}


def _at(tree: object, *keys: str) -> Any:
    """The value at nested keys; None where there is none."""
    for key in keys:
        tree = tree.get(key) if isinstance(tree, Mapping) else None
    return tree


def _number(value: object) -> float | None:
    number = None if isinstance(value, bool) else valid(float, value)
    return number if number is not None and np.isfinite(number) else None


def _recorded(row: Mapping[str, Any], summary: Mapping[str, Any]) -> datetime.date | None:
    """The day of the recording, from summary.json or else from the run.yaml that can be reached."""
    if stated := day_of(summary.get("recorded")):
        return stated
    for folder in (first_of(row, FOLDER), valid(str, summary.get("run_folder"))):
        path = Path(folder or "") / "run.yaml"
        try:
            if folder and path.is_file() and (stated := day_of(read_mapping(path).get("recorded"))):
                return stated
        except (BeamposeError, OSError, ValueError):
            continue
    return None


def _mean_residual(summary: Mapping[str, Any]) -> float | None:
    """px: the camera whose residuals have the largest mean; it grows when a camera or a screen has moved."""
    groups = _at(summary, "model_check", "cameras")
    means = [valid(list[float], _at(group, "mean_px")) for group in groups] if isinstance(groups, list) else []
    lengths = [math.hypot(*mean) for mean in means if mean is not None]
    return max((length for length in lengths if math.isfinite(length)), default=None)


def _poses(folder: Path | None) -> tuple[Array, Array, tuple[float | None, float | None, float | None]]:
    """Angles (F, 3), deg, position (F, 3), m, and the medians of the measured frames: rms, sigma deg, sigma m."""
    nothing = _NONE, _NONE, (None, None, None)
    if folder is None:
        return nothing
    try:
        table = read_result_table(folder / "attitude.csv", (*_ANGLES, *_POSITION, *_SIGMAS, "rms_px", "status"))
    except (BeamposeError, OSError):
        return nothing
    measured = table.words["status"].recoded((PoseStatus.MEASURED,)) == 0
    sigmas = table.stack(*_SIGMAS)[measured]
    medians = (
        _median(table.numbers["rms_px"][measured]),
        _median(sigmas[:, :3].max(axis=1)),
        _median(sigmas[:, 3:].max(axis=1)),
    )
    return _without_jumps(table.stack(*_ANGLES)), table.stack(*_POSITION), medians


def _median(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else None


def _without_jumps(angles_deg: Array) -> Array:
    out = np.where(np.isfinite(angles_deg), angles_deg, np.nan)
    for k in range(out.shape[1]):
        known = np.isfinite(out[:, k])
        out[known, k] = np.unwrap(out[known, k], period=360.0)
    return out
