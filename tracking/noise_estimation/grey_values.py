"""Properties of a camera's pictures that follow from their grey values: step, bit depth, clipping."""

from __future__ import annotations

from collections.abc import Sequence

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
