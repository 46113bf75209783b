"""The data of a report: the tables of a results folder, and what can be read of its run folder."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geometry.arrays import Array, Bools
from geometry.forward_model import SpotModel
from lab.errors import BeamposeError
from lab.files.run.results import PoseTrack, ResultFolder, SpotGrid
from lab.files.run.run_file import Run
from lab.report.summary import RunSummary, summary_of
from lab.runs.verdict.score import ResultTables, TruthArrays, against_truth, pose_errors, read_tables
from tracking.statuses import PoseStatus

_FRAMES_AT_ONCE = 2000  # bounds the memory of projecting all poses with their Jacobians


@dataclass(frozen=True, slots=True)
class ReportData:
    """The content of a results folder, and its run where the run folder can still be read."""

    name: str
    summary: RunSummary
    spots: SpotGrid
    poses: PoseTrack
    causal: PoseTrack | None  # of the causal filter, where `poses` are smoothed; of the same frames
    t_s: Array  # (F,) of the spots' frames; frame numbers where times are missing
    time_name: str
    run: Run | None
    run_folder: Path | None
    truth: TruthArrays | None
    errors: Mapping[str, Any] | None  # against truth, as lab.runs.verdict.score gives them
    residual_px: Array | None  # (F, V, 2) measured minus projected from the pose of the frame; None without a rig
    residual_share: float | None  # expected variance of a residual over that of the spot; the fit takes up the rest

    @property
    def picture_sizes(self) -> dict[str, tuple[int, int]]:
        """Width and height, px, of each known camera."""
        return {} if self.run is None else {n: c.image_size_px for n, c in self.run.rig.cameras.items()}

    @property
    def innovation_px(self) -> Array:
        """(F, V, 2): measured minus predicted; nan where nothing was measured."""
        return np.where(self.spots.measured[..., None], self.spots.uv_px - self.spots.predicted_px, np.nan)

    @property
    def pose_errors(self) -> Array | None:
        """(F', 6): estimate minus truth, [m in world, rad in body]."""
        if self.truth is None or self.truth.world_from_body is None:
            return None
        return -pose_errors(self.poses, self.truth.world_from_body)


def read_report_data(
    results: Path, run_folder: Path | None, run: Run | None = None, tables: ResultTables | None = None
) -> ReportData:
    """Read a results folder, and what is there of its run folder.

    run_folder: None: the folder that summary.json names. If it is missing or damaged, only the data from it are left
    out. run, tables (with truth): those of the folders, where they are known already. Raises InputError: the results
    cannot be read.
    """
    of = ResultFolder(results, run_folder)
    summary, folder = summary_of(of.summary), of.run_folder
    if tables is None:
        tables = read_tables(of)
        if folder is not None:
            with suppress(BeamposeError):
                tables = against_truth(tables, folder)
    if run is None and folder is not None:
        with suppress(BeamposeError):
            run = of.run()
    spots, poses = tables.spots, tables.poses
    times_known = bool(len(spots.t_s)) and bool(np.isfinite([*spots.t_s, *poses.t_s]).all())
    residual_px, residual_share = (None, None) if run is None else pose_residuals(spots, poses, run)
    return ReportData(
        name=of.name,
        summary=summary,
        spots=spots,
        poses=poses,
        causal=tables.causal,
        t_s=spots.t_s if times_known else spots.frames.astype(float),
        time_name="time (s)" if times_known else "frame",
        run=run,
        run_folder=folder,
        truth=tables.truth,
        errors=summary.errors if tables.truth is None else tables.errors,
        residual_px=residual_px if residual_px is not None and np.isfinite(residual_px).any() else None,
        residual_share=residual_share,
    )


def pose_residuals(spots: SpotGrid, poses: PoseTrack, run: Run) -> tuple[Array | None, float | None]:
    """(F, V, 2): measured pixel minus projection from the frame's measured pose, or nan; and `residual_share`.

    nan also for cameras with clocks of their own: the tables do not state how the spot moved between picture and pose.

    The residual of a measurement with covariance R that was used for a pose of covariance P has the covariance
    R - J P J^T, for a pose from one frame, filtered or smoothed. The share is its mean ratio to R. The calibration's
    part of P is excluded, since it takes up no noise.
    """
    model = SpotModel.of(run.rig)
    place = {view: i for i, view in enumerate(model.views)}
    if not all(view in place for view in spots.views) or not np.array_equal(spots.frames, poses.frames):
        return None, None
    rows = model.subset(np.array([place[view] for view in spots.views], dtype=np.int64))
    out = np.full(spots.uv_px.shape, np.nan)
    use: Bools = poses.known & poses.has(PoseStatus.MEASURED)
    of_instant = np.array([camera not in run.clocks for camera, _ in spots.views])
    noise = poses.covariance - np.nan_to_num(poses.systematic)
    removed, count = 0.0, 0
    for start in range(0, len(spots.frames), _FRAMES_AT_ONCE):
        part = start + np.flatnonzero(use[start : start + _FRAMES_AT_ONCE])
        if len(part):
            projected, J = rows.project(poses.world_from_body[part])
            out[part] = np.where((spots.measured[part] & of_instant)[..., None], spots.uv_px[part] - projected, np.nan)
            with np.errstate(invalid="ignore"):  # nan for views without a projection
                shares = np.einsum("fvij,fjk,fvik->fvi", J, noise[part], J) / spots.sigma_px[part] ** 2
            shares = shares[np.isfinite(shares) & np.isfinite(out[part])]
            removed, count = removed + float(np.minimum(shares, 1.0).sum()), count + len(shares)
    return out, 1.0 - removed / count if count else None
