"""The pose from labelled spots: weighted Gauss-Newton on pixel residuals, its covariance, and observability.

Source: ours; Gauss-Newton on the error state [dt, dtheta] of section 1 of the file contract, with the forward model of
geometry/forward_model.py and its analytic Jacobian.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Protocol

import numpy as np

from geometry.arrays import Array, Bools, Ints, symmetric
from geometry.compilation.jit import compiled
from geometry.compiled_linalg import (
    apply,
    dot,
    multiply,
    pose_minus,
    pose_plus,
    solve,
    transposed_apply,
    transposed_multiply,
)
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.uncertainty.chi_square import chi2_limit
from geometry.uncertainty.rig_uncertainty import RigUncertainty

# Relative size below which a singular value of the whitened Jacobian counts as zero. Exact degeneracies (three spots of
# one screen are collinear in every pose) give 1e-13 and less; the worst usable geometry gives about 1e-4.
RANK_TOLERANCE = 1e-7

# If the start is farther from the solution than this, the effect of the calibration's errors is computed again: within
# it, the sigmas of the pixels change by up to some per cent.
NEAR_M, NEAR_RAD = 0.05, np.deg2rad(1.0)
_MOST_ITERATIONS = 25
_LEAST_GAINED = 0.25  # of the predicted gain, below which the damping rises: Marquardt's rule


class PoseModel(Protocol):
    """A forward model of n views: geometry/forward_model.py, of spots or of markers on the body."""

    def project(self, world_from_body: Pose) -> tuple[Array, Array]:
        """Pixels (n, 2) and their Jacobian (n, 2, 6) by the pose error; nan where there is no projection."""


class CommonErrors(Protocol):
    """Errors of the pixels that are the same in every frame: of a calibration, of surveyed markers."""

    def at(self, world_from_body: Pose) -> Array:
        """Their covariance (2n, 2n), px^2, for all views at a pose."""


@dataclass(frozen=True, slots=True)
class SolveLimits:
    """Conditions under which the pose of one frame counts as measured."""

    max_sigma_m: float = 0.25  # largest sigma of any direction of position, m
    max_sigma_rad: float = np.deg2rad(5.0)  # the same of attitude, rad: first-order covariances are invalid beyond it
    p_false_alarm: float = 1e-5  # probability that a correct set of spots fails the chi-square test
    min_outlier_px: float = 0.1  # smallest residual of an outlier: smaller ones are errors of the model

    def hold(self, covariance: Array) -> Bools:
        """Whether the sigmas of poses with covariances (..., 6, 6) are within the limits in all directions."""
        m, rad = (np.sqrt(np.linalg.eigvalsh(covariance[..., i, i])[..., -1]) for i in (slice(0, 3), slice(3, 6)))
        return np.asarray((m <= self.max_sigma_m) & (rad <= self.max_sigma_rad))


@dataclass(frozen=True, slots=True)
class PoseFit:
    """A pose fitted to m labelled spots."""

    world_from_body: Pose
    covariance: Array  # (6, 6) of [dt (m, world), dtheta (rad, body)]; inf where not observable
    systematic: Array  # (6, 6) its part due to the calibration's errors; 0 if their covariance is not known
    systematic_share: float  # share, 0 ... 1, of the expected chi2 that is the same in every frame
    observable: bool
    rows: Ints  # (m,) the used views
    residuals_px: Array  # (m, 2) measured minus fitted
    chi2: float  # of the whitened residuals
    dof: int  # 2 m - 6
    projected_px: Array  # (n, 2) pixels of all views of the model at this pose, from SpotModel.project, and ...
    jacobian: Array  # (n, 2, 6) ... their Jacobians: kept so that the pose need not be projected again
    _gain: Array  # (6, 2m) derivative of the pose by the measured pixels
    _common: Array | None  # (2n, 2n) covariance of the pixels, px^2, due to the calibration's errors

    @property
    def noise(self) -> Array:
        """The part (6, 6) of the covariance that is independent from frame to frame."""
        return self.covariance if self._common is None else self.covariance - self.systematic

    def widened(self, factor: float) -> PoseFit:
        """The same fit with all its covariances multiplied by a factor."""
        return replace(self, covariance=self.covariance * factor, systematic=self.systematic * factor)

    def spot_covariances(self) -> Array:
        """Covariances (n, 2, 2), px^2, of the predicted pixels of all views, without the noise of a measurement.

        Errors of the calibration move a spot and, through the pose, its prediction too; their common part cancels.
        """
        return pixel_covariance(self.jacobian, self.noise) + self.calibration_px()

    def calibration_px(self) -> Array | float:
        """The calibration's part of `spot_covariances`: (n, 2, 2), px^2; 0 if its covariance is not known."""
        if self._common is None:
            return 0.0
        n = len(self.jacobian)
        left = np.eye(2 * n)
        left[:, coordinates_of(self.rows)] -= np.nan_to_num(self.jacobian.reshape(2 * n, 6)) @ self._gain
        joint = (left @ self._common @ left.T).reshape(n, 2, n, 2)
        return np.asarray(joint[np.arange(n), :, np.arange(n)])

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals per axis, px; nan without spots."""
        return float(np.sqrt(np.mean(self.residuals_px**2))) if len(self.rows) else float("nan")

    def consistent(self, p_false_alarm: float) -> bool:
        """Whether the residuals pass the chi-square test with this probability of a false alarm."""
        return self.dof <= 0 or self.chi2 <= chi2_limit(p_false_alarm, self.dof)


def whiten(covariances: Array) -> Array:
    """Matrices W (..., 2, 2) with W C W^T = I, for covariances C (..., 2, 2): the inverse of the Cholesky factor."""
    a, b, c = covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]
    l11 = np.sqrt(a)
    l21 = b / l11
    l22 = np.sqrt(np.maximum(c - l21 * l21, 1e-300))
    W = np.zeros_like(covariances)
    W[..., 0, 0] = 1 / l11
    W[..., 1, 0] = -l21 / (l11 * l22)
    W[..., 1, 1] = 1 / l22
    return W


def fit_pose(
    model: PoseModel,
    rows: Ints,
    pixels: Array,
    covariances: Array,
    start: Pose,
    calibration: CommonErrors | None = None,
) -> PoseFit | None:
    """The least-squares pose of the spots of views `rows` (m,) at `pixels` (m, 2), with covariances (m, 2, 2), px^2.

    start: the first pose; an error of some ten degrees is allowed. calibration: the covariance of its errors is added
    to that of the spots, and its effect on the pose is the systematic part. Levenberg's damping keeps steps from a poor
    start bounded. None if the iteration does not converge (a spot loses its projection on the way, or the start is
    singular).
    """
    if len(rows) == 0:
        return None
    rows = np.asarray(rows)
    if calibration is None:
        return _fit(model, rows, pixels, covariances, start, None)
    common = calibration.at(start)
    fit = _fit(model, rows, pixels, covariances, start, common)
    if fit is None:
        return None
    error_of_start = pose_minus(*_arrays(fit.world_from_body), *_arrays(start))
    if np.linalg.norm(error_of_start[:3]) < NEAR_M and np.linalg.norm(error_of_start[3:]) < NEAR_RAD:
        return fit
    common = calibration.at(fit.world_from_body)
    return _fit(model, rows, pixels, covariances, fit.world_from_body, common)


def _fit(
    model: PoseModel,
    rows: Ints,
    pixels: Array,
    covariances: Array,
    start: Pose,
    common: Array | None,
) -> PoseFit | None:
    """As `fit_pose`, with the covariance (2n, 2n), px^2, of all pixels due to the calibration's errors, or None."""
    if common is None:
        W = _blocks(whiten(covariances))
    else:
        S = common[np.ix_(coordinates_of(rows), coordinates_of(rows))]
        W = np.linalg.inv(np.linalg.cholesky(_blocks(covariances) + S))
    pose, damping = Pose(*_arrays(start)), 0.0
    terms = _terms(model, rows, pixels, W, pose)
    if terms is None:
        return None
    H, g, cost, residuals, projected, J = terms
    for _ in range(_MOST_ITERATIONS):
        step, gain = _damped_step(H, g, damping)
        if not np.isfinite(gain):
            return None
        raised = max(10 * damping, 1e-3)
        trial = Pose(*pose_plus(pose.rotation, pose.translation, step))
        trial_terms = _terms(model, rows, pixels, W, trial)
        if trial_terms is None or trial_terms[2] > cost * (1 + 1e-9) + 1e-12:
            damping = raised
            if damping > 1e8:
                break
            continue
        # Where residuals bend the cost, whole steps go to and fro across the minimum and gain less than predicted.
        poor = cost - trial_terms[2] < _LEAST_GAINED * gain
        pose, (H, g, cost, residuals, projected, J) = trial, trial_terms
        damping = raised if poor else damping / 10 if damping > 1e-6 else 0.0
        if gain < 1e-6:  # squared sigmas: the step was 1e-3 sigmas, and the remaining error is about its square
            break
    else:
        return None
    covariance, observable = covariance_of(H)
    dof = 2 * len(rows) - 6
    K, systematic, share = np.zeros((6, 2 * len(rows))), np.zeros((6, 6)), 0.0
    if common is not None and observable:
        A = W @ J[rows].reshape(-1, 6)
        K = covariance @ A.T @ W
        systematic = symmetric(K @ S @ K.T)
        left = W @ S @ W.T
        share = float(np.trace(left) - np.trace(covariance @ A.T @ left @ A)) / dof if dof > 0 else 0.0
    return PoseFit(
        world_from_body=pose,
        covariance=covariance,
        systematic=systematic,
        systematic_share=share,
        observable=observable,
        rows=rows,
        residuals_px=residuals,
        chi2=cost,
        dof=dof,
        projected_px=projected,
        jacobian=J,
        _gain=K,
        _common=common if observable else None,
    )


