"""The contrast of the background's fixed structure, which adds to the detection threshold."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from tracking.noise import NoiseModel, Picture, quantile_variance

_BLOCK = 8  # px: as in tracking/detection/block_search.py, so that the background is the same
_MEAN = 3  # px: side of the means compared with the background


def texture_of(pictures: Sequence[Picture], noise: NoiseModel) -> float:
    """Sigma, beyond the noise, of means over 3x3 pixels about the local background, as a fraction of its level.

    Computed from the mean of all pictures (h, w), in which noise is reduced and moving objects are blurred. The larger
    estimate of the 68 % and the 95 % quantile is taken: this ignores bright details but includes uneven texture.
    Source: ours.
    """
    height, width = (n // _BLOCK * _BLOCK for n in pictures[0].shape)
    mean = np.asarray(np.mean([p[:height, :width] for p in pictures], axis=0), dtype=np.float32)
    coarse = cv2.resize(mean, (width // _BLOCK, height // _BLOCK), interpolation=cv2.INTER_AREA)
    background = cv2.resize(cv2.medianBlur(coarse, 5), (width, height), interpolation=cv2.INTER_LINEAR)
    inner = slice(2 * _BLOCK, -2 * _BLOCK, 3)
    level = np.maximum(background[inner, inner].astype(float), 1.0)
    above = cv2.blur(mean, (_MEAN, _MEAN))[inner, inner] - background[inner, inner]
    if not above.size:
        return 0.0
    variance = quantile_variance(np.abs(above / level))
    explained = float(np.mean(noise.of_means.variance(level) / level**2)) / (_MEAN**2 * len(pictures))
    return float(np.sqrt(max(variance - explained, 0.0)))
