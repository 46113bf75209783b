"""An adjustment to spots of which some are wrong: outliers fade, then are left out and named.

A Cauchy loss finds the bulk; what lies off it is left out, and plain least squares on the rest gives the values and
their covariance, so that neither a wrong spot nor a fading weight takes part in what is claimed.
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

P_OUTLIER = 1e-4  # of a good spot to be left out: one in 10 000
_MEDIAN_CHI2 = 2 * np.log(2)  # of squared sigmas of two numbers
_P_MISFIT = 1e-3  # of a right fit to be said to misfit
_ROUNDS = 8
# With weights that change from step to step the last digits settle slowly, and it is only a start.
_ROUGHLY = Limits(steps=120, small_step_sigmas=0.1)
_MOST_SCALE = 10.0  # told sigmas may be so much too small; what scatters more was not made by these beams


@dataclass(frozen=True, slots=True)
class SpotFit:
    """N spots adjusted."""

    adjusted: Adjusted  # terms: the kept spots first, then the others
    kept: Bools  # (N,)
    residuals_px: Array  # (N, 2) found minus predicted, of all spots
    sigmas: Array  # (N,) size of each residual in the sigmas that were told, of two numbers
    scale: float  # what the told sigmas were multiplied with, since the spots scatter more; 1 where they do not


def fit_spots(rig: Rig, spots: SpotPixels, values: Values, others: Sequence[Term], free: Free) -> SpotFit:
    """Values that fit the spots and the other terms best. Raises AdjustmentError where that does not settle.

    Where the kept spots scatter significantly more than their sigmas say, these are scaled up, never down: too large
    ones are a user's safety margin.
    """
    every = SpotTerm(rig, spots)
    robust = solve(values, [SpotTerm(rig, spots, Cauchy()), *others], free, _ROUGHLY)
    now = robust.values
    kept = _near(every, now)
    for _ in range(_ROUNDS):
        if 2 * np.sum(kept) < len(spots):
            raise AdjustmentError(
                f"only {int(np.sum(kept))} of {len(spots)} spots agree with each other: labels, stand positions or the"
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
    """Which spots lie where a good one may, by the scatter of the better half."""
    s = np.sum(term.linearise(values).residuals ** 2, axis=1)
    unit = float(np.clip(np.median(s) / _MEDIAN_CHI2, 1.0, _MOST_SCALE**2))
    return s < unit * chdtri(2, P_OUTLIER)
