"""The CSV tables of a run, written row by row as the records come."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TextIO

import numpy as np

from geometry.arrays import Array
from geometry.pose import Pose, ypr_sigmas
from geometry.rig import Rig
from geometry.spots import SpotModel
from lab import columns
from lab.columns import CAUSAL
from lab.errors import RunError
from lab.pipeline import FrameRecord
from tracking.tracked_frame import MotionEstimate

_UPPER = np.triu_indices(6)
_FILES = {
    "detections.csv": columns.DETECTIONS,
    "spots.csv": columns.SPOTS,
    "beams.csv": columns.BEAMS,
    "attitude.csv": columns.ATTITUDE,
    "covariance.csv": columns.COVARIANCE,
}


class TableWriter:
    """Writes all tables of one run into an existing folder. Use it as a context.

    with_systematic: also systematic.csv, the part of covariance.csv that the calibration's errors make. with_causal:
    also attitude_causal.csv and covariance_causal.csv, the poses as the causal filter had them.
    """

    def __init__(self, folder: Path, rig: Rig, with_systematic: bool = False, with_causal: bool = False) -> None:
        self._folder = folder
        self._rig = rig
        self._model = SpotModel.of(rig)
        self._cameras = [csv_word(c) for c in rig.cameras]
        self._views = [(csv_word(c), csv_word(s)) for c, s in self._model.views]
        self._beams = [csv_word(b) for b in rig.beams]
        self._directions = np.array([b.direction for b in rig.beams.values()])
        self._points = np.array([b.point for b in rig.beams.values()])
        self._files = dict(_FILES)
        if with_systematic:
            self._files["systematic.csv"] = columns.COVARIANCE
        if with_causal:
            self._files |= {f"{name}{CAUSAL}.csv": _FILES[f"{name}.csv"] for name in ("attitude", "covariance")}
        self._open: dict[str, TextIO] = {}

    def __enter__(self) -> TableWriter:
        for name, header in self._files.items():
            self._open[name] = (self._folder / name).open("w", encoding="utf-8", newline="")
            self._open[name].write(",".join(header) + "\n")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for file in self._open.values():
            file.close()

    def write(self, record: FrameRecord, causal: FrameRecord | None = None) -> None:
        """The rows of one frame. causal: the same frame as the causal filter had it, where its tables are wanted."""
        self._detections(record)
        self._spots(record)
        self._pose(record)
        self._beam_rows(record)
        if causal is not None:
            self._pose(causal, CAUSAL)

    def _detections(self, record: FrameRecord) -> None:
        rows = []
        for camera, found in zip(self._cameras, record.detections, strict=True):
            if found is None:
                continue
            sigma = _sigmas(np.stack([found.cov_px2[:, 0, 0], found.cov_px2[:, 1, 1]], axis=-1), record.frame)
            for i in range(len(found)):
                values = (
                    *found.uv_px[i], *sigma[i], found.flux[i], found.peak[i], found.major_px[i], found.minor_px[i],
                    found.angle_deg[i], found.cov_px2[i, 0, 1],
                )  # fmt: skip
                rows.append(f"{record.frame},{camera},{_joined(values)}\n")
        self._open["detections.csv"].writelines(rows)

    def _spots(self, record: FrameRecord) -> None:
        t = record.tracked
        sigma = _sigmas(np.stack([t.cov_px2[:, 0, 0], t.cov_px2[:, 1, 1]], axis=-1), record.frame)
        numbers = np.column_stack([t.uv_px, sigma])
        probability = np.full(len(t.gain), np.nan) if t.label_probability is None else t.label_probability
        after = np.column_stack([t.predicted_px, t.gain, t.cov_px2[:, 0, 1], probability])
        time = _number(record.t_s)
        self._open["spots.csv"].writelines(
            f"{record.frame},{time},{camera},{spot},{_joined(numbers[i])},{t.status[i].value},{_joined(after[i])}\n"
            for i, (camera, spot) in enumerate(self._views)
        )

    def _pose(self, record: FrameRecord, which: str = "") -> None:
        """The rows of attitude and covariance; `which` is CAUSAL or nothing."""
        t, attitude = record.tracked, self._open[f"attitude{which}.csv"]
        head, status = f"{record.frame},{_number(record.t_s)}", t.pose_status.value
        if t.pose is None or t.pose_covariance is None:
            nothing, no_motion = "," * len(columns.POSE), "," * len(columns.MOTION)
            attitude.write(f"{head}{nothing},{t.spots_used},,{status}{no_motion}\n")
            return
        for covariance in (t.pose_covariance, *([] if t.motion is None else [t.motion.covariance])):
            _sigmas(np.diagonal(covariance), record.frame)
        attitude.write(
            f"{head},{_joined(pose_numbers(t.pose, t.pose_covariance))},{t.spots_used},{_number(t.rms_px)},{status},"
            f"{_joined(motion_numbers(t.motion))}\n"
        )
        self._open[f"covariance{which}.csv"].write(f"{record.frame},{_exact(t.pose_covariance[_UPPER])}\n")
        if not which and "systematic.csv" in self._open and t.pose_systematic is not None:
            self._open["systematic.csv"].write(f"{record.frame},{_exact(t.pose_systematic[_UPPER])}\n")

    def _beam_rows(self, record: FrameRecord) -> None:
        t, head = record.tracked, f"{record.frame},{_number(record.t_s)}"
        status = t.pose_status.value
        if t.pose is None:
            self._open["beams.csv"].writelines(f"{head},{b},,,,,,,{status}\n" for b in self._beams)
            return
        direction, point = t.pose.turn(self._directions), t.pose.apply(self._points)
        self._open["beams.csv"].writelines(
            f"{head},{b},{_joined(direction[i])},{_joined(point[i])},{status}\n" for i, b in enumerate(self._beams)
        )


def _sigmas(variances: Array, frame: int) -> Array:
    """Square roots; nan for nan. A negative variance is an error of the program: lab.frame_checks comes before."""
    if np.any(variances < 0):
        raise RunError(f"frame {frame}: internal error: a variance is negative; please report this run")
    return np.asarray(np.sqrt(variances))


def pose_numbers(pose: Pose, covariance: Array) -> Array:
    """The 16 numbers of attitude.csv from x_m to sigma_roll_deg."""
    return np.concatenate(
        [
            pose.translation,
            pose.quaternion_wxyz,
            np.rad2deg(pose.ypr),
            np.sqrt(np.diagonal(covariance)[:3]),
            np.rad2deg(ypr_sigmas(pose, covariance)),
        ]
    )


def motion_numbers(motion: MotionEstimate | None) -> Array:
    """The 12 numbers of attitude.csv from velocity_x_m_s to the end; nan where the motion is not known."""
    if motion is None:
        return np.full(len(columns.MOTION), np.nan)
    return np.concatenate([motion.velocity, motion.rate, np.sqrt(np.diagonal(motion.covariance))])


def _joined(values: Sequence[float] | Array) -> str:
    return ",".join(map(_number, values))


def _exact(values: Array) -> str:
    """As many digits as give the same number when read: rounded to ten, a covariance whose axes differ by 1e5 in size
    may come back with a negative variance along one of them.
    """
    return ",".join(map(repr, values.tolist()))


def _number(value: float) -> str:
    """Ten significant digits, which is beyond any measurement here; nothing for nan."""
    return "" if value != value else f"{value:.10g}"


def csv_word(text: str) -> str:
    """A name as a CSV field, quoted where it holds a comma, a quote or a line break."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n\r') else text
