"""Effect of a fault on the spots, and through them on poses that are computed without knowledge of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.model_check.linearised_frames import LinearisedFrames
from geometry.arrays import Array, Bools


@dataclass(frozen=True, slots=True)
class Effect:
    """Root mean squares over the frames used."""

    view: int  # index of the affected view with the largest leave-one-out residual, in sigmas
    axis: int  # of that residual: 0 u, 1 v; -1 where no spot is measured together with enough others
    off_px: float  # that residual
    off_sigmas: float  # the same in sigmas of one measurement: as stated, times the noise scale where that is above 1
    attitude_deg: float  # rotation of the pose; nan where no frame alone determines its pose
    position_mm: float  # displacement of the pose; nan likewise
    pose_sigmas: float  # largest ratio of bias to stated sigma over x, y, z and the three rotations; nan likewise


@dataclass(frozen=True, slots=True)
class EffectContext:
    """What the effects of all faults of one recording are computed from: K frames, n views, p parameters."""

    lin: LinearisedFrames
    jacobian: Array  # (K, n, 2, p) of the whitened pixels by the parameters
    covariance: Array  # (p, p) of the parameters, stated by the calibration
    pose_covariance: Array | None  # (K, 6, 6) stated by the run; None: that of single-frame fits plus the calibration's
    noise_scale: float = 1.0  # ratio of the spots' random errors to their stated sigmas


def effect_of(context: EffectContext, theta: Array, views: Bools) -> Effect:
    """The effect of parameter changes theta (p,). views (n,): those that are considered for `off_px`."""
    lin = context.lin
    moved = context.jacobian @ theta
    weights = lin.inverse_redundancy()
    off = (weights @ lin.residual_part(moved)[..., None])[..., 0]
    back = np.linalg.inv(np.where(lin.used[..., None, None], lin.W, np.eye(2)))
    off_px = (back @ off[..., None])[..., 0]
    sigma_px = context.noise_scale * np.sqrt(np.diagonal(back @ np.swapaxes(back, -1, -2), axis1=-2, axis2=-1))
    px, sigmas = _rms(off_px), _rms(off_px / sigma_px)
    sigmas_of_views = np.where(views[:, None] & np.isfinite(sigmas), sigmas, -1.0)
    view, axis = (int(i) for i in np.unravel_index(np.argmax(sigmas_of_views), sigmas.shape))
    seen = bool(sigmas_of_views[view, axis] >= 0)
    own = lin.rank == 6
    bias = lin.pose_shift(moved)[own]
    nan = float("nan")
    turn = move = pose_sigmas = nan
    if own.any():
        turn = float(np.rad2deg(np.sqrt(np.mean(np.sum(bias[:, 3:] ** 2, axis=1)))))
        move = float(1e3 * np.sqrt(np.mean(np.sum(bias[:, :3] ** 2, axis=1))))
        variances = _stated_variances(context)[own]
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


def _stated_variances(context: EffectContext) -> Array:
    """(K, 6) variances of the poses, m^2 and rad^2."""
    lin, covariance = context.lin, context.covariance
    if context.pose_covariance is not None:
        return np.asarray(np.diagonal(context.pose_covariance, axis1=-2, axis2=-1))
    variances = context.noise_scale**2 * np.diagonal(lin.normal_inverse, axis1=-2, axis2=-1)
    known = np.flatnonzero(np.diagonal(covariance) > 0)
    if known.size:
        shifts = lin.pose_shift(context.jacobian[..., known])
        variances = variances + np.einsum("kip,pq,kiq->ki", shifts, covariance[np.ix_(known, known)], shifts)
    return np.asarray(variances)


def _rms(values: Array) -> Array:
    """Root mean squares over frames, (K, ...) -> (...), ignoring nan; nan where all values are nan."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    total = np.sum(np.where(known, values, 0.0) ** 2, axis=0)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