def coordinates_of(rows: Ints) -> Ints:
    """Indices (2m,) of u and v of m views among the coordinates of all views."""
    return np.ravel(2 * rows[:, None] + np.arange(2))


def _blocks(covariances: Array) -> Array:
    """Covariances (m, 2, 2) as one block-diagonal matrix (2m, 2m)."""
    m = len(covariances)
    out = np.zeros((m, 2, m, 2))
    out[np.arange(m), :, np.arange(m)] = covariances
    return out.reshape(2 * m, 2 * m)


def _terms(
    model: PoseModel, rows: Ints, pixels: Array, W: Array, pose: Pose
) -> tuple[Array, Array, float, Array, Array, Array] | None:
    """Normal matrix (6, 6), right-hand side (6,), cost, residuals (m, 2), px, pixels (n, 2) and Jacobians (n, 2, 6).

    W (2m, 2m): whitening matrix. None if a spot has no projection.
    """
    projected, J = model.project(pose)
    residuals = pixels - projected[rows]
    if np.isnan(residuals).any():
        return None
    H, g, cost = _normal_equations(W, np.ascontiguousarray(J[rows].reshape(-1, 6)), residuals.ravel())
    return H, g, cost, residuals, projected, J


@compiled
def _normal_equations(W: Array, J: Array, residuals: Array) -> tuple[Array, Array, float]:
    """Normal matrix (6, 6), right-hand side (6,) and cost of residuals (k,) with Jacobian J (k, 6), whitened by W."""
    A, r = multiply(W, J), apply(W, residuals)
    return transposed_multiply(A, A), transposed_apply(A, r), dot(r, r)


