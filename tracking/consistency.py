"""Whether reported poses agree with their own labelled spots, and smoothed ones with the causal ones.

Both tests take the poses as they are reported, not a fit made for the test: a fit of a single frame's spots follows
these wherever the reported pose is. Pure functions of arrays, T frames and n views. Source: ours; the statistics are
chi-square tests (Bar-Shalom, Li & Kirubarajan 2001, section 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.uncertainty.chi_square import chi2_limit

P_CONTRADICTION = 1e-6  # of one frame, where all is right: of 100,000 frames, 0.1 are accused wrongly, or fewer
_LEAST_EIGENVALUE = 1e-14  # of a covariance scaled to unit diagonal: below lies the rounding of the scaling itself


@dataclass(frozen=True, slots=True)
class SpotAgreement:
    """Reported poses against their own spots."""

    squares: Array  # (T, n) each spot's squared distance from where the pose puts it, in its variances; nan if unused
    chi2: Array  # (T,) their sum; 0 without spots
    dof: Ints  # (T,) 2 per spot used: what chi2 is compared with. Its mean is lower where the pose follows the spots
    rms_px: Array  # (T,) root mean square residual per axis; nan without spots
    contradicts: Bools  # (T,) beyond P_CONTRADICTION


@dataclass(frozen=True, slots=True)
class CausalAgreement:
    """Smoothed poses against the causal ones of the same frames."""

    distance: Array  # (T,) Mahalanobis distance, sigmas of the difference (6 degrees of freedom); nan without either
    contradicts: Bools  # (T,) beyond P_CONTRADICTION: a distance of 6.2


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
    part of the pose, not those that a neighbour has pulled; uv_px (T, n, 2); cov_px2 (T, n, 2, 2), px^2: of the
    measurement, widened by the noise scale, with the calibration's part where there is one. nan where not used. A pose
    that is nan has no spots.

    A residual's covariance is taken as R + J P J^T, which holds for a pose made without the spot. A pose made with it
    has R - J P J^T, so the test is conservative there: it never accuses more than P_CONTRADICTION of right poses, and
    loses at most a factor 1.4 in sigmas where a frame's own spots make the pose (P of a single frame), nothing where
    many frames do. To first order: a pose a few degrees off its spots contradicts them however vague it is.
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
    squares = _squares(residual, R)
    # R alone gives the larger chi-square: only what fails with it needs the pose's own covariance.
    rows = np.flatnonzero(squares.sum(axis=1) > gate)
    chi2 = squares.sum(axis=1)
    if len(rows):
        spread = J[rows] @ covariance[rows][:, None] @ np.swapaxes(J[rows], -1, -2)
        squares[rows] = _squares(residual[rows], R[rows] + np.where(use[rows][..., None, None], spread, 0.0))
        chi2[rows] = _joint(residual[rows], R[rows], J[rows] * use[rows][..., None, None], covariance[rows])
    count = use.sum(axis=1)
    with np.errstate(invalid="ignore"):
        rms = np.sqrt(np.sum(residual**2, axis=(1, 2)) / np.where(count > 0, 2 * count, np.nan))
    return SpotAgreement(
        squares=np.where(use, squares, np.nan),
        chi2=chi2,
        dof=(2 * count).astype(np.int64),
        rms_px=rms,
        contradicts=np.asarray(chi2 > gate),
    )


def against_causal(
    poses: Pose, covariance: Array, causal: Pose, causal_covariance: Array, p: float = P_CONTRADICTION
) -> CausalAgreement:
    """Test smoothed poses (T,) against the causal ones; covariances (T, 6, 6) as reported; nan where there is none.

    The covariance of the difference is taken as the sum of both. Where both are right and made of the same
    measurements it is P_causal - P_smoothed, which is smaller, and singular where nothing comes after a frame; with
    labels that differ between the passes it lies anywhere below the sum. So the test is conservative: it loses a factor
    1.4 in sigmas at most where both covariances are equal. It does not say which of the two is wrong: a causal pose at
    a bend that was not seen in time may be, see `contradictory`.
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
    """(T,): frames whose reported pose must not be believed.

    Those that contradict their own spots. Those that contradict the causal pose, where spots stand behind that one
    (causal_own: two or more, which it agrees with; without any it is the motion model's, which knows no bend in an
    occlusion) and the frame's own spots do not confirm the reported one: measured (T,) from four or more spots, so that
    one of them could have contradicted.
    """
    if causal is None or causal_own is None:
        return own.contradicts
    confirmed = measured & (own.dof >= 8) & ~own.contradicts
    witnessed = (causal_own.dof >= 4) & ~causal_own.contradicts
    return np.asarray(own.contradicts | (causal.contradicts & witnessed & ~confirmed))


def is_covariance(matrices: Array) -> Bools:
    """(...,): which of matrices (..., m, m) are finite, symmetric and positive definite, in any units."""
    variance = np.diagonal(matrices, axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore"):
        good = finite(matrices, (-2, -1)) & np.asarray((variance > 0).all(axis=-1))
    sigma = np.sqrt(np.where(good[..., None], variance, 1.0))
    scaled = matrices / (sigma[..., :, None] * sigma[..., None, :])
    scaled = np.where(good[..., None, None], scaled, np.eye(matrices.shape[-1]))
    symmetric = np.abs(scaled - np.swapaxes(scaled, -1, -2)).max(axis=(-2, -1)) < 1e-6
    return np.asarray(good & symmetric & (np.linalg.eigvalsh(scaled)[..., 0] > _LEAST_EIGENVALUE))


def finite(values: Array, axes: int | tuple[int, ...]) -> Bools:
    """Whether all numbers along these axes are finite."""
    return np.asarray(np.isfinite(values).all(axis=axes), dtype=np.bool_)


def limits(dof: Ints, p: float) -> Array:
    """(T,): chi-square that is exceeded with probability p; inf for 0 degrees of freedom."""
    table = np.array([np.inf, *(chi2_limit(p, k) for k in range(1, int(dof.max(initial=0)) + 1))])
    return np.asarray(table[dof])


def mahalanobis2(gap: Array, covariance: Array) -> Array:
    """(T,): gap^T C^-1 gap of gap (T, m) and C (T, m, m); metres and radians are brought to one scale first."""
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
    """(T,): e^T (R + J P J^T)^-1 e of all spots of a frame; R (T, n, 2, 2), J (T, n, 2, 6), 0 for unused ones.

    By the matrix inversion lemma in the pose's six numbers, P = F F^T: e^T R^-1 e - g^T (1 + F^T L F)^-1 g with
    L = J^T R^-1 J and g = F^T J^T R^-1 e.
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
