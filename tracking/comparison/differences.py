"""Differences of two aligned motions: statistics that allow for correlated errors, and Allan deviation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from geometry import rotations
from geometry.arrays import Array, Bools, Ints
from geometry.uncertainty.chi_square import chi2_limit
from tracking.comparison.estimation import Freedom, inverse_covariances
from tracking.comparison.frame_alignment import GAP, Alignment, PoseSeries, interpolate, residuals

_BLOCKS = 30  # of time, drawn with repetition: errors within one are correlated (block bootstrap)
_DRAWS = 200  # the sigma of a figure is known to 5 %
_MOST_FOR_MEDIAN = 20_000  # evenly spread: a limit of the time of the medians
_LEAST_PER_BLOCK = 2  # rows: of short recordings the blocks are fewer, not shorter


@dataclass(frozen=True, slots=True)
class Differences:
    """Aligned result minus reference at n times of the result; nan where the reference is not known."""

    reference_t_s: Array  # (n,): time of the reference's clock
    values: Array  # (n, 6): position (m, reference world), rotation vector (rad, reference body)
    sigmas: Array  # (n, 6): from the stated covariances of both
    ypr: Array  # (n, 3), rad: differences of yaw, pitch and roll, within +-pi
    chi2: Array  # (n,)
    compared: Bools  # (6,)
    known: Bools  # (n,)

    @property
    def freedom(self) -> int:
        """Components compared at a time."""
        return int(self.compared.sum())


def differences(result: PoseSeries, reference: PoseSeries, alignment: Alignment, gap: float = GAP) -> Differences:
    """Differences to the reference, interpolated at the result's times."""
    r = residuals(result, reference, alignment, gap)
    hidden = ~(r.known[:, None] & r.compared)
    variances = np.diagonal(r.result_covariance + r.reference_covariance, axis1=1, axis2=2)
    chi2 = np.einsum("ni,nij,nj->n", r.values, inverse_covariances(r), r.values)
    ypr = np.full((len(result), 3), np.nan)
    aligned = alignment.applied(result)
    at = alignment.reference_time(result.t_s)
    there = interpolate(reference, at, gap)
    if aligned.rotation is not None and there.rotation is not None:
        k = r.known
        change = rotations.ypr_from_matrix(aligned.rotation[k]) - rotations.ypr_from_matrix(there.rotation[k])
        ypr[k] = (change + np.pi) % (2 * np.pi) - np.pi
    return Differences(
        at,
        np.where(hidden, np.nan, -r.values),
        np.where(hidden, np.nan, np.sqrt(variances)),
        ypr,
        np.where(r.known, chi2, np.nan),
        r.compared,
        r.known,
    )


@dataclass(frozen=True, slots=True)
class Statistic:
    """One axis over all times; the sigmas are from a block bootstrap."""

    mean: float
    mean_sigma: float
    rms: float
    rms_sigma: float
    median: float  # of the sizes
    median_sigma: float
    largest: float  # size
    largest_index: int


def statistic(values: Array) -> Statistic | None:
    """Statistics of the finite values (n,); None where there are fewer than four.

    Sigmas: whole blocks of consecutive values are drawn with replacement, so that correlated values count as such
    (Kuensch 1989); nan where there are fewer than five blocks.
    """
    places = np.flatnonzero(np.isfinite(values))
    if len(places) < 4:
        return None
    v = values[places]
    size = np.abs(v)
    sigmas = _bootstrap_sigmas(v)
    largest = int(np.argmax(size))
    return Statistic(
        float(v.mean()),
        sigmas[0],
        float(np.sqrt(np.mean(v**2))),
        sigmas[1],
        float(np.median(size)),
        sigmas[2],
        float(size[largest]),
        int(places[largest]),
    )