@compiled
def _damped_step(H: Array, g: Array, damping: float) -> tuple[Array, float]:
    """Levenberg-Marquardt step (6,), and the cost that it gains; not finite where H (6, 6) is 0."""
    A, trace = H.copy(), 0.0
    for i in range(6):
        trace += H[i, i]
    for i in range(6):
        # The smallest damping affects only directions that no spot observes; elsewhere it is far below rounding.
        A[i, i] += (damping + 1e-14) * max(H[i, i], 1e-12 * trace)
    x, _ = solve(A, g.copy().reshape(6, 1))
    step = x[:, 0].copy()
    return step, dot(step, g)


def _arrays(pose: Pose) -> tuple[Array, Array]:
    """Rotation and translation for compiled functions: copies, since read-only arrays are of another type."""
    return np.array(pose.rotation, dtype=float, order="C"), np.array(pose.translation, dtype=float)


def covariance_of(H: Array) -> tuple[Array, bool]:
    """Covariance (6, 6) of a normal matrix (6, 6), and whether that has full rank; if not, all entries are inf."""
    covariance, full_rank = covariances_of(H[None])
    return covariance[0], bool(full_rank[0])


def covariances_of(H: Array) -> tuple[Array, Bools]:
    """As `covariance_of`, of normal matrices (n, 6, 6): covariances (n, 6, 6), and which have full rank (n,)."""
    eigenvalues, vectors = np.linalg.eigh(symmetric(H))
    full_rank: Bools = eigenvalues[:, 0] > (RANK_TOLERANCE**2) * eigenvalues[:, -1]
    out = np.full(H.shape, np.inf)
    v = vectors[full_rank]
    out[full_rank] = (v / eigenvalues[full_rank][:, None]) @ np.swapaxes(v, 1, 2)
    return out, full_rank


def is_measurement(fit: PoseFit, limits: SolveLimits) -> bool:
    """Whether a fit is a measurement of the pose: full rank, and no sigma of any direction above the limits."""
    return fit.observable and bool(limits.hold(fit.covariance))


def pixel_covariance(J: Array, covariance: Array) -> Array:
    """Covariances (..., 2, 2), px^2, of pixels due to a pose covariance C (6, 6): J C J^T, J (..., 2, 6)."""

    return J @ covariance @ np.swapaxes(J, -1, -2)


