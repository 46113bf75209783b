"""A picture at several sizes, each with its exact scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Level:
    """A reduced picture (h, w) of 0 to 1, and its exact scales: sizes are whole numbers, so they differ a little."""

    grey: Floats
    scale_u: float
    scale_v: float

    @property
    def scale(self) -> float:
        """Of lengths."""
        return float(np.sqrt(self.scale_u * self.scale_v))


def pyramid(grey: Floats, scale: float, reaches_px: float, largest_px: float) -> list[Level]:
    """A picture (h, w) reduced to a scale, then by further factors of 2, the last one such that the largest drogue of
    interest is no larger than what a level reaches.
    """
    levels: list[Level] = []
    full_height, full_width = grey.shape
    while True:
        width, height = max(round(scale * full_width), 1), max(round(scale * full_height), 1)
        source = levels[-1].grey if levels else grey
        reduced = source
        if source.shape != (height, width):
            reduced = np.asarray(cv2.resize(source, (width, height), interpolation=cv2.INTER_AREA), np.float32)
        levels.append(Level(reduced, width / full_width, height / full_height))
        if reaches_px / scale >= largest_px:
            return levels
        scale /= 2
