"""The pose although one or two spots are wrong: each spot or pair is left out in turn, and the consistent fit wins."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from geometry.arrays import Array, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import PoseFit, SolveLimits, fit_pose
from geometry.uncertainty.chi_square import chi2_limit
from geometry.uncertainty.rig_uncertainty import RigUncertainty

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
