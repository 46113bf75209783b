"""Labelled spots from a run folder that was recorded for a beam calibration."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from geometry.arrays import Array
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from lab.calibrate.beams.stationary_frames import SpotRows
from lab.errors import InputError
from lab.files.project.point_files import StandPoses
from lab.files.run.run_file import Run, load_run
from lab.runs.frames.pipeline import FrameRecord, Pipeline
from tracking.detections import Detections
from tracking.statuses import SpotStatus

# Largest difference of a beam from its nominal line for which its spots are found: together 64 mm on a screen at 2.5 m
# from the vehicle. Spots of different beams closer than this may be confused; the robust fit then excludes them.
MAX_NOMINAL_ERROR_RAD = np.deg2rad(1.0)
MAX_NOMINAL_ERROR_M = 0.02
Labelled = list[tuple[int, Array, Array]]  # view, pixel (2,), covariance (2, 2)
_MEASURED = (SpotStatus.MATCHED, SpotStatus.TURNED)


def spots_of_run(folder: Path, rig: Rig, known: StandPoses | None, world_from_stand: Pose | None) -> SpotRows:
    """Labelled spots of all frames of a run.

    rig: calibrated cameras and screens with nominal beams, used in place of the rig in run.yaml. If the stand's place
    and its poses are known, each detection gets the label of the nearest spot predicted by the nominal beams.
    Otherwise the tracker labels the detections, starting from the run's own prior. Frames without a pose are skipped.

    Raises:
        InputError: if the run cannot be read or has a camera that is not in `rig`.
    """
    run = load_run(folder)
    missing = [c for c in run.cameras if c not in rig.cameras]
    if missing:
        raise InputError(
            f"{run.path}: cameras.{missing[0]}: expected a camera of the calibration, got {missing[0]!r}; it has"
            f" {', '.join(rig.cameras)}"
        )
    rig_of_run = dataclasses.replace(rig, cameras={n: c for n, c in rig.cameras.items() if n in run.cameras})
    run = dataclasses.replace(run, rig=rig_of_run, covariance=None)
    view_index = {view: i for i, view in enumerate(rig.views())}
    model = SpotModel.of(rig_of_run)
    view_of = np.array([view_index[v] for v in model.views], dtype=np.int64)
    poses: dict[int, Pose] = {}
    if known is not None:
        poses = {int(f): known.stand_from_body[i] for i, f in enumerate(known.frames)}
        if world_from_stand is not None:
            run = _starting_at(run, world_from_stand @ known.stand_from_body[0])
    frame, view, pixels, covariance = [], [], [], []
    for number, found in _labelled(Pipeline.of(run), model, poses, world_from_stand):
        if known is not None and number not in poses:
            continue
        for v, uv, cov in found:
            frame.append(number)
            view.append(view_of[v])
            pixels.append(uv)
            covariance.append(cov)
    return SpotRows(
        np.array(frame, dtype=np.int64),
        np.array(view, dtype=np.int64),
        np.array(pixels, dtype=float).reshape(-1, 2),
        np.array(covariance, dtype=float).reshape(-1, 2, 2),
    )


def label(model: SpotModel, world_from_body: Pose, detections: tuple[Detections | None, ...]) -> Labelled:
    """Assign detections (one entry per camera) to the spots that the nominal beams predict at a pose.

    Returns view, pixel and covariance of each assigned detection. The assignment of a camera has the least total
    distance, where each distance is divided by the largest error that its spot may have from the nominal beam.
    """
    d = model.derivatives(world_from_body)
    gate_px = np.hypot(
        MAX_NOMINAL_ERROR_RAD * np.linalg.norm(d.direction, axis=(-2, -1)),
        MAX_NOMINAL_ERROR_M * np.linalg.norm(d.point, axis=(-2, -1)),
    )
    out = []
    for c, found in enumerate(detections):
        views = np.flatnonzero((model.camera_of == c) & np.isfinite(d.pixels).all(axis=1))
        if found is None or not len(found) or not len(views):
            continue
        distance = np.linalg.norm(found.uv_px[None] - d.pixels[views][:, None], axis=2) / gate_px[views][:, None]
        # Distances are capped well above the gate: pairs outside of it are assigned last, and dropped below.
        rows, columns = linear_sum_assignment(np.minimum(distance, 1e3))
        out += [
            (int(views[r]), found.uv_px[k], found.cov_px2[k])
            for r, k in zip(rows, columns, strict=True)
            if distance[r, k] <= 1.0
        ]
    return out


def _labelled(
    pipeline: Pipeline, model: SpotModel, poses: dict[int, Pose], world_from_stand: Pose | None
) -> Iterator[tuple[int, Labelled]]:
    """Frame numbers with their labelled spots: from known poses, else from the tracker."""
    if poses and world_from_stand is not None:
        for number, detections in pipeline.detections():
            if number in poses:
                yield number, label(model, world_from_stand @ poses[number], detections)
    else:
        for record in pipeline.records():
            yield record.frame, _tracked(record)


def _tracked(record: FrameRecord) -> Labelled:
    t = record.tracked
    return [(v, t.uv_px[v], t.cov_px2[v]) for v, s in enumerate(t.status) if s in _MEASURED]


def _starting_at(run: Run, world_from_body: Pose) -> Run:
    """The run with its tracker's prior replaced by a pose (sigma 0.1 m, 10 deg)."""
    return dataclasses.replace(run, prior=PosePrior(world_from_body, 0.1, float(np.deg2rad(10.0))))
