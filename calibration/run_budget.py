"""Uncertainty budget of a measured pose: shares of its covariance by source, expanded uncertainty, and a Monte Carlo.

Terms of JCGM 100:2008 (GUM): the pose is the measurand, the rig's parameters are input quantities with sensitivity
coefficients, sources without correlation add by the law of propagation (equation 10), correlated ones by equation 13;
effective degrees of freedom by Welch and Satterthwaite (equation G.2b). JCGM 101:2008 is the Monte Carlo.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from calibration.budget import (
    BEAM_DIRECTIONS,
    BEAM_POINTS,
    CAMERA_POSES,
    INTRINSICS,
    SCREEN_POSES,
    SCREEN_SHAPES,
    axes_jacobian,
    group_of,
)
from geometry.arrays import Array, Ints, symmetric
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance, Sensitivity, covariance_root, perturbed_rig

COVERAGE = 0.9545  # probability of the expanded uncertainty: coverage factor 2 for a normal distribution
LINES = {
    "lenses": (INTRINSICS,),
    "screens": (SCREEN_POSES, SCREEN_SHAPES),
    "cameras": (CAMERA_POSES,),
    "beams": (BEAM_DIRECTIONS, BEAM_POINTS),
}  # of the calibration in a budget, by their groups of parameters
_ITERATIONS = 6  # of Gauss-Newton from the true pose


@dataclass(frozen=True, slots=True)
class CalibrationShare:
    """How errors of a rig's p parameters change one pose measured with it."""

    covariance: RigCovariance  # of the parameters
    sensitivity: Array  # (6, p) derivative of the pose [dt (m, world), dtheta (rad, body)] by the parameters
    rows: Ints  # (m,) views of the spots
    weights: Array  # (m, 2, 2), 1/px^2, of the spots
    adjusted: Array  # (6, 6) factor that the run's own weights add to those of these spots: near the identity

    @property
    def total(self) -> Array:
        """(6, 6): the calibration's share of the covariance of the pose."""
        return self.sensitivity @ self.covariance.matrix @ self.sensitivity.T

    def by_line(self) -> Mapping[str, Array]:
        """The share (6, 6) of each line of `LINES`; their sum is the total.

        A calibration's parameters are correlated: most of the effect of a wrong lens is undone by the place of its
        camera, which was found with that lens. So the errors of each line are taken with what those of later lines
        follow them, and the later lines with the rest, which is independent of them: a block Cholesky decomposition.
        GUM F.1.2.4: correlations are removed by independent input quantities. Source: ours.
        """
        group = np.array([group_of(name) for name in self.covariance.names])
        unit = np.sqrt(np.maximum(np.diagonal(self.covariance.matrix), 1e-300))
        rest, out = self.covariance.matrix / np.outer(unit, unit), {}
        for line, groups in LINES.items():
            own = np.isin(group, groups)
            if own.any():
                follow = rest[:, own] @ np.linalg.pinv(rest[np.ix_(own, own)], rcond=1e-12, hermitian=True)
                part = follow @ rest[np.ix_(own, own)] @ follow.T
                rest = symmetric(rest - part)
                K = self.sensitivity * unit
                out[line] = K @ part @ K.T
        return out


def calibration_share(
    rig: Rig, covariance: RigCovariance, pose: Pose, rows: Ints, spots_px2: Array, stated: Array
) -> CalibrationShare:
    """The share of calibration errors in a pose from the spots of views `rows` (m,), covariances (m, 2, 2), px^2.

    stated (6, 6): the share in the covariance of the run (systematic.csv), which weighted the spots with the labels and
    the noise that it knew when it estimated them. The sensitivities are multiplied by the symmetric positive matrix
    nearest to the identity, in the metric of the share, that gives this share: the optimal transport between two normal
    distributions. Source of that map: Olkin and Pukelsheim (1982), Linear Algebra Appl. 48.
    """
    model = SpotModel.of(rig)
    derivatives = model.derivatives(pose)
    J = derivatives.pose[rows]  # (m, 2, 6)
    S = Sensitivity(rig, model, covariance.names).of(derivatives)[rows].reshape(2 * len(rows), -1)
    flat = J.reshape(-1, 6)
    common = S @ covariance.matrix @ S.T
    weights: Array = np.asarray(np.linalg.inv(spots_px2), dtype=np.float64)
    for _ in range(2):  # with the noise alone, then with what the calibration leaves in the residuals
        JW = np.swapaxes(J, 1, 2) @ weights
        gain = np.linalg.solve(np.sum(JW @ J, axis=0), np.concatenate(list(JW), axis=1))
        used = weights
        left = np.eye(len(flat)) - flat @ gain
        residual = (left @ common @ left.T).reshape(len(rows), 2, len(rows), 2)
        left_over = residual[np.arange(len(rows)), :, np.arange(len(rows))]
        weights = np.asarray(np.linalg.inv(spots_px2 + left_over), dtype=np.float64)
    K = gain @ S
    adjusted = _transport(K @ covariance.matrix @ K.T, stated)
    return CalibrationShare(covariance, adjusted @ K, rows, used, adjusted)


