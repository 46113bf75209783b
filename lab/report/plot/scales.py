"""Scales: linear maps from values to drawing coordinates, ranges, ticks and their labels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array


@dataclass(frozen=True, slots=True)
class Scale:
    """A linear map from values lo..hi to drawing coordinates a..b."""

    lo: float
    hi: float
    a: float
    b: float

    def __call__(self, values: Array) -> Array:
        """Drawing coordinates of values, any shape."""
        return self.a + (np.asarray(values, dtype=float) - self.lo) * (self.b - self.a) / (self.hi - self.lo)


def ticks(lo: float, hi: float, about: int) -> Array:
    """Round numbers between lo and hi, roughly `about` of them, in steps of 1, 2 or 5 times a power of ten."""
    raw = (hi - lo) / max(about, 1)
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * min((m for m in (1, 2, 5, 10) if m * power >= raw * 0.999), default=10)
    first = np.ceil(lo / step - 1e-9)
    return step * np.arange(first, np.floor(hi / step + 1e-9) + 1) + 0.0  # + 0.0: no negative zero


def tick_texts(values: Array) -> list[str]:
    """Labels of ticks, with as many decimals as are needed to distinguish them, and a true minus sign."""
    step = float(np.min(np.diff(values))) if len(values) > 1 else abs(float(values[0])) if len(values) else 1.0
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9))) if step > 0 else 0
    return [f"{0.0 if abs(v) < step / 2 else v:.{min(decimals, 9)}f}".replace("-", "\u2212") for v in values]


def number(value: float, digits: int = 3) -> str:
    """A number with at most `digits` significant digits, without trailing zeros, and a true minus sign."""
    return f"{value:.{digits}g}".replace("-", "\u2212")


def padded_range(values: Array, margin: float = 0.06) -> tuple[float, float]:
    """The range of the finite values with a small margin; never empty."""
    finite = values[np.isfinite(values)]
    lo, hi = (float(finite.min()), float(finite.max())) if finite.size else (-1.0, 1.0)
    pad = max(margin * (hi - lo), 1e-9, 1e-6 * abs(hi))
    return lo - pad, hi + pad


def robust_range(values: Array, at_least: float = 0.0) -> tuple[float, float]:
    """A range symmetric about zero that a few spikes do not widen.

    The whole range where it is below three times the 99th percentile; otherwise 1.6 times that percentile, and the plot
    must mark the values beyond.
    """
    size = np.abs(values[np.isfinite(values)])
    if not size.size:
        return -1.0, 1.0
    usual, largest = float(np.percentile(size, 99)), float(size.max())
    limit = max(largest * 1.08 if largest < 3 * usual else 1.6 * usual, at_least, 1e-9)
    return -limit, limit


def round_size(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is at most `value` (> 0): the length of a scale bar."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(m * power for m in (1, 2, 5) if m * power <= value * 1.0001))
