"""Means of a camera's pictures, over pictures and over their surroundings, for the static background."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Bools, evenly_spread
from tracking.noise import BLOCK, Picture

MOST_BYTES = 150_000_000  # of these pictures
_CUT = 0.25  # share of the lowest and of the highest grey values of a pixel that is left out
_SMOOTH_BLOCKS = 6.0  # blocks: sigma of the smooth part of the background, which is no structure
_SMOOTH_SAMPLE = (9, 9)  # of these pixels: what varies over them is not structure
_AROUND_SAMPLE = (11, 11)  # of these pixels: 100 px: a part of the picture that shows the structure or does not


def usable(pictures: Sequence[Picture]) -> list[Picture]:
    """As many of the pictures as may be in memory, evenly spaced; none if they are too small or not alike."""
    if not pictures or min(pictures[0].shape) < 4 * BLOCK:
        return []
    if any(p.shape != pictures[0].shape or p.dtype != pictures[0].dtype for p in pictures):
        return []
    return [pictures[i] for i in evenly_spread(np.arange(len(pictures)), MOST_BYTES // pictures[0].nbytes)]


def means_of(pictures: Sequence[NDArray[Any]]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The means (h, w) of the lower half of each pixel's grey values, without the lowest, and of the middle half.

    The lower half does not contain lights that were elsewhere in half of the pictures; its noise is larger.
    """
    lower, middle = np.empty((2, *pictures[0].shape), np.float32)
    count = len(pictures)
    cut, strip = int(_CUT * count), 16 * BLOCK
    for top in range(0, len(lower), strip):
        values = np.sort([p[top : top + strip] for p in pictures], axis=0)
        lower[top : top + strip] = values[1 : count // 2].mean(axis=0, dtype=np.float32)
        middle[top : top + strip] = values[cut : count - cut].mean(axis=0, dtype=np.float32)
    return lower, middle


def smooth_part(mean: NDArray[np.float32]) -> NDArray[np.float32]:
    """What of a picture (h, w) varies over many blocks, without small lights."""
    height, width = mean.shape
    whole = height // BLOCK * BLOCK, width // BLOCK * BLOCK
    blocks = cv2.resize(mean[: whole[0], : whole[1]], (width // BLOCK, height // BLOCK), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(cv2.medianBlur(blocks, 5), (0, 0), _SMOOTH_BLOCKS)
    return np.asarray(cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def highest_of_blocks(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The highest mean of each block of BLOCK x BLOCK pixels and its neighbours."""
    rows, columns = (-(-n // BLOCK) for n in values.shape)
    missing = (0, rows * BLOCK - values.shape[0]), (0, columns * BLOCK - values.shape[1])
    blocks = cv2.resize(np.pad(values, missing, mode="edge"), (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.dilate(blocks, np.ones((3, 3))), np.float32)


def without_smooth_part(values: NDArray[np.float32], plain: Bools) -> NDArray[np.float32]:
    """Values on the pixels of _SAMPLE less the means of plain ones around them."""
    weight = plain.astype(np.float32)
    mean = cv2.blur(values * weight, _SMOOTH_SAMPLE) / np.maximum(cv2.blur(weight, _SMOOTH_SAMPLE), 1e-3)
    return np.asarray(values - mean, np.float32)


def sums_around(values: NDArray[Any]) -> NDArray[Any]:
    """Sums over the surroundings of each pixel of _SAMPLE."""
    return np.asarray(cv2.boxFilter(values, -1, _AROUND_SAMPLE, normalize=False))


def in_steps(values: NDArray[np.float32], steps: int) -> NDArray[np.uint16]:
    """Grey values, DN, in steps of a fraction of 1 DN."""
    return np.clip(np.rint(values * steps), 0, np.iinfo(np.uint16).max).astype(np.uint16)