def _transport(of: Array, to: Array) -> Array:
    """The symmetric positive matrix M (6, 6), in scaled units, with M of M^T = to."""
    unit = np.sqrt(np.maximum(np.diagonal(to), 1e-300))
    A, B = (symmetric(C / np.outer(unit, unit)) for C in (of, to))
    root = _power(A, 0.5)
    inverse = _power(A, -0.5)
    M = inverse @ _power(symmetric(root @ B @ root), 0.5) @ inverse
    return M * np.outer(unit, 1 / unit)


def _power(matrix: Array, exponent: float) -> Array:
    """A power of a positive semi-definite matrix; 0 in its null space."""
    values, vectors = np.linalg.eigh(matrix)
    kept = values > 1e-14 * max(float(values[-1]), 1e-300)
    return (vectors[:, kept] * values[kept] ** exponent) @ vectors[:, kept].T


@dataclass(frozen=True, slots=True)
class Expanded:
    """Combined and expanded uncertainties along `AXES` (..., 6), m and deg."""

    combined: Array
    degrees_of_freedom: Array  # effective; inf where no line is estimated from few values
    factor: Array  # coverage factor for `COVERAGE`
    expanded: Array


def expanded(variances: Array, degrees_of_freedom: Array) -> Expanded:
    """Of lines with variances (l, ..., 6) along `AXES`, which may be negative (correlations), and dof (l,)."""
    total = np.sum(variances, axis=0)
    dof = degrees_of_freedom.reshape(-1, *[1] * total.ndim)
    with np.errstate(divide="ignore", invalid="ignore"):
        effective = total**2 / np.sum(variances**2 / dof, axis=0)
    effective = np.where(np.isfinite(effective), effective, np.inf)
    factor = np.asarray(stdtrit(effective, 0.5 + 0.5 * COVERAGE), dtype=np.float64)
    combined = np.sqrt(np.maximum(total, 0.0))
    return Expanded(combined, effective, factor, factor * combined)


def monte_carlo(
    rig: Rig, share: CalibrationShare | None, pose: Pose, rest: Array, dof: float, draws: int, seed: int
) -> tuple[Array, Array]:
    """Standard and expanded uncertainty (6,) along `AXES` from `draws` measurements of one pose, as JCGM 101 has them.

    In each draw the rig is another one: its parameters are drawn from their covariance. The spots are projected with
    it, and the pose is solved from them with the nominal rig, both without linearisation. rest (6, 6): covariance of
    the errors of the pose that change from frame to frame, drawn from Student's distribution with `dof`. The expanded
    uncertainty is half the width of the probabilistically symmetric interval of probability `COVERAGE`.
    """
    rng = np.random.default_rng(seed)
    root = covariance_root(rest)
    error = rng.normal(size=(draws, root.shape[1])) @ root.T
    if np.isfinite(dof):
        error *= np.sqrt(dof / rng.chisquare(dof, size=(draws, 1)))
    if share is not None:
        error += _calibration_errors(rig, share, pose, draws, rng) @ share.adjusted.T
    measured = pose.plus(error)
    angles = np.rad2deg(np.angle(np.exp(1j * (measured.ypr - pose.ypr))))
    values = np.concatenate([measured.translation - pose.translation, angles], axis=-1)
    low, high = np.quantile(values, [0.5 - 0.5 * COVERAGE, 0.5 + 0.5 * COVERAGE], axis=0)
    return values.std(axis=0, ddof=1), 0.5 * (high - low)


def _calibration_errors(rig: Rig, share: CalibrationShare, pose: Pose, draws: int, rng: np.random.Generator) -> Array:
    """Errors (draws, 6) of poses solved with the nominal rig from the pixels of rigs that differ from it."""
    root = covariance_root(share.covariance.matrix)
    names = share.covariance.names
    pixels = np.empty((draws, len(share.rows), 2))
    for i in range(draws):
        other = perturbed_rig(rig, names, root @ rng.normal(size=root.shape[1]))
        pixels[i] = SpotModel.of(other).project(pose)[0][share.rows]
    model, W = SpotModel.of(rig).subset(share.rows), share.weights
    found = pose.plus(np.zeros((draws, 6)))
    for _ in range(_ITERATIONS):
        expected, J = model.project(found)
        JW = np.swapaxes(J, -1, -2) @ W  # (draws, m, 6, 2)
        H = np.sum(JW @ J, axis=1)
        g = np.sum(JW @ (pixels - expected)[..., None], axis=1)
        found = found.plus(np.linalg.solve(H, g)[..., 0])
    return found.minus(pose)


def along_axes(covariances: Array, pose: Pose) -> Array:
    """Variances (..., 6) along `AXES`, m^2 and deg^2, of covariances (..., 6, 6) of a pose, or of poses (...)."""
    T = axes_jacobian(pose.rotation)
    return np.diagonal(T @ covariances @ np.swapaxes(T, -1, -2), axis1=-2, axis2=-1)
