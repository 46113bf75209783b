"""Robust updates of the unscented Kalman filter: a Mahalanobis gate and Student's t noise.

Both take the place of `ukf.update` and have no memory of their own.
"""

from __future__ import annotations

from geometry.arrays import Array
from geometry.uncertainty.chi_square import chi2_limit
from tracking.unscented.sigma_points import NUMBERS, USUAL, Function, Space, Spread
from tracking.unscented.ukf import Measured, Updated


def gated_update(
    x: Array,
    P: Array,
    z: Array,
    measurement: Function,
    R: Array,
    spread: Spread = USUAL,
    space: Space = NUMBERS,
    of: Space = NUMBERS,
    *,
    p_false_alarm: float = 1e-3,
) -> Updated:
    """As `ukf.update`, but a measurement whose normalised innovation is too large is not used.

    p_false_alarm: probability that a correct measurement is left out. The gate is closed for as long as the prediction
    is wrong by more than its sigmas say: after a long disturbance it can stay closed. Use it where the process noise
    covers the motion; otherwise use `student_t_update`.

    Raises:
        ValueError: as `ukf.update`.
    """
    compared = Measured.of(x, P, z, measurement, R, spread, space, of)
    return compared.update(1.0 if compared.nis() <= chi2_limit(p_false_alarm, len(z)) else 0.0)


def student_t_update(
    x: Array,
    P: Array,
    z: Array,
    measurement: Function,
    R: Array,
    spread: Spread = USUAL,
    space: Space = NUMBERS,
    of: Space = NUMBERS,
    *,
    dof: float = 4.0,
    p_full_weight: float = 1e-2,
    power: float = 2.0,
) -> Updated:
    """As `ukf.update`, with heavy tails of the measurement noise where the innovation is unlikely.

    R is divided by the weight w = ((dof + limit) / (dof + nis))^power, at most 1, with the chi-square limit of
    `p_full_weight`: measurements that fit a Gaussian keep their full weight, so the filter equals the standard one
    while nothing is wrong. A measurement is never left out entirely, so the filter recovers after any disturbance.
    power 1 is the weight of the multivariate t distribution; with it the effect of an outlier decreases as 1 / size. A
    slow disturbance of many frames needs a faster decrease. Measured (`beampose study fu2016`): with power 2 the peaks
    during a smooth error of 2 m are about half of those with power 1; power 3 is no better.

    Raises:
        ValueError: as `ukf.update`.

    Source: Roth, Ozkan & Gustafsson, "A Student's t filter for heavy tailed process and measurement noise", ICASSP
    2013, for the weight; limit and power are ours.
    """
    compared = Measured.of(x, P, z, measurement, R, spread, space, of)
    limit = chi2_limit(p_full_weight, len(z))
    return compared.update(min(1.0, (dof + limit) / (dof + compared.nis())) ** power)
