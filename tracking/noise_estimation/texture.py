"""The fixed structure of a background: how much a spot must stand out of it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from tracking.noise import NoiseModel, Picture, quantile_variance

_BLOCK = 8  # px: as in tracking/detection/block_search.py, whose background it is that counts
_MEAN = 3  # px: side of the means that are compared with the background


def texture_of(pictures: Sequence[Picture], noise: NoiseModel) -> float:
    """Sigma of means over 3x3 pixels about their surroundings that noise does not explain, share of the level.

    The mean of all pictures (h, w) is looked at, in which noise is smaller and what moves is smeared. Of the 68 % and
    the 95 % quantile the larger one counts, so bright details are left out but uneven texture is not. Ours.
    """
    height, width = (n // _BLOCK * _BLOCK for n in pictures[0].shape)
    mean = np.asarray(np.mean([p[:height, :width] for p in pictures], axis=0), dtype=np.float32)
    coarse = cv2.resize(mean, (width // _BLOCK, height // _BLOCK), interpolation=cv2.INTER_AREA)
    ground = cv2.resize(cv2.medianBlur(coarse, 5), (width, height), interpolation=cv2.INTER_LINEAR)
    inner = slice(2 * _BLOCK, -2 * _BLOCK, 3)
    level = np.maximum(ground[inner, inner].astype(float), 1.0)
    above = cv2.blur(mean, (_MEAN, _MEAN))[inner, inner] - ground[inner, inner]
    if not above.size:
        return 0.0
    variance = quantile_variance(np.abs(above / level))
    explained = float(np.mean(noise.variance(level) / level**2)) / (_MEAN**2 * len(pictures))
    return float(np.sqrt(max(variance - explained, 0.0)))
