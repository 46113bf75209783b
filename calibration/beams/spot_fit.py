"""Robust adjustment to spots: outliers are detected with a Cauchy loss and then excluded.

The final values and their covariance are from plain least squares on the inliers, so that neither outliers nor
down-weighted spots affect them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from calibration.least_squares.adjustment import Adjusted, AdjustmentError, Cauchy, Free, Limits, Term, Values, solve
from calibration.terms.spot_term import SpotPixels, SpotTerm
from geometry.arrays import Array, Bools
from geometry.rig import Rig

P_OUTLIER = 1e-4  # probability that a correct spot is excluded
_MEDIAN_CHI2 = 2 * np.log(2)  # median of the chi-square with 2 degrees of freedom
_P_MISFIT = 1e-3  # p-value of chi-square below which the sigmas are increased
_ROUNDS = 8
# With changing weights the last digits converge slowly; for a start value less is sufficient.
_ROUGHLY = Limits(steps=120, small_step_sigmas=0.1)
_MOST_SCALE = 10.0  # largest factor on the stated sigmas; spots that scatter more are not of these beams


@dataclass(frozen=True, slots=True)
class SpotFit:
    """Adjustment of N spots."""

    adjusted: Adjusted  # terms: the kept spots first, then the others
    kept: Bools  # (N,): inliers
    residuals_px: Array  # (N, 2) measured minus predicted, of all spots
    sigmas: Array  # (N,) length of each residual in its stated sigmas
    scale: float  # factor on the stated sigmas from the scatter of the spots; 1 if they are consistent


def fit_spots(rig: Rig, spots: SpotPixels, values: Values, others: Sequence[Term], free: Free) -> SpotFit:
    """The adjustment to the spots and the other terms.

    If the inliers scatter significantly more than their sigmas, these are scaled up. They are never scaled down: larger
    ones are a safety margin of the user.

    Raises:
        AdjustmentError: fewer than half of the spots agree, or the adjustment does not converge.
    """
    every = SpotTerm(rig, spots)
    robust = solve(values, [SpotTerm(rig, spots, Cauchy()), *others], free, _ROUGHLY)
    now = robust.values
    kept = _near(every, now)
    for _ in range(_ROUNDS):
        if 2 * np.sum(kept) < len(spots):
            raise AdjustmentError(
                f"only {int(np.sum(kept))} of {len(spots)} spots are consistent: labels, stand positions or the"
                " calibration of cameras and screens are wrong"
            )
        found = solve(now, [SpotTerm(rig, spots.pick(kept)), *others], free)
        again = _near(every, found.values)
        now = found.values
        if np.array_equal(again, kept):
            break
        kept = again
    scale = 1.0
    if found.dof > 0 and found.chi2 > chdtri(found.dof, _P_MISFIT):
        scale = float(np.sqrt(found.chi2 / found.dof))
        wider = replace(spots.pick(kept), covariance=spots.pick(kept).covariance * scale**2)
        found = solve(now, [SpotTerm(rig, wider), *others], free)
    r = every.linearise(found.values).residuals
    roots = np.linalg.cholesky(spots.covariance)
    residuals_px = -(roots @ r[..., None])[..., 0]
    return SpotFit(found, kept, residuals_px, np.linalg.norm(r, axis=1), scale)


def _near(term: SpotTerm, values: Values) -> Bools:
    """Inliers, relative to the scatter of the better half of the spots."""
    s = np.sum(term.linearise(values).residuals ** 2, axis=1)
    unit = float(np.clip(np.median(s) / _MEDIAN_CHI2, 1.0, _MOST_SCALE**2))
    return s < unit * chdtri(2, P_OUTLIER)
