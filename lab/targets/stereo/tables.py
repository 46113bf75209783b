"""The tables of a stereo run: those of a run (section 4 of the files' contract), and points.csv."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from geometry.camera import in_picture
from lab.files.text import columns
from lab.files.text.csv_text import number_fields, write_table
from lab.runs.tables import pose_numbers
from lab.targets.stereo.run import StereoRecord, StereoResults, StereoRun
from tracking.binocular.joint_fit import triangulate
from tracking.binocular.marker_model import project_markers
from tracking.binocular.pose_tracker import BinocularFrame
from tracking.statuses import view_statuses

POINTS = (
    "frame", "t_s", "spot", "x_m", "y_m", "z_m", "sigma_x_m", "sigma_y_m", "sigma_z_m", "epipolar_sigmas",
)  # fmt: skip
_UPPER = np.triu_indices(6)


def write_tables(results: StereoResults, folder: Path) -> None:
    """Write attitude.csv, covariance.csv, systematic.csv, spots.csv, points.csv and detections.csv into a folder."""
    run, records = results.run, results.records
    frames = [(r.frame, r.t_s, r.tracked) for r in records]
    write_table(folder / "attitude.csv", columns.ATTITUDE, (attitude_row(*frame) for frame in frames))
    write_table(folder / "covariance.csv", columns.COVARIANCE, covariance_rows(frames))
    if run.pair.covariance is not None or run.target.model.sigma_m > 0:
        fitted = [(r.frame, r.tracked.fit.systematic) for r in records if r.measured and r.tracked.fit is not None]
        rows = ([frame, *map(repr, S[_UPPER].tolist())] for frame, S in fitted)
        write_table(folder / "systematic.csv", columns.COVARIANCE, rows)
    write_table(folder / "spots.csv", columns.SPOTS, (row for r in records for row in _spot_rows(run, r)))
    write_table(folder / "points.csv", POINTS, (row for r in records for row in _point_rows(run, r)))
    write_table(
        folder / "detections.csv", columns.DETECTIONS, (row for r in records for row in _candidate_rows(run, r))
    )


def attitude_row(number: int, t_s: float, tracked: BinocularFrame) -> list[object]:
    """The row of attitude.csv of a frame."""
    head: list[object] = [number, *number_fields([t_s])]
    motion = [""] * len(columns.MOTION)  # poses are of single frames: they have no velocity
    if tracked.pose is None or tracked.covariance is None:
        return [*head, *[""] * len(columns.POSE), 0, "", tracked.status.value, *motion]
    used = int((tracked.index >= 0).sum())
    rms = number_fields([tracked.fit.rms_px if tracked.fit is not None and used else float("nan")])
    pose = number_fields(pose_numbers(tracked.pose, tracked.covariance))
    return [*head, *pose, used, *rms, tracked.status.value, *motion]


def covariance_rows(frames: Iterable[tuple[int, float, BinocularFrame]]) -> Iterator[list[object]]:
    """The rows of covariance.csv: the frames, as for `attitude_row`, that have a pose."""
    for number, _, tracked in frames:
        if tracked.covariance is not None:
            yield [number, *map(repr, tracked.covariance[_UPPER].tolist())]


def _spot_rows(run: StereoRun, record: StereoRecord) -> Iterator[list[object]]:
    """One row per camera and marker. Where no candidate has the label, u and v are those of the pose."""
    t, model = record.tracked, run.target.model
    uv, cov = np.full((2, len(model), 2), np.nan), np.full((2, len(model), 2, 2), np.nan)
    if t.pose is not None and t.covariance is not None:
        uv, J = project_markers(run.pair, model, t.pose)
        cov = J @ t.covariance @ np.swapaxes(J, -1, -2)
    for c, camera in enumerate(run.pair.cameras):
        seen, found = t.index[c] >= 0, record.candidates[c]
        exists = np.isfinite(uv[c, :, 0])
        inside = in_picture(uv[c], np.array(camera.image_size_px))
        has_image = np.full(len(model), found is not None)
        status = view_statuses(seen, np.zeros(len(model), dtype=bool), exists, inside, has_image, t.pose is not None)
        for k, name in enumerate(model.names):
            at, C = uv[c, k], cov[c, k]
            if seen[k] and found is not None:
                at, C = found.uv_px[t.index[c, k]], found.cov_px2[t.index[c, k]]
            with np.errstate(invalid="ignore"):
                sigma = np.sqrt(np.diagonal(C))
            yield [
                record.frame, *number_fields([record.t_s]), camera.name, name, *number_fields([*at, *sigma]),
                status[k].value, *number_fields(t.predicted_px[c, k]), "", *number_fields([C[0, 1], float("nan")]),
            ]  # fmt: skip


def _point_rows(run: StereoRun, record: StereoRecord) -> Iterator[list[object]]:
    """One row per marker seen by both cameras: its most likely point from its two images alone."""
    t = record.tracked
    both = np.flatnonzero((t.index >= 0).all(axis=0))
    left, right = record.candidates
    if not len(both) or left is None or right is None:
        return
    pick = (left.pick(t.index[0, both]), right.pick(t.index[1, both]))
    found = triangulate(run.pair, np.stack([p.uv_px for p in pick]), np.stack([p.cov_px2 for p in pick]))
    for i, k in enumerate(both.tolist()):
        sigma = np.sqrt(np.diagonal(found.covariance[i]))
        numbers = number_fields([*found.points[i], *sigma, float(np.sqrt(found.chi2[i]))])
        yield [record.frame, *number_fields([record.t_s]), run.target.model.names[k], *numbers]


def _candidate_rows(run: StereoRun, record: StereoRecord) -> Iterator[list[object]]:
    """All candidates; major and minor axis are those of a disc of the candidate's area: half its radius."""
    for camera, found in zip(run.pair.cameras, record.candidates, strict=True):
        if found is None:
            continue
        for uv, C, area in zip(found.uv_px, found.cov_px2, found.area_px2.tolist(), strict=True):
            axis = float(np.sqrt(area / np.pi)) / 2
            sigma = np.sqrt(np.diagonal(C))
            shape = number_fields([axis, axis, 0.0, C[0, 1]])
            yield [record.frame, camera.name, *number_fields([*uv, *sigma]), "", "", *shape]
