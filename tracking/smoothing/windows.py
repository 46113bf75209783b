"""Maxima and means over a moving window of a series.

scipy.ndimage has both; importing it takes 0.1 s of a run that must be ready in half a second. The tests compare.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from geometry.arrays import Array, Bools

Values = TypeVar("Values", Array, Bools)


def largest_near(values: Values, half: int) -> Values:
    """The largest of the values (T, ...) at most `half` places away along the first axis, of those that there are.

    Maxima over 1, 2, 4 ... places, of which the last two that overlap make the window.
    """
    frames = len(values)
    half = min(half, frames)
    if frames == 0 or half == 0:
        return values.copy()
    window = 2 * half + 1
    at_ends = [(half, half)] + [(0, 0)] * (values.ndim - 1)
    largest, span = np.pad(values, at_ends, mode="edge"), 1
    while 2 * span <= window:
        largest = np.maximum(largest[:-span], largest[span:])
        span *= 2
    rest = window - span
    return np.asarray(np.maximum(largest[:frames], largest[rest : rest + frames]), dtype=values.dtype)


def window_mean(values: Array, width: int) -> Array:
    """Means of the values (T,) over `width` places about each, width // 2 of them before it; 0 beyond the ends.

    By a running sum: as scipy.ndimage.uniform_filter1d, bit by bit.
    """
    padded = np.concatenate([np.zeros(width // 2), values, np.zeros(width - width // 2 - 1)])
    first = np.cumsum(padded[:width])[-1:]
    return np.asarray(np.cumsum(np.concatenate([first, padded[width:] - padded[:-width]])) / width)
