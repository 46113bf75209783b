"""Overlapping Allan deviation of a series of readings, with confidence limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from geometry.arrays import Array, Ints

LEAST_READINGS = 16
_LARGEST_SHARE = 4  # averages over at most the length / 4


@dataclass(frozen=True, slots=True)
class AllanDeviation:
    """Deviations at k averaging times."""

    tau_s: Array  # (k,)
    averaged: Ints  # (k,): readings in an average
    deviation: Array  # (k,), unit of the readings
    low: Array  # (k,): confidence limits
    high: Array  # (k,)
    freedom: Array  # (k,): equivalent degrees of freedom
    slope: Array  # (k,): d log deviation / d log tau; -1/2 white noise, 0 flicker noise, 1/2 random walk


def allan_deviation(readings: Array, step_s: float, confidence: float = 0.95) -> AllanDeviation:
    """The overlapping Allan deviation of evenly spaced readings (n,), at averaging times in octaves.

    sigma^2(tau) = < (next average - average)^2 > / 2. Limits: chi-square with the degrees of freedom of the noise that
    the local slope indicates. Source: Riley, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008), section 5.2
    and table 5 (readings take the place of the frequency data).

    Raises:
        ValueError: fewer than LEAST_READINGS readings, or one that is not finite.
    """
    readings = np.asarray(readings, dtype=float)
    n = len(readings)
    if n < LEAST_READINGS or not np.all(np.isfinite(readings)):
        raise ValueError(f"expected {LEAST_READINGS} finite readings or more")
    averaged = 2 ** np.arange(int(np.log2(n // _LARGEST_SHARE)) + 1)
    sums = np.concatenate([[0.0], np.cumsum(readings - readings.mean())])
    variance = np.empty(len(averaged))
    for k, m in enumerate(averaged.tolist()):
        mean = (sums[m:] - sums[:-m]) / m
        variance[k] = 0.5 * np.mean((mean[m:] - mean[:-m]) ** 2)
    deviation = np.sqrt(variance)
    slope = _slopes(deviation)
    freedom = np.array([_freedom(n + 1, m, s) for m, s in zip(averaged.tolist(), slope.tolist(), strict=True)])
    tail = 0.5 * (1 - confidence)
    low = deviation * np.sqrt(freedom / np.asarray(chi2.ppf(1 - tail, freedom), dtype=float))
    high = deviation * np.sqrt(freedom / np.asarray(chi2.ppf(tail, freedom), dtype=float))
    return AllanDeviation(np.asarray(averaged * step_s, dtype=float), averaged, deviation, low, high, freedom, slope)


def _slopes(deviation: Array) -> Array:
    """Slopes over the neighbouring octaves (k,), one-sided at the ends; zero where all readings are equal."""
    if np.any(deviation <= 0):
        return np.zeros(len(deviation))
    return np.asarray(np.gradient(np.log2(deviation)))


def _freedom(points: int, m: int, slope: float) -> float:
    """Equivalent degrees of freedom of the overlapping estimate from `points` phase points, m readings averaged."""
    N = float(points)
    if slope < -0.25:  # white noise of the readings
        edf = (3 * (N - 1) / (2 * m) - 2 * (N - 2) / N) * 4 * m**2 / (4 * m**2 + 5)
    elif slope < 0.25:  # flicker noise
        edf = 2 * (N - 2) / (2.3 * N - 4.9) * (N - 2) if m == 1 else 5 * N**2 / (4 * m * (N + 3 * m))
    else:  # random walk
        edf = (N - 2) / m * ((N - 1) ** 2 - 3 * m * (N - 1) + 4 * m**2) / (N - 3) ** 2
    return max(edf, 1.0)
