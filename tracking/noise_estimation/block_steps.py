"""Steps of lossy compression: the level of a whole 8x8 block jumps, although the noise of its pixels is small."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.noise import Picture

_SIDE = 8  # px: blocks of JPEG (ITU-T T.81, A.3)
_SHARES = (0.95, 0.99, 0.997)  # quantiles of the blocks' changes that are compared: many blocks jump, or few
_BLOCKWISE = (
    1.3  # ratio of the changes of JPEG's blocks to those of other squares of this size from which they are steps
)
_QUIET = 4.0  # ratio to the median of the variance within a block up to which nothing moves in it
_LEAST_VARIANCE = 0.02  # DN^2
_FEWEST_BLOCKS, _MOST_ROWS = 400, 64  # of blocks


def block_step(pictures: Sequence[Picture]) -> float:
    """The step, DN, of the level of 8x8 blocks in pictures (h, w) in order of time; 0 if they do not jump as a whole.

    Noise smaller than the quantisation of a block's mean lets the mean jump by one step between two pictures. Squares
    that are offset by half a block average four blocks and change less; with white noise both change alike. Source:
    ours.
    """
    own, shifted = [], []
    for a, b in zip(pictures[::2], pictures[1::2], strict=False):
        if a.shape != b.shape or min(a.shape) < 3 * _SIDE or a.dtype != np.uint8:
            continue
        change = (b.astype(np.float32) - a)[: _MOST_ROWS * _SIDE]
        own.append(_changes(change))
        shifted.append(_changes(change[_SIDE // 2 :, _SIDE // 2 :]))
    steps, others = (np.concatenate(x) if x else np.zeros(0) for x in (own, shifted))
    if min(len(steps), len(others)) < _FEWEST_BLOCKS:
        return 0.0
    pairs = [(float(np.quantile(steps, s)), float(np.quantile(others, s))) for s in _SHARES]
    return max(step if step > _BLOCKWISE * other else 0.0 for step, other in pairs)


def _changes(change: NDArray[np.float32]) -> NDArray[np.float32]:
    """Absolute changes of the means of the blocks in which nothing moves, about their median."""
    rows, columns = (n // _SIDE for n in change.shape)
    whole = change[: rows * _SIDE, : columns * _SIDE]
    mean, square = (cv2.resize(x, (columns, rows), interpolation=cv2.INTER_AREA) for x in (whole, whole * whole))
    within = square - mean * mean
    quiet = mean[within <= _QUIET * np.median(within) + _LEAST_VARIANCE]
    return np.abs(quiet - np.median(quiet)) if quiet.size else np.zeros(0, np.float32)
