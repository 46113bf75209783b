"""Labelled spots of a run folder that was recorded to calibrate beams."""

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

# How far a beam may be from its drawing for its spots to be found: at 2.5 m from the vehicle together 64 mm on the
# screen. Spots of different beams that lie nearer to each other may be mistaken; the robust fit then leaves them out.
DRAWN_WITHIN_RAD = np.deg2rad(1.0)
DRAWN_WITHIN_M = 0.02
Labelled = list[tuple[int, Array, Array]]  # view, pixel (2,), covariance (2, 2)
_MEASURED = (SpotStatus.MATCHED, SpotStatus.TURNED)


def spots_of_run(folder: Path, rig: Rig, known: StandPoses | None, world_from_stand: Pose | None) -> SpotRows:
    """The spots of a run's frames, named.

    rig: cameras and screens as calibrated, beams as drawn; that of the run.yaml is not used. Where the stand's place
    and poses are known, each frame's detections get the names of the spots that the drawing puts there. Else the
    tracker names them, from the run's own prior. Frames without a pose are passed over. Raises InputError.
    """
    run = load_run(folder)
    missing = [c for c in run.cameras if c not in rig.cameras]
    if missing:
        raise InputError(
            f"{run.path}: cameras.{missing[0]}: expected a camera of the calibration, got {missing[0]!r}; it has"
            f" {', '.join(rig.cameras)}"
        )
    seen = dataclasses.replace(rig, cameras={n: c for n, c in rig.cameras.items() if n in run.cameras})
    run = dataclasses.replace(run, rig=seen, covariance=None)
    places = {view: i for i, view in enumerate(rig.views())}
    model = SpotModel.of(seen)
    view_of = np.array([places[v] for v in model.views], dtype=np.int64)
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
    """View, pixel and covariance of the detections (one entry per camera) that lie where the drawing puts a spot.

    Within a camera the pairs of least total distance are taken, each in units of how far its spot may be off.
    """
    d = model.derivatives(world_from_body)
    reach = np.hypot(
        DRAWN_WITHIN_RAD * np.linalg.norm(d.direction, axis=(-2, -1)),
        DRAWN_WITHIN_M * np.linalg.norm(d.point, axis=(-2, -1)),
    )
    out = []
    for c, found in enumerate(detections):
        views = np.flatnonzero((model.camera_of == c) & np.isfinite(d.pixels).all(axis=1))
        if found is None or not len(found) or not len(views):
            continue
        away = np.linalg.norm(found.uv_px[None] - d.pixels[views][:, None], axis=2) / reach[views][:, None]
        # A pair out of reach costs more than any that is not, so that it is made only where nothing else is left.
        rows, columns = linear_sum_assignment(np.minimum(away, 1e3))
        out += [
            (int(views[r]), found.uv_px[k], found.cov_px2[k])
            for r, k in zip(rows, columns, strict=True)
            if away[r, k] <= 1.0
        ]
    return out


def _labelled(
    pipeline: Pipeline, model: SpotModel, poses: dict[int, Pose], world_from_stand: Pose | None
) -> Iterator[tuple[int, Labelled]]:
    """Frame numbers and their labelled spots."""
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
    """The run with its tracker starting there; what the tracker then says is not used."""
    return dataclasses.replace(run, prior=PosePrior(world_from_body, 0.1, float(np.deg2rad(10.0))))
