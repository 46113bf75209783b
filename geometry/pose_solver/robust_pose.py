"""The pose although one or two spots are wrong: each is left out in turn, and what fits without it decides."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from geometry.arrays import Array, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import PoseFit, SolveLimits, fit_pose, largest_chi2
from geometry.uncertainty.rig_uncertainty import CalibrationSpread

# Squared sigmas by which a pose from three spots may differ from the expected one (p = 1e-3 for six numbers).
EXPECTED_GATE = 22.5


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
    calibration: CalibrationSpread | None = None,
) -> PoseFit | None:
    """As `fit_pose`, but one or two spots may be wrong; they are then left out (missing from the result's rows).

    Where the chi-square test fails, each spot is left out in turn, and where that does not help and six are there, each
    pair. A set of four or more is chosen by its own misfit; three spots fit any labels, so there `expected`, a pose and
    its covariance (6, 6), must decide, and without it nothing is returned. noise_scale: how much larger than claimed
    the misfit is known to be (model error): the test is widened by it. None where no consistent set exists, or two
    sets are about equally good.
    """
    limits = SolveLimits() if limits is None else limits
    fit = fit_pose(model, rows, pixels, covariances, start, calibration=calibration)
    if fit is not None and _acceptable(fit, limits, noise_scale):
        return fit
    for left_out in (1, 2):
        if len(rows) - left_out < (3 if left_out == 1 else 4):
            return None
        sets = [
            found
            for leave in combinations(range(len(rows)), left_out)
            if (
                found := _without(
                    model, rows, pixels, covariances, start, list(leave), limits, noise_scale, expected, calibration
                )
            )
        ]
        if not sets:
            continue
        # At a bend the motion is far from every set, and says nothing about which is right.
        used_in_pose = expected is not None and min(distance for _, _, distance in sets) < EXPECTED_GATE
        scores = [misfit + (distance if used_in_pose else 0.0) for _, misfit, distance in sets]
        first, *others = np.argsort(scores, kind="stable")
        # 3 nats: below that it is a guess which spot is wrong.
        if others and scores[others[0]] - scores[first] < 6.0:
            return None
        return sets[first][0]
    return None


def _without(
    model: SpotModel,
    rows: Ints,
    pixels: Array,
    covariances: Array,
    start: Pose,
    leave: list[int],
    limits: SolveLimits,
    noise_scale: float,
    expected: tuple[Pose, Array] | None,
    calibration: CalibrationSpread | None,
) -> tuple[PoseFit, float, float] | None:
    """The fit without some spots, its misfit and its distance from the expected pose, both in squared sigmas.

    None unless it is consistent and the spots left out lie off it.
    """
    keep = np.ones(len(rows), dtype=bool)
    keep[leave] = False
    fit = fit_pose(model, rows[keep], pixels[keep], covariances[keep], start, calibration=calibration)
    if fit is None or not fit.observable or not _acceptable(fit, limits, noise_scale):
        return None
    left_at = fit.projected_px[rows[leave]]
    if np.any(np.linalg.norm(left_at - pixels[leave], axis=-1) < limits.min_outlier_px):
        return None
    misfit = fit.chi2 / noise_scale**2
    if expected is None:
        return (fit, misfit, 0.0) if fit.dof > 0 else None
    gap = fit.world_from_body.minus(expected[0])
    distance = float(gap @ np.linalg.solve(expected[1] + fit.covariance, gap))
    if (fit.dof <= 0 or len(leave) > 1) and distance > EXPECTED_GATE:
        return None  # three spots fit any labels, four of six many: at a bend nothing is chosen from them
    return fit, misfit, distance


def _acceptable(fit: PoseFit, limits: SolveLimits, noise_scale: float) -> bool:
    """Passes the chi-square test, or misfits by less than anyone calls an outlier."""
    if fit.dof <= 0 or fit.chi2 <= noise_scale**2 * largest_chi2(limits.p_false_alarm, fit.dof):
        return True
    return bool(np.all(np.linalg.norm(fit.residuals_px, axis=-1) < 0.5 * limits.min_outlier_px))
