"""Noise of rounded and clipped grey values: corrections for rounding in time and for a background clipped at zero."""

from __future__ import annotations

from math import erf
from statistics import NormalDist

import numpy as np

from geometry.arrays import Array

_LEAST_SHARE, _LARGEST_SHARE = 0.005, 0.98  # usable shares of values above a threshold; rarer values may be light


def clipped_normal(values: Array) -> tuple[float, float]:
    """Mean and sigma, in steps, of values (m,) that were rounded to whole steps and clipped at 0.

    The share of values of at least k steps is 1 - Phi((k - 1/2 - mean) / sigma): a straight line through the normal
    quantiles of these shares (probit regression) gives both. With one usable share the mean is assumed to be zero,
    unless then more values would be a step higher than there are. Source: ours.
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
        rarest = -NormalDist().inv_cdf(_LEAST_SHARE)
        sigma = min(edge[0] / max(z[0], 0.2), 1.0 / max(rarest - z[0], 0.2))
        return float(max(edge[0] - sigma * z[0], 0.0)), float(sigma)
    sigma, mean = np.polyfit(z, edge, 1)
    return float(mean), float(max(sigma, 0.0))


def rounding_ripple(variance: Array, rounding: float) -> Array:
    """Amplitude, DN^2, of the variance of rounded values as a function of the level's position between two steps.

    The first term of its Fourier series: (1 / pi^2 + 4 s^2) exp(-2 pi^2 s^2) for noise of s steps.
    """
    noise = np.maximum(variance / (12 * rounding) - 1 / 12, 0.0)
    return np.asarray((1 / np.pi**2 + 4 * noise) * np.exp(-2 * np.pi**2 * noise) * 12 * rounding)


def banding(variance: float, rounding: float) -> float:
    """Sigma, DN, of the rounding error that neighbouring pixels share, given the variance of noise and rounding.

    Noise of s steps blurs the steps of the grey scale to exp(-2 pi^2 s^2) of their height (the fundamental's).
    """
    noise = max(variance / (12 * rounding) - 1 / 12, 0.0)
    return float(np.sqrt(rounding) * np.exp(-2 * np.pi**2 * noise))


def unrounded(variance: float, rounding: float) -> float:
    """The variance of noise and rounding, DN^2, from the variance in time of rounded values.

    With little noise a value is rounded to the same number in every picture, and that part of its error is constant in
    time. Averaged over all positions between two steps, the variance in time for noise of sigma s (in steps) is the
    mean of p (1 - p), with p the normal integral: s / sqrt(pi) for small s, s^2 + 1/12 for large s.
    """
    in_steps = variance / (12 * rounding)
    noise = float(np.interp(in_steps, _IN_TIME, _NOISE_STEPS**2)) if in_steps < _IN_TIME[-1] else in_steps - 1 / 12
    return (noise + 1 / 12) * 12 * rounding


def _variance_in_time(sigma: float) -> float:
    """Variance of rounded normal deviates of this sigma, in steps, averaged over the position between two steps."""
    level = (np.arange(64) + 0.5) / 64
    edges = np.arange(-6, 8) - 0.5
    below = np.array([[erf(x) for x in row] for row in (edges - level[:, None]) / (np.sqrt(2.0) * sigma)]) / 2
    share, value = np.diff(below, axis=1), np.arange(-6, 7)
    return float(np.mean(share @ value**2 - (share @ value) ** 2))


# Of the table, in steps of the numbers:
_NOISE_STEPS = np.array([0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.8])
_IN_TIME = np.array([0.0] + [_variance_in_time(float(s)) for s in _NOISE_STEPS[1:]])
