"""Places of points in a picture: near lights, inside boxes, alike in two lists."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Bools
from tracking.detections import Detections

# Widths, and px: kept clear of lights at rest; of other spots; a light itself; its middle.
AROUND_LIGHT, AROUND_SPOT, ON_LIGHT, SAME_LIGHT = (3.0, 3.0), (3.0, 2.0), (2.5, 1.5), (1.0, 0.0)


def places_of(lights: Detections, shape: tuple[int, ...], size: tuple[float, float]) -> Bools:
    """(h, w): pixels near the lights. size: widths, and px."""
    out = np.zeros(shape, np.uint8)
    widths, more = size
    for (u, v), width in zip(lights.uv_px, lights.major_px, strict=True):
        cv2.circle(out, (round(u), round(v)), round(widths * width + more), 1, cv2.FILLED)
    return out > 0


def near_each(spots: Detections, found: Detections, size: tuple[float, float]) -> Bools:
    """(n, m): spots that are near others. size: widths of those, and px."""
    widths, more = size
    gap = np.linalg.norm(spots.uv_px[:, None] - found.uv_px, axis=-1)
    return np.asarray(gap < widths * found.major_px + more)


def inside(boxes: NDArray[np.float64], found: Detections) -> Bools:
    """Which of the points (n,) lie in one of the boxes (m, 3): u, v and half side, px."""
    away = np.abs(found.uv_px[:, None] - boxes[None, :, :2]).max(axis=2)
    return np.asarray((away <= boxes[None, :, 2]).any(axis=1))


def nearest(at: NDArray[np.float64], size: int) -> NDArray[np.int64]:
    """The nearest rows, or columns, of a picture with so many of them."""
    return np.clip(np.rint(at), 0, size - 1).astype(np.int64)