def _bootstrap_sigmas(v: Array) -> tuple[float, float, float]:
    """Sigmas of the mean, the RMS and the median size of consecutive values (n,)."""
    v = v[:: max(1, len(v) // _MOST_FOR_MEDIAN)]
    blocks = min(_BLOCKS, len(v) // _LEAST_PER_BLOCK)
    if blocks < 5:
        return np.nan, np.nan, np.nan
    length = len(v) // blocks
    parts = v[: blocks * length].reshape(blocks, length)
    drawn: Ints = np.random.default_rng(0).integers(0, blocks, (_DRAWS, blocks))
    means, squares = parts.mean(axis=1), np.mean(parts**2, axis=1)
    medians = [float(np.median(np.abs(parts[d]))) for d in drawn]
    spread = blocks / (blocks - 1)
    return (
        float(np.std(means[drawn].mean(axis=1)) * np.sqrt(spread)),
        float(np.std(np.sqrt(squares[drawn].mean(axis=1))) * np.sqrt(spread)),
        float(np.std(medians) * np.sqrt(spread)),
    )


@dataclass(frozen=True, slots=True)
class ChiSquare:
    """Differences against the stated covariances."""

    factor: float  # chi-square per degree of freedom; 1 if the covariances are correct
    sigma: float
    within: float  # share of the times within the 95 % limit
    times: int


def chi_square(chi2: Array, coordinates: int, used: Bools, freedom: Freedom) -> ChiSquare:
    """Chi-square of the used times (n,), each of so many coordinates. freedom: what an alignment left of them."""
    rows = np.flatnonzero(used & np.isfinite(chi2))
    if not len(rows):
        return ChiSquare(np.nan, np.nan, np.nan, 0)
    each = chi2[rows]
    count = len(rows) * coordinates
    left = max(count - freedom.taken, 1.0)
    factor = float(each.sum() / left)
    # Blocks of time that hold few independent errors do not show their scatter.
    by_blocks = _bootstrap_sigmas(each)[0] / max(float(each.mean()), 1e-300)
    relative = max(by_blocks, float(np.sqrt(2 * freedom.alike * count)) / left)
    return ChiSquare(factor, factor * relative, float(np.mean(each <= chi2_limit(0.05, coordinates))), len(rows))


def longest_still(motion: PoseSeries, least: int) -> slice | None:
    """The longest stretch of consecutive evenly spaced times without motion beyond noise; None below `least` times.

    Means of ten samples before and after must agree within six sigmas of the stated noise of the angles.
    """
    if motion.rotation is None or len(motion) < least:
        return None
    half = 10
    angle = rotations.log(np.swapaxes(motion.rotation[:-1], -1, -2) @ motion.rotation[1:])
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(angle, axis=0)])
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(path, axis=0)])
    n = len(motion)
    mean = (sums[half:] - sums[:-half]) / half  # mean[i]: samples i to i + half - 1
    change = np.abs(mean[half:] - mean[:-half])  # [i]: about sample i + half
    sigma = np.sqrt(np.median(np.diagonal(motion.covariance, axis1=1, axis2=2)[:, 3:], axis=0))
    moving = np.zeros(n, dtype=bool)
    for i in np.flatnonzero(np.any(change > 6 * sigma * np.sqrt(2 / half), axis=1)).tolist():
        moving[i : i + 2 * half] = True
    uneven = np.abs(np.diff(motion.t_s) - motion.step_s) > 0.1 * motion.step_s
    best, start = slice(0, 0), 0
    for i in range(n + 1):
        if i == n or moving[i] or (i > start and uneven[i - 1]):
            if i - start > best.stop - best.start:
                best = slice(start, i)
            start = i + 1 if i < n and moving[i] else i
    return best if best.stop - best.start >= least else None


LEAST_READINGS = 16  # of an Allan deviation: octaves up to averages over four
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


def allan_deviation(readings: Array, step_s: float) -> AllanDeviation:
    """The overlapping Allan deviation of evenly spaced readings (n,), at averaging times in octaves.

    sigma^2(tau) = < (next average - average)^2 > / 2. Limits: chi-square with the degrees of freedom of the noise that
    the local slope indicates. Source: Riley, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008), section 5.2
    and table 5 (readings take the place of the frequency data). Raises ValueError: fewer than LEAST_READINGS readings,
    or one that is not finite.
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
    tail = 0.025  # limits of 95 %
    low = deviation * np.sqrt(freedom / np.asarray(2 * gammaincinv(freedom / 2, 1 - tail), dtype=float))
    high = deviation * np.sqrt(freedom / np.asarray(2 * gammaincinv(freedom / 2, tail), dtype=float))
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
