"""Structured backgrounds of training: roads, arcs, letters and ridges.

They teach the network that sharp man-made patterns are no drogue. None of them is of the kinds of the test (stripes,
checks, blobs, walls of polygons; samples.py).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.simulate.drogue.background import fractal_noise
from lab.simulate.drogue.scene import Floats32

ROADS, ARCS, LETTERS, RIDGES = "roads", "arcs", "letters", "ridges"
KINDS = (ROADS, ARCS, LETTERS, RIDGES)
_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_SCRIPT_SIMPLEX)
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789&%#?"


def structured_picture(rng: np.random.Generator, size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """A random picture (h, w, 3) of one of KINDS under an uneven light; size_px: width, height."""
    kind = KINDS[int(rng.integers(len(KINDS)))]
    draw = {ROADS: _roads, ARCS: _arcs, LETTERS: _letters, RIDGES: _ridges}[kind]
    field = cv2.GaussianBlur(draw(rng, size_px), (0, 0), float(rng.uniform(0.4, 2.0)))
    uneven = 12 * fractal_noise(rng, size_px, 3, 1.0)
    fine = rng.uniform(0, 12) * fractal_noise(rng, size_px, 12, float(rng.uniform(0.2, 0.8)))
    level = rng.uniform(50, 190) + rng.uniform(5, 55) * field + uneven + fine
    grey = np.clip(level, 0, 255).astype(np.uint8)
    return np.asarray(cv2.merge([grey, grey, grey]), dtype=np.uint8)


def _level(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 1.0))


def _roads(rng: np.random.Generator, size_px: tuple[int, int]) -> Floats32:
    """Straight and bent lines of all widths that cross each other."""
    width, height = size_px
    field = np.zeros((height, width), np.float32)
    for _ in range(int(rng.integers(4, 30))):
        start = rng.uniform([0, 0], [width, height])
        steps = rng.normal(0, 0.25 * width, (int(rng.integers(1, 5)), 2))
        path = np.concatenate([start[None], start + np.cumsum(steps, axis=0)]).astype(np.int32)
        thick = max(round(float(np.exp(rng.uniform(0, np.log(0.12 * width))))), 1)
        cv2.polylines(field, [path], False, _level(rng), thick, cv2.LINE_AA)
    return field


def _arcs(rng: np.random.Generator, size_px: tuple[int, int]) -> Floats32:
    """Parts of ellipses, thin and thick, open and closed."""
    width, height = size_px
    field = np.zeros((height, width), np.float32)
    for _ in range(int(rng.integers(4, 25))):
        at = tuple(int(x) for x in rng.uniform([0, 0], [width, height]))
        axes = tuple(max(int(x), 2) for x in np.exp(rng.uniform(np.log(0.04), np.log(0.6), 2)) * width)
        first, extent = rng.uniform(0, 360), rng.uniform(40, 330)
        thick = max(round(float(rng.uniform(0.03, 0.4) * min(axes))), 1)
        cv2.ellipse(field, at, axes, float(rng.uniform(0, 180)), first, first + extent, _level(rng), thick, cv2.LINE_AA)
    return field


def _letters(rng: np.random.Generator, size_px: tuple[int, int]) -> Floats32:
    """Letters and digits of all sizes."""
    width, height = size_px
    field = np.full((height, width), 128, np.uint8)  # OpenCV writes text on 8-bit pictures only
    for _ in range(int(rng.integers(4, 30))):
        text = "".join(rng.choice(list(_LETTERS), int(rng.integers(1, 5))))
        at = tuple(int(x) for x in rng.uniform([-0.1 * width, 0], [width, 1.1 * height]))
        scale = float(np.exp(rng.uniform(np.log(0.3), np.log(width / 60))))
        font, thick = _FONTS[int(rng.integers(len(_FONTS)))], max(round(scale * rng.uniform(0.7, 3)), 1)
        cv2.putText(field, text, at, font, scale, 128 + 127 * _level(rng), thick, cv2.LINE_AA)
    return (field.astype(np.float32) - 128) / np.float32(127)


def _ridges(rng: np.random.Generator, size_px: tuple[int, int]) -> Floats32:
    """Folds and cracks: the absolute value of smooth noise (Perlin 1985, turbulence), with either sign."""
    noise = fractal_noise(rng, size_px, int(rng.integers(3, 20)), float(rng.uniform(0.6, 1.2)))
    sharp = np.abs(noise) ** np.float32(rng.uniform(0.4, 1.0))
    return np.asarray((sharp - sharp.mean()) * np.float32(rng.choice([-2.0, 2.0])), np.float32)
