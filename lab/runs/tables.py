"""The CSV tables of a run, written as the records arrive."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, TextIO

import numpy as np

from geometry.arrays import Array
from geometry.forward_model import SpotModel
from geometry.pose import Pose, ypr_sigmas
from geometry.rig import Rig
from lab.errors import RunError
from lab.files.text import columns
from lab.files.text.columns import CAUSAL
from lab.files.text.csv_text import csv_word
from tracking.detections import Detections

if TYPE_CHECKING:
    from lab.runs.frames.pipeline import FrameRecord

_UPPER = np.triu_indices(6)
_BLOCK = 64  # frames converted at once: one by one they take three times as long
_FILES = {
    "detections.csv": columns.DETECTIONS,
    "spots.csv": columns.SPOTS,
    "beams.csv": columns.BEAMS,
    "attitude.csv": columns.ATTITUDE,
    "covariance.csv": columns.COVARIANCE,
}


class TableWriter:
    """Context manager that writes all tables of one run into an existing folder.

    with_systematic: also systematic.csv, the part of covariance.csv that is due to the calibration's errors.
    with_causal: also attitude_causal.csv and covariance_causal.csv, the poses of the causal pass, and budget.csv.
    with_picture_times: detections.csv has the instant of each picture, t_s.
    """

    def __init__(
        self,
        folder: Path,
        rig: Rig,
        with_systematic: bool = False,
        with_causal: bool = False,
        with_picture_times: bool = False,
    ) -> None:
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
            self._files["budget.csv"] = columns.BUDGET
        if with_picture_times:
            self._files["detections.csv"] = (*columns.DETECTIONS, columns.PICTURE_TIME)
        self._open: dict[str, TextIO] = {}
        self._waiting: list[FrameRecord] = []
        self._waiting_causal: list[FrameRecord] = []

    def __enter__(self) -> TableWriter:
        for name, header in self._files.items():
            self._open[name] = (self._folder / name).open("w", encoding="utf-8", newline="")
            self._open[name].write(",".join(header) + "\n")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        try:
            if kind is None:
                self._write_waiting()
        finally:
            for file in self._open.values():
                file.close()

    def write(self, record: FrameRecord, causal: FrameRecord | None = None) -> None:
        """Add the rows of one frame. causal: the same frame of the causal pass, where its tables are written.

        The rows reach the files in blocks of frames, or when the context ends. Raises ValueError: the tables are
        closed.
        """
        if self._open["spots.csv"].closed:
            raise ValueError("the tables are a closed file")
        self._waiting.append(record)
        if causal is not None:
            self._waiting_causal.append(causal)
        if len(self._waiting) >= _BLOCK:
            self._write_waiting()

    def _write_waiting(self) -> None:
        records, causal = self._waiting, self._waiting_causal
        self._waiting, self._waiting_causal = [], []
        if records:
            self._detections(records)
            self._spots(records)
            self._poses(records)
            self._beam_rows(records)
        if causal:
            self._poses(causal, CAUSAL)

    def _detections(self, records: Sequence[FrameRecord]) -> None:
        pictures = [
            (record.frame, camera, found)
            for record in records
            for camera, found in zip(self._cameras, record.detections, strict=True)
            if found is not None and len(found)
        ]
        if records[0].pictures is not None:
            shown = [p for record in records for p in record.pictures or () if len(p.detections)]
            pictures = [(p.number, self._cameras[p.camera], p.detections) for p in shown]
            times = [p.t_s for p in shown for _ in range(len(p.detections))]
            rows = zip(detection_rows(pictures), times, strict=True)
            self._open["detections.csv"].writelines(f"{row[:-1]},{_number(t_s)}\n" for row, t_s in rows)
            return
        self._open["detections.csv"].writelines(detection_rows(pictures))

    def _spots(self, records: Sequence[FrameRecord]) -> None:
        tracked = [record.tracked for record in records]
        cov = np.stack([t.cov_px2 for t in tracked])
        sigma = _sigmas(np.stack([cov[..., 0, 0], cov[..., 1, 1]], axis=-1), [record.frame for record in records])
        unknown = np.full(len(self._views), np.nan)
        probability = [unknown if t.label_probability is None else t.label_probability for t in tracked]
        before = np.concatenate([np.stack([t.uv_px for t in tracked]), sigma], axis=-1).tolist()
        after = np.concatenate(
            [
                np.stack([t.predicted_px for t in tracked]),
                np.stack([np.stack([t.gain for t in tracked]), cov[..., 0, 1], np.stack(probability)], axis=-1),
            ],
            axis=-1,
        ).tolist()
        rows = []
        for record, numbers, rest in zip(records, before, after, strict=True):
            head, status = f"{record.frame},{_number(record.t_s)}", record.tracked.status
            rows += [
                f"{head},{camera},{spot},{_joined(numbers[i])},{status[i].value},{_joined(rest[i])}\n"
                for i, (camera, spot) in enumerate(self._views)
            ]
        self._open["spots.csv"].writelines(rows)

    def _poses(self, records: Sequence[FrameRecord], which: str = "") -> None:
        """The rows of attitude and covariance; `which` is CAUSAL or empty."""
        systematic = None if which else self._open.get("systematic.csv")
        covariances, of_calibration = [], []
        for record in records:
            t = record.tracked
            if t.pose is None or t.pose_covariance is None:
                continue
            covariances.append(f"{record.frame},{_exact(t.pose_covariance[_UPPER])}\n")
            if systematic is not None and t.pose_systematic is not None:
                of_calibration.append(f"{record.frame},{_exact(t.pose_systematic[_UPPER])}\n")
        self._open[f"attitude{which}.csv"].writelines(attitude_rows(records))
        self._open[f"covariance{which}.csv"].writelines(covariances)
        if systematic is not None:
            systematic.writelines(of_calibration)
        if not which and (budget := self._open.get("budget.csv")) is not None:
            parts = [(r.frame, r.tracked.rest_parts) for r in records if r.tracked.pose is not None]
            budget.writelines(f"{frame},{_exact(of)}\n" for frame, of in parts if of is not None)

    def _beam_rows(self, records: Sequence[FrameRecord]) -> None:
        rows = []
        for record in records:
            t, head = record.tracked, f"{record.frame},{_number(record.t_s)}"
            status = t.pose_status.value
            if t.pose is None:
                rows += [f"{head},{b},,,,,,,{status}\n" for b in self._beams]
                continue
            both = np.concatenate([t.pose.turn(self._directions), t.pose.apply(self._points)], axis=-1)
            rows += [f"{head},{b},{_joined(row)},{status}\n" for b, row in zip(self._beams, both.tolist(), strict=True)]
        self._open["beams.csv"].writelines(rows)


def detection_rows(pictures: Sequence[tuple[int, str, Detections]]) -> list[str]:
    """The lines of detections.csv for some pictures: frame, camera as a CSV field (`csv_word`), and its detections."""
    if not pictures:
        return []
    every = [found for _, _, found in pictures]
    cov = np.concatenate([f.cov_px2 for f in every])
    heads = [f"{frame},{camera}" for frame, camera, found in pictures for _ in range(len(found))]
    frames = [frame for frame, _, found in pictures for _ in range(len(found))]
    sigma = _sigmas(np.stack([cov[:, 0, 0], cov[:, 1, 1]], axis=-1), frames)
    shape = [np.stack([f.flux, f.peak, f.major_px, f.minor_px, f.angle_deg], axis=-1) for f in every]
    numbers = np.concatenate(
        [np.concatenate([f.uv_px for f in every]), sigma, np.concatenate(shape), cov[:, :1, 1]], axis=-1
    )
    return [f"{head},{_joined(row)}\n" for head, row in zip(heads, numbers.tolist(), strict=True)]


def attitude_rows(records: Sequence[FrameRecord]) -> list[str]:
    """The lines of attitude.csv for some frames."""
    numbers = iter(_numbers_of_poses(records))
    moving = iter(_numbers_of_motions(records))
    no_pose, no_motion = "," * len(columns.POSE), "," * len(columns.MOTION)
    rows = []
    for record in records:
        t = record.tracked
        head, status = f"{record.frame},{_number(record.t_s)}", t.pose_status.value
        if t.pose is None or t.pose_covariance is None:
            rows.append(f"{head}{no_pose},{t.spots_used},,{status}{no_motion}\n")
            continue
        motion = no_motion[1:] if t.motion is None else _joined(next(moving))
        rows.append(f"{head},{_joined(next(numbers))},{t.spots_used},{_number(t.rms_px)},{status},{motion}\n")
    return rows


def _numbers_of_poses(records: Sequence[FrameRecord]) -> list[list[float]]:
    """`pose_numbers` of the frames that have a pose, in order."""
    known = [
        (r.frame, r.tracked.pose, r.tracked.pose_covariance)
        for r in records
        if r.tracked.pose is not None and r.tracked.pose_covariance is not None
    ]
    if not known:
        return []
    frames, poses, covariances = zip(*known, strict=True)
    covariance = np.stack(covariances)
    _sigmas(np.diagonal(covariance, axis1=-2, axis2=-1), frames)
    out: list[list[float]] = pose_numbers(Pose.stack(poses), covariance).tolist()
    return out


def _numbers_of_motions(records: Sequence[FrameRecord]) -> list[list[float]]:
    """The last 12 columns of attitude.csv, from velocity_x_m_s, of the frames with a pose and a motion, in order."""
    known = [
        (r.frame, r.tracked.motion)
        for r in records
        if r.tracked.pose is not None and r.tracked.pose_covariance is not None and r.tracked.motion is not None
    ]
    if not known:
        return []
    variances = np.stack([np.diagonal(m.covariance) for _, m in known])
    sigma = _sigmas(variances, [frame for frame, _ in known])
    mean = np.stack([np.concatenate([m.velocity, m.rate]) for _, m in known])
    out: list[list[float]] = np.concatenate([mean, sigma], axis=-1).tolist()
    return out


def _sigmas(variances: Array, frames: Sequence[int]) -> Array:
    """Square roots of variances (..., k) of these frames, or of one; nan for nan.

    Raises RunError: a variance is negative. This is an error of the program, since every frame is checked before.
    """
    if np.any(variances < 0):
        bad = np.any(variances < 0, axis=tuple(range(1, variances.ndim))) if len(frames) > 1 else np.array([True])
        frame = frames[int(np.argmax(bad))]
        raise RunError(f"frame {frame}: internal error: a variance is negative; please report this run")
    return np.asarray(np.sqrt(variances))


def pose_numbers(pose: Pose, covariance: Array) -> Array:
    """The 16 columns of attitude.csv from x_m to sigma_roll_deg: (..., 16) of poses with covariances (..., 6, 6)."""
    return np.concatenate(
        [
            pose.translation,
            pose.quaternion_wxyz,
            np.rad2deg(pose.ypr),
            np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1)[..., :3]),
            np.rad2deg(ypr_sigmas(pose, covariance)),
        ],
        axis=-1,
    )


@cache
def _format(count: int) -> str:
    """Format of `count` fields with ten significant digits each, more than any measurement here has."""
    return ",".join(["%.10g"] * count)


def _joined(values: Sequence[float]) -> str:
    """Numbers as fields; empty for nan."""
    text = _format(len(values)) % tuple(values)
    return text.replace("nan", "") if "nan" in text else text


def _exact(values: Array) -> str:
    """Numbers with as many digits as reproduce them exactly.

    Rounded to ten digits, a covariance whose axes differ by 1e5 in size may have a negative variance along one of them.
    """
    return ",".join(map(repr, values.tolist()))


def _number(value: float) -> str:
    """A number as a field; empty for nan."""
    return "" if value != value else f"{value:.10g}"
