"""What a fault does to the spots, and through them to the poses of a run that does not know of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools
from lab.runs.model_check.linear import LinearisedFrames


@dataclass(frozen=True, slots=True)
class Effect:
    """Root mean squares over the frames used."""

    view: int  # of those that the fault moves, the one that it sets farthest off against the other spots, and ...
    axis: int  # ... there 0: u, 1: v; -1 where no spot is seen together with enough others
    off_px: float  # by so much
    off_sigmas: float  # the same in sigmas of one measurement: as claimed, times the recording's noise where larger
    attitude_deg: float  # how far it turns the pose; nan where no frame has a pose of its own
    position_mm: float  # and moves it
    pose_sigmas: float  # the largest of x, y, z and the three rotations in its claimed sigma; nan likewise


def effect_of(
    lin: LinearisedFrames,
    columns: Array,
    theta: Array,
    views: Bools,
    covariance: Array,
    claimed: Array | None,
    noise: float = 1.0,
) -> Effect:
    """The effect of numbers theta (p,), of which columns (K, n, 2, p) say what they do to the whitened pixels.

    views (n,): those to look at. covariance (p, p): what the calibration claims. claimed (K, 6, 6): the run's own claim
    of its poses; without one, that of a single frame's fit with the calibration's share. noise: how much larger than
    claimed the spots' random errors are; what is off by less than these is not off by much, whatever the claims.
    """
    moved = columns @ theta
    weights = lin.weights()
    off = (weights @ lin.pose_free(moved)[..., None])[..., 0]
    back = np.linalg.inv(np.where(lin.used[..., None, None], lin.W, np.eye(2)))
    off_px = (back @ off[..., None])[..., 0]
    sigma_px = noise * np.sqrt(np.diagonal(back @ np.swapaxes(back, -1, -2), axis1=-2, axis2=-1))
    px, sigmas = _rms(off_px), _rms(off_px / sigma_px)
    sigmas_of_views = np.where(views[:, None] & np.isfinite(sigmas), sigmas, -1.0)
    view, axis = (int(i) for i in np.unravel_index(np.argmax(sigmas_of_views), sigmas.shape))
    seen = bool(sigmas_of_views[view, axis] >= 0)
    own = lin.rank == 6
    bias = lin.to_pose(moved)[own]
    nan = float("nan")
    turn = move = pose_sigmas = nan
    if own.any():
        turn = float(np.rad2deg(np.sqrt(np.mean(np.sum(bias[:, 3:] ** 2, axis=1)))))
        move = float(1e3 * np.sqrt(np.mean(np.sum(bias[:, :3] ** 2, axis=1))))
        variances = _claimed_variances(lin, columns, covariance, claimed, noise)[own]
        known = np.isfinite(variances).all(axis=1) & (variances > 0).all(axis=1)
        if known.any():
            pose_sigmas = float(np.sqrt(np.mean(bias[known] ** 2 / variances[known], axis=0)).max())
    return Effect(
        view=view,
        axis=axis if seen else -1,
        off_px=float(px[view, axis]) if seen else nan,
        off_sigmas=float(sigmas[view, axis]) if seen else nan,
        attitude_deg=turn,
        position_mm=move,
        pose_sigmas=pose_sigmas,
    )


def _claimed_variances(
    lin: LinearisedFrames, columns: Array, covariance: Array, claimed: Array | None, noise: float
) -> Array:
    """(K, 6) variances of the poses."""
    if claimed is not None:
        return np.asarray(np.diagonal(claimed, axis1=-2, axis2=-1))
    variances = noise**2 * np.diagonal(lin.gain, axis1=-2, axis2=-1)
    known = np.flatnonzero(np.diagonal(covariance) > 0)
    if known.size:
        moves = lin.to_pose(columns[..., known])
        variances = variances + np.einsum("kip,pq,kiq->ki", moves, covariance[np.ix_(known, known)], moves)
    return np.asarray(variances)


def _rms(values: Array) -> Array:
    """Over frames, (K, ...) -> (...); nan is passed over, and comes out where there is nothing else."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    total = np.sum(np.where(known, values, 0.0) ** 2, axis=0)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
