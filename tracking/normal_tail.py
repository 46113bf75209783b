"""Mean and sigma of a normal distribution of which the lower part is clipped at zero and the rest is rounded."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from geometry.arrays import Array

_LEAST_SHARE, _LARGEST_SHARE = 0.005, 0.98  # of the values above a threshold: more rare ones may be light


def clipped_normal(values: Array) -> tuple[float, float]:
    """Mean and sigma, in steps, of numbers (m,) that were rounded to whole steps and clipped at 0.

    The share of values of at least k steps is 1 - Phi((k - 1/2 - mean) / sigma): a straight line through the normal
    quantiles of these shares (probit regression) gives both. With one usable share the mean is taken to be zero. Ours.
    """
    thresholds = np.unique(np.quantile(values, np.linspace(0.02, 0.995, 25)).round())
    thresholds = np.unique(np.append(thresholds, [1.0, 2.0, 3.0]))
    thresholds = thresholds[thresholds >= 1]
    shares = np.array([np.mean(values >= k) for k in thresholds])
    good = (shares > _LEAST_SHARE) & (shares < _LARGEST_SHARE)
    if not good.any():
        return 0.0, 0.0
    z = np.array([-NormalDist().inv_cdf(float(s)) for s in shares[good]])
    edge = thresholds[good] - 0.5
    if len(z) == 1 or np.ptp(z) < 1e-3:
        return 0.0, float(edge[0] / max(z[0], 0.2))
    sigma, mean = np.polyfit(z, edge, 1)
    return float(mean), float(max(sigma, 0.0))
