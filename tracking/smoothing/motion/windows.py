"""Moving maximum and mean of a series.

scipy.ndimage has both, but its import takes 0.1 s of a run that must start in half a second. The tests compare with it.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from geometry.arrays import Array, Bools

Values = TypeVar("Values", Array, Bools)


def largest_near(values: Values, half: int) -> Values:
    """Moving maximum (T, ...) of values (T, ...) over at most `half` places on either side along the first axis.

    From maxima over 1, 2, 4 ... places; the last two, which overlap, make the window.
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
    """Moving mean (T,) of values (T,) over `width` places, width // 2 of them before each; zeros beyond the ends.

    A running sum, bit-identical to scipy.ndimage.uniform_filter1d.
    """
    padded = np.concatenate([np.zeros(width // 2), values, np.zeros(width - width // 2 - 1)])
    first = np.cumsum(padded[:width])[-1:]
    return np.asarray(np.cumsum(np.concatenate([first, padded[width:] - padded[:-width]])) / width)
