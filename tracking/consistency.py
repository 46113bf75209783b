"""Consistency tests of reported poses: against their own labelled spots, and of smoothed against causal poses.

Both tests use the poses as reported, not a fit made for the test, because a fit to a single frame's spots agrees with
these spots even where the reported pose does not. Pure functions of arrays, T frames and n views. Source: ours; the
statistics are chi-square tests (Bar-Shalom, Li & Kirubarajan 2001, section 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints, finite
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.uncertainty.chi_square import chi2_limit

P_CONTRADICTION = 1e-6  # false alarm probability per frame: at most 0.1 false alarms in 100,000 correct frames
_LEAST_EIGENVALUE = 1e-14  # of a covariance scaled to unit diagonal: smaller ones are rounding errors of the scaling


@dataclass(frozen=True, slots=True)
class SpotAgreement:
    """Agreement of reported poses with their own spots."""

    chi2: Array  # (T,) their joint chi-square; 0 without spots
    dof: Ints  # (T,) 2 per spot used: degrees of freedom of the limit. A pose fitted to the spots has a lower mean chi2
    rms_px: Array  # (T,) root mean square residual per axis; nan without spots
    contradicts: Bools  # (T,) chi2 is above the limit at P_CONTRADICTION


@dataclass(frozen=True, slots=True)
class CausalAgreement:
    """Agreement of smoothed poses with the causal poses of the same frames."""

    distance: Array  # (T,) Mahalanobis distance (6 degrees of freedom); nan if one of the two poses is missing
    contradicts: Bools  # (T,) the distance is above the limit at P_CONTRADICTION, 6.2


def against_own_spots(
    model: SpotModel,
    poses: Pose,
    covariance: Array,
    used: Bools,
    uv_px: Array,
    cov_px2: Array,
    p: float = P_CONTRADICTION,
) -> SpotAgreement:
    """Test poses against the spots that they are reported with.

    poses (T,) world_from_body; covariance (T, 6, 6) as reported, [m in world, rad in body]; used (T, n): labelled and
    used in the pose, so without merged detections; uv_px (T, n, 2); cov_px2 (T, n, 2, 2), px^2: measurement covariance,
    scaled by the noise scale, plus the calibration's contribution if known. uv_px and cov_px2 are nan where not used. A
    pose that is nan has no spots.

    The residual covariance is taken as R + J P J^T, which is correct for a pose that was estimated without the spot.
    For a pose estimated with it the covariance is R - J P J^T, so the test is conservative: the false alarm rate is at
    most P_CONTRADICTION, and the loss of power is at most a factor of 1.4 in sigmas if the pose comes from the frame's
    own spots, and none if it comes from many frames. The test is linearised: a pose that is off by a few degrees
    contradicts its spots even if its covariance is large.
    """
    known = finite(poses.translation, -1)
    safe = Pose(
        np.where(known[:, None, None], poses.rotation, np.eye(3)), np.where(known[:, None], poses.translation, 0.0)
    )
    projected, J = model.project(safe)
    use: Bools = np.asarray(used & known[:, None] & finite(projected, -1))
    residual = np.where(use[..., None], uv_px - projected, 0.0)
    R = np.where(use[..., None, None], cov_px2, np.eye(2))
    gate = limits(2 * use.sum(axis=1), p)
    # R alone gives the larger chi-square: only frames that fail with it need the pose's covariance as well.
    chi2 = _squares(residual, R).sum(axis=1)
    rows = np.flatnonzero(chi2 > gate)
    if len(rows):
        chi2[rows] = _joint(residual[rows], R[rows], J[rows] * use[rows][..., None, None], covariance[rows])
    count = use.sum(axis=1)
    with np.errstate(invalid="ignore"):
        rms = np.sqrt(np.sum(residual**2, axis=(1, 2)) / np.where(count > 0, 2 * count, np.nan))
    return SpotAgreement(chi2, (2 * count).astype(np.int64), rms, np.asarray(chi2 > gate))


def against_causal(
    poses: Pose, covariance: Array, causal: Pose, causal_covariance: Array, p: float = P_CONTRADICTION
) -> CausalAgreement:
    """Test smoothed poses (T,) against causal poses; covariances (T, 6, 6) as reported; nan where there is no pose.

    The covariance of the difference is taken as the sum of both. If both are correct and use the same measurements it
    is P_causal - P_smoothed, which is smaller, and singular at the last frame; if the labels of the passes differ it is
    somewhere below the sum. The test is therefore conservative: it loses at most a factor of 1.4 in sigmas, where both
    covariances are equal. It does not decide which of the two poses is wrong, see `contradictory`: the causal pose may
    be wrong at a bend that it detected too late.
    """
    known = _all_finite(poses, covariance) & _all_finite(causal, causal_covariance)
    gap = np.where(known[:, None], poses.minus(causal), 0.0)
    total = np.where(known[:, None, None], covariance + causal_covariance, np.eye(6))
    squared = mahalanobis2(gap, total)
    squared = np.where(known, squared, np.nan)
    with np.errstate(invalid="ignore"):
        return CausalAgreement(np.sqrt(squared), np.asarray(squared > chi2_limit(p, 6)))


def contradictory(
    own: SpotAgreement, measured: Bools, causal: CausalAgreement | None = None, causal_own: SpotAgreement | None = None
) -> Bools:
    """(T,): frames whose reported pose is rejected.

    A pose is rejected if it contradicts its own spots, or if it contradicts a causal pose that is supported by spots
    while its own spots do not confirm it. A causal pose is supported by two or more spots that agree with it
    (causal_own); without spots it comes from the motion model, which cannot follow a bend during an occlusion. A
    reported pose is confirmed if it is measured (T,) from four or more spots, so that each of them can contradict it.
    """
    if causal is None or causal_own is None:
        return own.contradicts
    confirmed = measured & (own.dof >= 8) & ~own.contradicts
    supported = (causal_own.dof >= 4) & ~causal_own.contradicts
    return np.asarray(own.contradicts | (causal.contradicts & supported & ~confirmed))


def is_covariance(matrices: Array) -> Bools:
    """(...,): which matrices (..., m, m) are finite, symmetric and positive definite, in any units."""
    variance = np.diagonal(matrices, axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore"):
        good = finite(matrices, (-2, -1)) & np.asarray((variance > 0).all(axis=-1))
    sigma = np.sqrt(np.where(good[..., None], variance, 1.0))
    scaled = matrices / (sigma[..., :, None] * sigma[..., None, :])
    scaled = np.where(good[..., None, None], scaled, np.eye(matrices.shape[-1]))
    symmetric = np.abs(scaled - np.swapaxes(scaled, -1, -2)).max(axis=(-2, -1)) < 1e-6
    return np.asarray(good & symmetric & (np.linalg.eigvalsh(scaled)[..., 0] > _LEAST_EIGENVALUE))


def limits(dof: Ints, p: float) -> Array:
    """(T,): chi-square limits that are exceeded with probability p; inf for 0 degrees of freedom."""
    table = np.array([np.inf, *(chi2_limit(p, k) for k in range(1, int(dof.max(initial=0)) + 1))])
    return np.asarray(table[dof])


def mahalanobis2(gap: Array, covariance: Array) -> Array:
    """(T,): gap^T C^-1 gap of gap (T, m) and C (T, m, m), computed with C scaled to unit diagonal."""
    sigma = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 1e-300))
    C = covariance / (sigma[:, :, None] * sigma[:, None, :])
    x = gap / sigma
    values, vectors = np.linalg.eigh(C)
    along = np.einsum("tij,ti->tj", vectors, x)
    return np.asarray(np.sum(along**2 / np.maximum(values, _LEAST_EIGENVALUE), axis=1))


def _squares(residual: Array, covariance: Array) -> Array:
    """r^T C^-1 r of residuals (..., 2) and covariances (..., 2, 2), in closed form."""
    a, b, c = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    u, v = residual[..., 0], residual[..., 1]
    return np.asarray((c * u * u - 2 * b * u * v + a * v * v) / (a * c - b * b))


def _joint(residual: Array, R: Array, J: Array, P: Array) -> Array:
    """(T,): e^T (R + J P J^T)^-1 e of all spots of a frame; R (T, n, 2, 2), J (T, n, 2, 6), 0 for unused spots.

    By the matrix inversion lemma with P = F F^T: e^T R^-1 e - g^T (1 + F^T L F)^-1 g, where L = J^T R^-1 J and
    g = F^T J^T R^-1 e.
    """
    sigma = np.sqrt(np.maximum(np.diagonal(P, axis1=-2, axis2=-1), 0.0))
    safe = np.where(sigma > 0, sigma, 1.0)
    values, vectors = np.linalg.eigh(P / (safe[:, :, None] * safe[:, None, :]))
    F = sigma[:, :, None] * vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    Ri = np.linalg.inv(R)
    A = (J @ F[:, None]).reshape(len(P), -1, 6)
    W = (Ri @ J @ F[:, None]).reshape(len(P), -1, 6)
    g = np.einsum("tij,ti->tj", W, residual.reshape(len(P), -1))
    inner = np.eye(6) + np.swapaxes(A, -1, -2) @ W
    return np.asarray(
        _squares(residual, R).sum(axis=1) - np.sum(g * np.linalg.solve(inner, g[..., None])[..., 0], axis=1)
    )


def _all_finite(poses: Pose, covariance: Array) -> Bools:
    return finite(poses.translation, -1) & finite(poses.rotation, (-2, -1)) & finite(covariance, (-2, -1))
