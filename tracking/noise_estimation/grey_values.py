"""Properties of a camera's pictures that follow from their grey values: step, bit depth, clipping, how they were made.

Raw pictures of a colour camera are recognised, whose neighbouring pixels lie behind different filters, and the steps of
lossy compression.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.noise import CLIPPED_SHARE, Picture, is_clipped_noise
from tracking.rounding import clipped_normal

_FEWEST_VALUES = 8  # distinct grey values needed to take their common divisor as the step
_UNLIT = 0.25  # share of the blocks that is taken to be without light


def grey_step(pictures: Sequence[Picture]) -> float:
    """The step of the grey values, DN: the largest power of two that divides all sampled values; at most 64."""
    divisor, distinct = 0, 0
    for picture in pictures:
        sample = np.unique(picture[::3, ::3]) if picture.size else np.zeros(1, picture.dtype)
        divisor = int(np.gcd.reduce(np.append(sample.astype(np.int64), divisor)))
        distinct = max(distinct, len(sample))
    # A few values may have any common divisor; real steps are powers of two.
    few = distinct < _FEWEST_VALUES
    return float(divisor & -divisor) if not few and 0 < divisor & -divisor <= 64 else 1.0


def saturation_level(pictures: Sequence[Picture], step_dn: float) -> float | None:
    """The grey value at which the sensor clips, if the pictures show one; None: only the type's largest value.

    Clipped light accumulates at one value: many more pixels have it than one step below. 10 and 12 bit data in 16 bit
    files clip at 1023 or 4095, a camera with an offset at any value.
    """
    top = max((int(p.max()) for p in pictures if p.size), default=0)
    if not pictures or top == np.iinfo(pictures[0].dtype).max or top == 0:
        return None
    at_top = sum(int(np.count_nonzero(p == top)) for p in pictures)
    below = sum(int(np.count_nonzero(p == top - int(step_dn))) for p in pictures if top >= step_dn)
    full_of_bits = top / step_dn + 1 in (1024, 2**12, 2**14)
    return float(top) if at_top > 3 * below + (2 if full_of_bits else 12) else None


def full_scale(pictures: Sequence[Picture], step_dn: float) -> float:
    """The largest grey value of the camera's own bit depth, at least 8 bits, DN."""
    top = max(int(p.max()) for p in pictures) if pictures[0].size else 0
    bits = max(int(np.ceil(np.log2(top / step_dn + 1))), 8)
    return float(min(step_dn * 2.0**bits - step_dn, np.iinfo(pictures[0].dtype).max))


def clipped_background(pictures: Sequence[Picture], step: float) -> tuple[float, float] | None:
    """Mean, DN, and variance, DN^2, before clipping of a background partly clipped at zero; None: not clipped."""
    # Only the darkest blocks: reflections may light more than half of the picture.
    blocks = np.concatenate([_blocks(p) for p in pictures])
    mean = blocks.mean(axis=1, dtype=np.float64)
    sample = blocks[mean <= np.quantile(mean, _UNLIT)].ravel()
    if np.mean(sample == 0) < CLIPPED_SHARE:
        return None
    mean, sigma = clipped_normal(sample.astype(float) / step)
    rows = sample.reshape(-1, 16)
    if not is_clipped_noise(rows[:, :-1], rows[:, 1:], sigma * step):
        return None
    return mean * step, (sigma * step) ** 2 + step**2 / 12


def _blocks(picture: Picture) -> NDArray[np.generic]:
    """Every other row and column of blocks of 32x32 pixels, (blocks, 256)."""
    height, width = (n // 32 for n in picture.shape)
    cut = picture[: 32 * height : 2, : 32 * width : 2].reshape(height, 16, width, 16)
    return cut.transpose(0, 2, 1, 3).reshape(height * width, 256)


# The mosaic of a colour camera. A laser spot lights one pixel in four of it (red, blue) or two (green), so that its
# centroid follows the mosaic by up to a tenth of a pixel, and no residual shows it. The pictures must be converted to
# colour or grey first.

BLOCK = 32  # px, even: side of the blocks that are compared
LEAST_CONTRAST = 0.03  # a smaller difference of two filters has no effect on a centroid
SAME_SIGN = 0.95  # share of the blocks with the same sign: texture has both
EQUAL = 0.25  # share of the larger difference up to which the two pixels of the other diagonal count as equal


def mosaic_contrast(picture: Picture) -> float:
    """Relative difference of two of the mosaic's four pixels in a picture (h, w); 0 if there is no colour mosaic.

    In each cell of 2 x 2 pixels of a Bayer mosaic the pixels of one diagonal have the same filter, green, and those of
    the other do not, red and blue. Different gains of even and odd columns or rows do not have this property. A light
    that has as much red as blue for the sensor hides the mosaic. Source: ours.
    """
    height, width = (n - n % BLOCK for n in picture.shape)
    if not height or not width:
        return 0.0
    size = width // BLOCK, height // BLOCK
    pixels = picture[:height, :width].astype(np.float32)
    a, b, c, d = (cv2.resize(pixels[i::2, j::2], size, interpolation=cv2.INTER_AREA) for i in (0, 1) for j in (0, 1))
    level = np.maximum((a + b + c + d) / 4, 1.0)
    first, second = ((a - d) / level).ravel(), ((b - c) / level).ravel()
    larger, smaller = (first, second) if abs(np.median(first)) > abs(np.median(second)) else (second, first)
    contrast = float(np.median(larger))
    alike = np.mean(np.sign(larger) == np.sign(contrast))
    bayer = abs(contrast) >= LEAST_CONTRAST and alike >= SAME_SIGN and abs(np.median(smaller)) < EQUAL * abs(contrast)
    return abs(contrast) if bayer else 0.0


# Steps of lossy compression: the level of a whole 8x8 block jumps, although the noise of its pixels is small.

_SIDE = 8  # px: blocks of JPEG (ITU-T T.81, A.3)
_SHARES = (0.95, 0.99, 0.997)  # quantiles of the blocks' changes that are compared: many blocks jump, or few
_BLOCKWISE = 1.3  # ratio of the changes of JPEG's blocks to those of other squares of this size: they are steps
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
