"""Long series reduced to what a screen can show, without losing extremes or gaps."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools


def true_ranges(mask: Bools) -> list[tuple[int, int]]:
    """First index and one past the last index of each run of True in (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(mask, dtype=np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def envelope(x: Array, y: Array, bins: int) -> tuple[Array, Array]:
    """A line of n points reduced to at most 2 * bins points that draws the same.

    Keeps the smallest and the largest value of each bin, in their order, so that no spike is lost. A bin without a
    finite value stays a gap.
    """
    n = len(x)
    if n <= 2 * bins:
        return x, y
    per_bin = -(-n // bins)
    padded = np.full(per_bin * bins, np.nan)
    padded[:n] = y
    block = padded.reshape(bins, per_bin)
    low = np.argmin(np.where(np.isnan(block), np.inf, block), axis=1)
    high = np.argmax(np.where(np.isnan(block), -np.inf, block), axis=1)
    order = np.sort(np.stack([low, high], -1), axis=1) + per_bin * np.arange(bins)[:, None]
    at = np.minimum(order.ravel(), n - 1)
    return x[at], padded[order.ravel()]


def band_envelope(x: Array, low: Array, high: Array, bins: int) -> tuple[Array, Array, Array]:
    """A band of n points reduced to at most `bins` points: the smallest low and the largest high of each bin."""
    n = len(x)
    if n <= bins:
        return x, low, high
    starts = np.arange(0, n, -(-n // bins))
    lows = np.minimum.reduceat(np.where(np.isnan(low), np.inf, low), starts)
    highs = np.maximum.reduceat(np.where(np.isnan(high), -np.inf, high), starts)
    return x[starts], np.where(np.isinf(lows), np.nan, lows), np.where(np.isinf(highs), np.nan, highs)


def true_shares(mask: Bools, n_columns: int) -> list[tuple[float, float]]:
    """The runs of True in (n,) as shares 0..1 of the length; runs within one of the n columns are joined."""
    n = len(mask)
    if n > n_columns:
        column = np.arange(n) * n_columns // n
        mask = np.bincount(column, weights=mask.astype(float), minlength=n_columns) > 0
        n = n_columns
    return [(start / n, stop / n) for start, stop in true_ranges(mask)]
