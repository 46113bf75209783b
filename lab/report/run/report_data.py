"""Everything that a report is made from, gathered: the tables, and what of the run folder can be reached."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geometry.arrays import Array, Bools
from geometry.forward_model import SpotModel
from lab.errors import BeamposeError
from lab.files.run.results import PoseTrack, SpotGrid, has_causal, read_poses, read_spots, read_summary
from lab.files.run.run_file import Run, load_run
from lab.runs.score.score import TruthArrays, pose_errors, read_truth, score_against
from tracking.statuses import PoseStatus

_FRAMES_AT_ONCE = 2000  # bounds the memory of projecting all poses with their Jacobians


@dataclass(frozen=True, slots=True)
class ReportData:
    """What a results folder says, and the run it came from where that is still there."""

    name: str
    summary: dict[str, Any]
    spots: SpotGrid
    poses: PoseTrack
    causal: PoseTrack | None  # as they were known at each instant, where `poses` are smoothed; of the same frames
    t_s: Array  # (F,), of the spots' frames; frame numbers where times are missing
    time_name: str
    run: Run | None
    run_folder: Path | None
    truth: TruthArrays | None
    errors: dict[str, Any] | None  # lab.runs.score.score.score
    residual_px: Array | None  # (F, V, 2), measured minus projected from the frame's pose; None without a rig
    residual_share: float | None  # of a spot's variance that residuals should have: the pose has taken up the rest

    @property
    def picture_sizes(self) -> dict[str, tuple[int, int]]:
        """Width and height, px, of each camera that is known."""
        return {} if self.run is None else {n: c.image_size_px for n, c in self.run.rig.cameras.items()}

    @property
    def innovation_px(self) -> Array:
        """(F, V, 2): measured minus predicted; nan where nothing was measured."""
        return np.where(self.spots.measured[..., None], self.spots.uv_px - self.spots.predicted_px, np.nan)

    @property
    def pose_errors(self) -> Array | None:
        """(F', 6): estimate minus truth, [m in world, rad in body]; the sign a reader expects of an error."""
        if self.truth is None or self.truth.world_from_body is None:
            return None
        return -pose_errors(self.poses, self.truth.world_from_body)

    @property
    def pose_times(self) -> Array:
        """(F',): time, or the frame number where times are missing, of the poses' rows."""
        return self.poses.t_s if self.time_name != "frame" else self.poses.frames.astype(float)


def gather(results: Path, run_folder: Path | None) -> ReportData:
    """Read a results folder, and of its run folder what is there.

    Without `run_folder`, the one that summary.json names is tried. Raises InputError if the results cannot be read; a
    run folder that is gone or damaged only leaves out what comes from it.
    """
    summary = read_summary(results)
    spots, poses = read_spots(results), read_poses(results)
    causal = read_poses(results, causal=True) if has_causal(results) else None
    if causal is not None and not np.array_equal(causal.frames, poses.frames):
        causal = None
    folder = _reachable(results, run_folder, summary)
    run = truth = None
    if folder is not None:
        try:
            run = load_run(folder)
        except BeamposeError:
            run = None
        try:
            truth = read_truth(folder, spots, poses)
        except BeamposeError:
            truth = None
    errors = score_against(spots, poses, truth, causal) if truth is not None else summary.get("errors")
    times_known = bool(len(spots.t_s)) and bool(np.isfinite(spots.t_s).all())
    residual_px, residual_share = (None, None) if run is None else _residuals(spots, poses, run)
    return ReportData(
        name=str(summary.get("name") or results.resolve().name),
        summary=summary,
        spots=spots,
        poses=poses,
        causal=causal,
        t_s=spots.t_s if times_known else spots.frames.astype(float),
        time_name="time (s)" if times_known else "frame",
        run=run,
        run_folder=folder,
        truth=truth,
        errors=errors if isinstance(errors, dict) else None,
        residual_px=residual_px,
        residual_share=residual_share,
    )


def _reachable(results: Path, run_folder: Path | None, summary: dict[str, Any]) -> Path | None:
    if run_folder is not None:
        return run_folder if run_folder.is_dir() else None
    named = summary.get("run_folder")
    if not isinstance(named, str) or not named:
        return None
    return next((p for p in (Path(named), results / named) if p.is_dir()), None)


def _residuals(spots: SpotGrid, poses: PoseTrack, run: Run) -> tuple[Array | None, float | None]:
    """(F, V, 2): measured pixel minus the pixel that the frame's measured pose gives, nan elsewhere; and their share.

    Of a measurement with covariance R in a pose of covariance P that was made with it, the residual has R - J P J^T,
    be the pose of one frame, filtered or smoothed. The share is its mean over R; the calibration's part of P takes up
    no noise.
    """
    model = SpotModel.of(run.rig)
    place = {view: i for i, view in enumerate(model.views)}
    if not all(view in place for view in spots.views) or not np.array_equal(spots.frames, poses.frames):
        return None, None
    rows = model.subset(np.array([place[view] for view in spots.views], dtype=np.int64))
    out = np.full(spots.uv_px.shape, np.nan)
    use: Bools = poses.known & poses.has(PoseStatus.MEASURED)
    noise = poses.covariance - np.nan_to_num(poses.systematic)
    taken, count = 0.0, 0
    for start in range(0, len(spots.frames), _FRAMES_AT_ONCE):
        part = start + np.flatnonzero(use[start : start + _FRAMES_AT_ONCE])
        if len(part):
            projected, J = rows.project(poses.world_from_body[part])
            out[part] = np.where(spots.measured[part][..., None], spots.uv_px[part] - projected, np.nan)
            with np.errstate(invalid="ignore"):  # a view without a projection has none of this either
                shares = np.einsum("fvij,fjk,fvik->fvi", J, noise[part], J) / spots.sigma_px[part] ** 2
            shares = shares[np.isfinite(shares) & np.isfinite(out[part])]
            taken, count = taken + float(np.minimum(shares, 1.0).sum()), count + len(shares)
    return out, 1.0 - taken / count if count else None
