"""The contrast of the background's fixed structure, which adds to the detection threshold."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.noise import NoiseModel, Picture, quantile_variance

BLOCK = 8  # px: as in tracking/detection/block_search.py, so that the background is the same
_MEAN = 3  # px: side of the means compared with the background


class MeanPicture(NamedTuple):
    """The mean of pictures: with less noise, and moving objects blurred; h and w are multiples of BLOCK."""

    mean: NDArray[Any]  # (h, w), DN
    background: NDArray[Any]  # (h, w), DN: its smooth part
    pictures: int  # number of pictures

    @staticmethod
    def of(pictures: Sequence[Picture]) -> MeanPicture:
        """The mean of pictures of one size."""
        height, width = (n // BLOCK * BLOCK for n in pictures[0].shape)
        mean = np.asarray(np.mean([p[:height, :width] for p in pictures], axis=0), dtype=np.float32)
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
