"""Pictures of a ring with known centre, partly behind a straight edge: what the detectors are compared on."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array

SIZE = (240, 200)  # width, height, px
_SAMPLES = 4  # per pixel and axis
_TEXTURE = ((3.0, 8.0), (12.0, 16.0), (40.0, 20.0))  # sigma (px) and amplitude (DN) of the background


@dataclass(frozen=True, slots=True)
class Still:
    """A picture and its truth."""

    picture: NDArray[np.uint8]  # (h, w)
    circle: Array  # (3,) u, v, radius of the inner rim, px


def textured(rng: np.random.Generator, size_px: tuple[int, int]) -> NDArray[np.float32]:
    """A background (h, w), DN: smooth noise of several sizes, about 110 DN."""
    out = np.full(size_px[::-1], 110.0, np.float32)
    for sigma, amplitude in _TEXTURE:
        grain = cv2.GaussianBlur(rng.standard_normal(size_px[::-1], dtype=np.float32), (0, 0), sigma)
        out += np.float32(amplitude / max(float(grain.std()), 1e-9)) * grain
    return out


def ring_still(
    rng: np.random.Generator,
    radius_px: float,
    hidden: float,
    *,
    centre_px: tuple[float, float] | None = None,
    background: NDArray[np.float32] | None = None,
    blur_px: float = 1.0,
    noise_dn: float = 2.0,
) -> Still:
    """A bright ring with a black inside on a textured background; `hidden` is the covered share of the inner rim.

    The occluder is a plain rectangle on one side: the hardest case for the centre, since all that is left of the rim
    lies on the other side.
    """
    width, height = SIZE
    if centre_px is None:
        centre_px = (width / 2 + float(rng.uniform(-8, 8)), height / 2 + float(rng.uniform(-8, 8)))
    u, v = centre_px
    x = ((np.arange(width * _SAMPLES) + 0.5) / _SAMPLES - 0.5 - u).astype(np.float32)[None, :]
    y = ((np.arange(height * _SAMPLES) + 0.5) / _SAMPLES - 0.5 - v).astype(np.float32)[:, None]
    distance = np.hypot(x, y)
    below = textured(rng, SIZE) if background is None else background
    fine = cv2.resize(below, None, fx=_SAMPLES, fy=_SAMPLES, interpolation=cv2.INTER_LINEAR)
    outer = radius_px * (1 + float(rng.uniform(0.25, 0.5)))
    ribs = np.float32(rng.uniform(170, 230)) + 10 * np.cos(16 * np.arctan2(y, x))
    fine = np.where(distance < outer, ribs, fine)
    fine = np.where(distance < radius_px, np.float32(rng.uniform(20, 70)), fine)
    if hidden > 0:
        angle = float(rng.uniform(0, 2 * np.pi))
        along = x * np.cos(angle) + y * np.sin(angle)
        across = y * np.cos(angle) - x * np.sin(angle)
        covered = (along > radius_px * np.cos(np.pi * hidden)) & (np.abs(across) < 2.2 * radius_px)
        fine = np.where(covered, np.float32(rng.uniform(60, 200)), fine)
    coarse = cv2.resize(np.asarray(fine, np.float32), SIZE, interpolation=cv2.INTER_AREA)
    seen = cv2.GaussianBlur(coarse, (0, 0), blur_px) + rng.normal(0, noise_dn, (height, width))
    return Still(np.clip(np.rint(seen), 0, 255).astype(np.uint8), np.array([u, v, radius_px]))
