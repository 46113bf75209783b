"""Candidates of the time offset between two motions, from the speeds, which do not depend on the frames."""

from __future__ import annotations

import numpy as np
from scipy.signal import fftconvolve

from geometry.arrays import Array
from tracking.comparison.motion import Motion, rates

_MOST_POINTS = 1 << 15
_LEAST_SHARE = 0.5  # of the shorter recording that must overlap
_LEAST_CORRELATION = 0.5  # of the largest one, for a candidate


def speeds_correlation(result: Motion, reference: Motion) -> tuple[Array, Array]:
    """Time offsets (k,), s, reference minus result, and the correlation (k,) of the speeds at these offsets.

    Rotation rates are used if both motions have attitudes, otherwise velocities.
    """
    rotating = result.rotation is not None and reference.rotation is not None
    part = slice(3, 6) if rotating else slice(0, 3)
    spans = [float(m.t_s[-1] - m.t_s[0]) for m in (result, reference)]
    step = max(min(result.step_s, reference.step_s), sum(spans) / _MOST_POINTS)
    series = []
    for motion, span in zip((result, reference), spans, strict=True):
        speed = np.linalg.norm(rates(motion)[:, part], axis=1)
        grid = motion.t_s[0] + step * np.arange(int(span / step) + 1)
        series.append(np.interp(grid, motion.t_s, speed))
    a, b = series
    ones_a, ones_b = np.ones(len(a)), np.ones(len(b))

    def correlate(x: Array, y: Array) -> Array:
        return np.asarray(fftconvolve(y, x[::-1]))

    a, b = a - a.mean(), b - b.mean()
    count = np.maximum(np.round(correlate(ones_a, ones_b)), 1.0)
    sum_a, sum_b = correlate(a, ones_b), correlate(ones_a, b)
    covariance = correlate(a, b) - sum_a * sum_b / count
    variance_a = correlate(a * a, ones_b) - sum_a**2 / count
    variance_b = correlate(ones_a, b * b) - sum_b**2 / count
    floor_a, floor_b = (1e-6 * float(np.sum(x * x)) + 1e-300 for x in (a, b))
    r = covariance / np.sqrt(np.maximum(variance_a, floor_a) * np.maximum(variance_b, floor_b))
    lags = np.arange(-(len(a) - 1), len(b))
    enough = count >= max(_LEAST_SHARE * min(len(a), len(b)), 2)
    offset = reference.t_s[0] - result.t_s[0] + step * lags
    return offset[enough], r[enough]


def offset_candidates(result: Motion, reference: Motion, most: int = 6) -> list[float]:
    """Offsets at the largest local maxima of the correlation of the speeds, best first."""
    offset, r = speeds_correlation(result, reference)
    if not len(r):
        return []
    padded = np.concatenate([[-np.inf], r, [-np.inf]])
    peaks = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] > padded[2:]))
    order = peaks[np.argsort(-r[peaks], kind="stable")]
    return [float(offset[i]) for i in order[:most] if r[i] >= _LEAST_CORRELATION * r[order[0]]]
