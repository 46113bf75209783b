"""A coloured target: the share of a hue in each pixel, and the blobs of it.

The grey part of the light does not change the share, and it is linear in the light: shadows and white reflections are
no targets, and pixels that the target covers in part have a part of its value. Source: ours; the plane of chroma is
that of the hue in HSV (Smith 1978).
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.detections import Detections
from tracking.single_target.blobs import find_blobs
from tracking.single_target.parameters import BlobParameters

# Hue, degrees.
HUES = {"red": 0.0, "orange": 30.0, "yellow": 60.0, "green": 120.0, "cyan": 180.0, "blue": 240.0, "magenta": 300.0}
LEAST_CHROMA_DN = 25.0  # of the middle of a target: fainter colours are those of walls, wood and light
_ACROSS = 1.7  # weight of the chroma across the hue: hues more than 30 degrees away have no share


def hue_of(bgr: tuple[float, float, float]) -> float | None:
    """Hue of a colour, degrees, 0 to 360; None for a grey one."""
    along, across = _chroma(np.array(bgr, dtype=np.float32)[None, None])
    if np.hypot(along, across)[0, 0] < LEAST_CHROMA_DN:
        return None
    return float(np.degrees(np.arctan2(across, along))[0, 0] % 360)


def share_of_hue(picture: NDArray[np.uint8], hue_deg: float) -> NDArray[np.float32]:
    """Chroma (h, w), DN, of a picture (h, w, 3), BGR, along a hue; 0 for other hues and for grey."""
    x, y = _chroma(picture.astype(np.float32))
    turn = np.radians(hue_deg)
    c, s = np.float32(np.cos(turn)), np.float32(np.sin(turn))
    along, across = c * x + s * y, c * y - s * x
    return np.asarray(np.maximum(along - np.float32(_ACROSS) * np.abs(across), 0), np.float32)


def find_coloured(picture: NDArray[np.uint8], hue_deg: float, parameters: BlobParameters) -> Detections:
    """The blobs of a hue in a picture (h, w, 3), BGR, strongest first; flux and peak are chroma, DN.

    Raises:
        ValueError: the picture has no three channels of 8 bits.
    """
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise ValueError(f"picture: expected (h, w, 3) of 8 bits, got {picture.shape} of {picture.dtype}")
    # The median removes single pixels: the chroma of a raster of colour filters is noisy.
    share = np.asarray(cv2.medianBlur(share_of_hue(picture, hue_deg), 3), np.float32)
    found = find_blobs(share, replace(parameters, polarity="brighter"))
    return found[found.peak >= LEAST_CHROMA_DN]


def has_colour(picture: NDArray[np.uint8]) -> bool:
    """Whether any pixel of a picture (h, w, 3) has the chroma of a target."""
    x, y = _chroma(picture.astype(np.float32))
    return bool(np.hypot(x, y).max() >= LEAST_CHROMA_DN)


def _chroma(bgr: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Components towards red, and 90 degrees from it, of colours (h, w, 3); 255 DN for a pure red."""
    blue, green, red = (bgr[..., i] for i in range(3))
    across = np.float32(np.sqrt(3) / 2) * (green - blue)
    return np.asarray(red - (green + blue) / 2, np.float32), np.asarray(across, np.float32)
