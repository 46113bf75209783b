"""Places of the background that do not belong to its texture: lights, and lines such as edges, seams and cables.

A line has gradients of one direction over a long way, texture of all directions. The eigenvalues a >= b of the mean of
the gradients' products over a window distinguish them: white noise adds the same to both. Source: ours; the matrix is
the structure tensor of Bigun & Granlund 1987.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.detections import Detections
from tracking.noise import BLOCK

_SMOOTH_PX = 1.0  # sigma of the derivatives' kernel
_WINDOW_PX = 10.0  # sigma of the window
_COHERENT = 0.7  # (a - b) / (a + b - 2 n) of a line, with n the part by noise
_CLEAR = 8.0  # times the median of a - b: lines; noise and texture scatter less
_LIGHT_SIGMAS = 5.0  # half side of the square around a light, in its larger half axes


def lights_and_lines(picture: NDArray[Any], found: Sequence[Detections]) -> NDArray[np.uint8]:
    """(h, w): 1 where a relative picture (h, w) shows a line or one of the lights found in its exposures."""
    lights = np.zeros(picture.shape, np.uint8)
    for points in found:
        half = _LIGHT_SIGMAS * np.maximum(points.major_px, 1.0)
        for (u, v), reach in zip(points.uv_px, half, strict=True):
            rows = slice(max(int(v - reach), 0), max(int(v + reach) + 2, 0))
            lights[rows, max(int(u - reach), 0) : max(int(u + reach) + 2, 0)] = 1
    return np.asarray(lights | _lines(np.where(lights, np.float32(0.0), picture)))


def _lines(picture: NDArray[Any]) -> NDArray[np.uint8]:
    smooth = cv2.GaussianBlur(picture, (0, 0), _SMOOTH_PX)
    du, dv = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    size = picture.shape[1] // BLOCK, picture.shape[0] // BLOCK
    products = [cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in (du * du, du * dv, dv * dv)]
    for p in products:  # the background of the outermost blocks, an extrapolation, has the gradients of uneven light
        p[:2], p[-2:], p[:, :2], p[:, -2:] = 0.0, 0.0, 0.0, 0.0
    uu, uv, vv = (cv2.GaussianBlur(p, (0, 0), _WINDOW_PX / BLOCK) for p in products)
    difference, total = np.hypot(uu - vv, 2 * uv), uu + vv
    noise = float(np.median(total - difference))
    line = (difference > _CLEAR * np.median(difference)) & (difference > _COHERENT * (total - noise))
    return np.asarray(cv2.resize(line.astype(np.uint8), picture.shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
