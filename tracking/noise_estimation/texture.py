"""The contrast of the background's fixed structure, which adds to the detection threshold."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from tracking.noise import BLOCK, NoiseModel, Picture, quantile_variance

_MEAN = 3  # px: side of the means compared with the background
_AROUND, _QUANTILE = 9, 0.75  # blocks along a side; an edge through the surroundings is in fewer of them
_BY_NOISE = 2.5  # times its expectation: most of the variance of a block's few means that noise alone causes
# Most of the texture over that within blocks: 2 for grain as coarse as two blocks. An even surface between edges has
# little within blocks, while the smooth background is wrong there by a part of the edges' height.
_OF_BLOCK = 3.0
_EVEN = 0.2  # quantile over a block and those around it: an edge and a spot are in fewer of them than 80 %
_LIMITING = 1.0  # variance of the texture over that of the noise, for means of 3x3 pixels, from which it matters ...
_LIMITED_SHARE = 0.01  # ... in this share of the picture


class MeanPicture(NamedTuple):
    """The mean of pictures: with less noise, and moving objects blurred; h and w are multiples of BLOCK."""

    mean: NDArray[Any]  # (h, w), DN
    background: NDArray[Any]  # (h, w), DN: its smooth part
    pictures: int  # number of pictures

    @staticmethod
    def of(pictures: Sequence[Picture]) -> MeanPicture:
        """The mean of pictures of one size."""
        height, width = (n // BLOCK * BLOCK for n in pictures[0].shape)
        mean = pictures[0][:height, :width].astype(np.float32)
        for more in pictures[1:]:
            mean += more[:height, :width]
        mean /= np.float32(len(pictures))
        coarse = cv2.resize(mean, (width // BLOCK, height // BLOCK), interpolation=cv2.INTER_AREA)
        background = cv2.resize(cv2.medianBlur(coarse, 5), (width, height), interpolation=cv2.INTER_LINEAR)
        return MeanPicture(mean, background, len(pictures))


def texture_of(seen: MeanPicture, noise: NoiseModel) -> float:
    """Sigma, beyond the noise, of means over 3x3 pixels about the local background, as a fraction of its level.

    The larger estimate of the 68 % and the 95 % quantile is taken: this ignores bright details but includes uneven
    texture. Source: ours.
    """
    inner = slice(2 * BLOCK, -2 * BLOCK, 3)
    level = np.maximum(seen.background[inner, inner].astype(float), 1.0)
    above = cv2.blur(seen.mean, (_MEAN, _MEAN))[inner, inner] - seen.background[inner, inner]
    if not above.size:
        return 0.0
    variance = quantile_variance(np.abs(above / level))
    explained = float(np.mean(noise.of_means.variance(level) / level**2)) / (_MEAN**2 * seen.pictures)
    return float(np.sqrt(max(variance - explained, 0.0)))


def local_texture(seen: MeanPicture, noise: NoiseModel, size_px: tuple[int, int]) -> NDArray[np.float32]:
    """The texture of each block of a picture (width, height), as a fraction of its level.

    The lowest of four: that of the block and its neighbours, a multiple of what the blocks around have within them, a
    quantile of that of the blocks farther around, and that of the whole picture. A spot that stays in its place is in
    the first, but in few of the blocks around it; so is the edge of a screen or a cable. A wide one is in all of those,
    but not in the whole picture. Source: ours.
    """
    level = np.maximum(seen.background, 1.0)
    relative = (cv2.blur(seen.mean, (_MEAN, _MEAN)) - seen.background) / level
    size = seen.mean.shape[1] // BLOCK, seen.mean.shape[0] // BLOCK
    variance = cv2.resize(relative * relative, size, interpolation=cv2.INTER_AREA)
    within = np.maximum(variance - cv2.resize(relative, size, interpolation=cv2.INTER_AREA) ** 2, 0.0)
    levels = cv2.resize(level, size, interpolation=cv2.INTER_AREA)
    explained = noise.of_means.variance(levels) / (levels * levels) / (_MEAN**2 * seen.pictures)
    beyond = np.maximum(variance - _BY_NOISE * explained, 0.0).astype(np.float32)
    around = _ranked(beyond, _AROUND, _QUANTILE)
    # Edges and spots are narrower than three blocks, or in few of the blocks around; texture fills areas.
    areas = np.maximum(cv2.morphologyEx(within, cv2.MORPH_OPEN, np.ones((3, 3))), _ranked(within, 5, _EVEN))
    near = np.minimum(cv2.dilate(beyond, np.ones((3, 3))), _OF_BLOCK**2 * areas)
    contrast = np.minimum(np.sqrt(np.minimum(near, around)), noise.texture)
    rows, columns = -(-size_px[1] // BLOCK), -(-size_px[0] // BLOCK)
    missing = (0, rows - contrast.shape[0]), (0, columns - contrast.shape[1])
    return np.asarray(np.pad(contrast, missing, mode="edge"), np.float32)


def _ranked(values: NDArray[np.float32], side: int, quantile: float) -> NDArray[np.float32]:
    """The quantile of the values in squares about each.

    As scipy.ndimage.percentile_filter, whose import takes 0.3 s of a run that must start in half a second.
    """
    windows = sliding_window_view(np.pad(values, side // 2, mode="symmetric"), (side, side))
    rank = int(quantile * side**2)
    return np.asarray(np.partition(windows.reshape(*values.shape, side**2), rank)[..., rank])


def is_limited_by_texture(model: NoiseModel) -> bool:
    """Whether texture or objects in a part of a camera's background hide spots that its noise would show."""
    contrast = np.asarray(model.texture if model.local_texture is None else model.local_texture)
    noise = float(model.of_means.variance(model.black_dn)) / 9
    return bool(np.mean((contrast * model.black_dn) ** 2 > _LIMITING * noise) > _LIMITED_SHARE)
