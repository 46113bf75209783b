"""Places of points in a picture: near lights, inside boxes, alike in two lists."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Bools
from tracking.detections import Detections

_MARGIN, _STEP = 40, 64  # px: light around a box; sides are rounded up, so that few sizes occur
_CLEARLY_BETTER = 0.5  # ratio of the variances of two measurements of a spot
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


def number_of_better(spots: Detections, found: Detections) -> int:
    """How many spots of a difference (n,) are not among those found in the picture (m,), or clearly more precise."""
    part = near_each(spots, found, AROUND_SPOT)
    size2, usual2 = (np.trace(d.cov_px2, axis1=1, axis2=2) for d in (spots, found))
    replaces = part & (size2[:, None] < _CLEARLY_BETTER * usual2)
    return int(np.count_nonzero(~np.any(part & ~replaces, axis=1)))


def inside(boxes: NDArray[np.float64], found: Detections) -> Bools:
    """Which of the points (n,) lie in one of the boxes (m, 3): u, v and half side, px."""
    away = np.abs(found.uv_px[:, None] - boxes[None, :, :2]).max(axis=2)
    return np.asarray((away <= boxes[None, :, 2]).any(axis=1))


def merged_parts(boxes: NDArray[np.float64], shape: tuple[int, ...], multiple: int) -> list[tuple[int, int, int, int]]:
    """Parts of a picture (h, w) that contain boxes (m, 3) and the light around them: left, top, right, bottom, px.

    Parts that overlap are one. Left and top are multiples of a number of pixels.
    """
    reach = boxes[:, 2:] + _MARGIN
    low = np.clip(boxes[:, :2] - reach, 0, None) // multiple * multiple
    high = np.minimum(np.ceil((boxes[:, :2] + reach + 1) / _STEP) * _STEP, shape[1::-1])
    parts = [tuple(int(x) for x in part) for part in np.hstack([low, high]) if (part[2:] > part[:2]).all()]
    merged: list[tuple[int, int, int, int]] = []
    while parts:
        left, top, right, bottom = parts.pop()
        other = next((p for p in merged if p[0] < right and left < p[2] and p[1] < bottom and top < p[3]), None)
        if other is None:
            merged.append((left, top, right, bottom))
        else:
            merged.remove(other)
            first, last = np.minimum(other[:2], (left, top)), np.maximum(other[2:], (right, bottom))
            parts.append((int(first[0]), int(first[1]), int(last[0]), int(last[1])))
    return merged


def nearest(at: NDArray[np.float64], size: int) -> NDArray[np.int64]:
    """The nearest rows, or columns, of a picture with so many of them."""
    return np.clip(np.rint(at), 0, size - 1).astype(np.int64)