# The pose although one or two spots are wrong: each spot or pair is left out in turn, and the consistent fit wins.


# Squared sigmas by which a pose from three spots may differ from the expected one (p = 1e-3 for six numbers).
EXPECTED_GATE = 22.5
# Lead in squared sigmas (3 nats) that the best set of spots must have over the second best.
CLEAR_LEAD = 6.0


@dataclass(frozen=True, slots=True)
class _LabelledSpots:
    """m spots with their labels, and everything that fits of subsets of them share."""

    model: SpotModel
    rows: Ints  # (m,) views
    pixels: Array  # (m, 2), px
    covariances: Array  # (m, 2, 2), px^2
    start: Pose
    expected: tuple[Pose, Array] | None
    limits: SolveLimits
    noise_scale: float
    calibration: RigUncertainty | None

    def fit(self, keep: Ints) -> PoseFit | None:
        """The fit to some of the spots."""
        return fit_pose(
            self.model,
            self.rows[keep],
            self.pixels[keep],
            self.covariances[keep],
            self.start,
            calibration=self.calibration,
        )

    def acceptable(self, fit: PoseFit) -> bool:
        """Whether a fit passes the chi-square test, or all its residuals are smaller than any outlier."""
        if fit.dof <= 0 or fit.chi2 <= self.noise_scale**2 * chi2_limit(self.limits.p_false_alarm, fit.dof):
            return True
        return bool(np.all(np.linalg.norm(fit.residuals_px, axis=-1) < 0.5 * self.limits.min_outlier_px))

    def without(self, leave: tuple[int, ...]) -> tuple[PoseFit, float, float] | None:
        """The fit without some spots, its misfit and its distance from the expected pose, both in squared sigmas.

        None unless the fit is consistent and the spots left out are outliers of it.
        """
        left_out = np.array(leave)
        fit = self.fit(np.setdiff1d(np.arange(len(self.rows)), left_out))
        if fit is None or not fit.observable or not self.acceptable(fit):
            return None
        predicted = fit.projected_px[self.rows[left_out]]
        if np.any(np.linalg.norm(predicted - self.pixels[left_out], axis=-1) < self.limits.min_outlier_px):
            return None
        misfit = fit.chi2 / self.noise_scale**2
        if self.expected is None:
            return (fit, misfit, 0.0) if fit.dof > 0 else None
        gap = fit.world_from_body.minus(self.expected[0])
        distance = float(gap @ np.linalg.solve(self.expected[1] + fit.covariance, gap))
        if (fit.dof <= 0 or len(leave) > 1) and distance > EXPECTED_GATE:
            return None  # three spots fit any labels and four of six fit many: during a manoeuvre no choice is safe
        return fit, misfit, distance


def fit_pose_robust(
    model: SpotModel,
    rows: Ints,
    pixels: Array,
    covariances: Array,
    start: Pose,
    *,
    expected: tuple[Pose, Array] | None = None,
    limits: SolveLimits | None = None,
    noise_scale: float = 1.0,
    calibration: RigUncertainty | None = None,
) -> PoseFit | None:
    """As `fit_pose`, but one or two spots may be wrong; they are then left out (missing from the result's rows).

    If the chi-square test fails, each spot is left out in turn, and if that does not help and there are six, each pair.
    A set of four or more spots is chosen by its own misfit. Three spots fit any labels, so for them `expected`, a pose
    and its covariance (6, 6), must decide; without it the result is None. noise_scale: ratio of the known misfit (model
    error) to the stated sigmas; it widens the test. None if no consistent set exists or two sets are about equally
    good.
    """
    limits = SolveLimits() if limits is None else limits
    spots = _LabelledSpots(model, rows, pixels, covariances, start, expected, limits, noise_scale, calibration)
    fit = spots.fit(np.arange(len(rows)))
    if fit is not None and spots.acceptable(fit):
        return fit
    for left_out in (1, 2):
        if len(rows) - left_out < (3 if left_out == 1 else 4):
            return None
        sets = [found for leave in combinations(range(len(rows)), left_out) if (found := spots.without(leave))]
        if not sets:
            continue
        # During a manoeuvre the predicted motion is far from every set and does not help to choose.
        use_expected = expected is not None and min(distance for _, _, distance in sets) < EXPECTED_GATE
        scores = [misfit + (distance if use_expected else 0.0) for _, misfit, distance in sets]
        first, *others = np.argsort(scores, kind="stable")
        if others and scores[others[0]] - scores[first] < CLEAR_LEAD:
            return None
        return sets[first][0]
    return None
