"""What the grey values of a camera's pictures say of their file format: steps, bit depth, clipping."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tracking.noise import Picture
from tracking.noise_estimation.rounding import clipped_normal

_FEWEST_VALUES = 8  # distinct grey values from which their common divisor is a step
_CLIPPED = 0.02  # share of pixels at zero from which the background counts as clipped


def grey_step(pictures: Sequence[Picture]) -> float:
    """Greatest common divisor of the grey values, as sampled."""
    divisor, distinct = 0, 0
    for picture in pictures:
        sample = np.unique(picture[::3, ::3]) if picture.size else np.zeros(1, picture.dtype)
        divisor = int(np.gcd.reduce(np.append(sample.astype(np.int64), divisor)))
        distinct = max(distinct, len(sample))
    # A few values have any divisor; real steps are powers of two.
    few = distinct < _FEWEST_VALUES
    return float(divisor & -divisor) if not few and 0 < divisor & -divisor <= 64 else 1.0


def saturation_level(pictures: Sequence[Picture], step_dn: float) -> float | None:
    """The grey value at which the sensor clips, where the pictures show one; None: only the type's largest number.

    Light that is cut off piles up at one value: there are many more pixels at it than one step below. 10 and 12 bits in
    files of 16 show it at 1023 or 4095, a camera with an offset anywhere.
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
    """Mean and variance before clipping of a background that is partly clipped at zero; None: it is not clipped."""
    # The darker half of the blocks: the others hold light.
    blocks = np.concatenate([_blocks(p) for p in pictures])
    mean = blocks.mean(axis=1, dtype=np.float64)
    sample = blocks[mean <= np.median(mean)].ravel()
    if np.mean(sample == 0) < _CLIPPED:
        return None
    mean, sigma = clipped_normal(sample.astype(float) / step)
    return mean * step, (sigma * step) ** 2 + step**2 / 12


def _blocks(picture: Picture) -> NDArray[np.generic]:
    """Every other row and column of blocks of 32x32 pixels, (blocks, 256)."""
    height, width = (n // 32 for n in picture.shape)
    cut = picture[: 32 * height : 2, : 32 * width : 2].reshape(height, 16, width, 16)
    return cut.transpose(0, 2, 1, 3).reshape(height * width, 256)
