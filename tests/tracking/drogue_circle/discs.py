"""Pictures of discs from a formula: a disc behind a Gaussian blur has, to first order, the profile of a normal law."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

BRIGHT, GREY, BLUR_PX = 180.0, 90.0, 1.2


def discs(
    circles: Sequence[tuple[float, float, float]],
    size: tuple[int, int] = (160, 120),
    *,
    noise: float = 1.5,
    seed: int = 0,
    squeeze: float = 1.0,
) -> NDArray[np.uint8]:
    """Bright discs (u, v, radius) on grey, 8 bits. squeeze: height over width, which makes ellipses."""
    x, y = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    light = np.full(x.shape, GREY)
    for u, v, radius in circles:
        distance = np.hypot(x - u, (y - v) / squeeze)
        light += (BRIGHT - GREY) * norm.cdf((radius - distance) / BLUR_PX)
    return rounded(light + np.random.default_rng(seed).normal(0, noise, x.shape))


def textured(
    rng: np.random.Generator, centre: Sequence[float], radius: float, coarse_px: float, contrast: float = BRIGHT - GREY
) -> NDArray[np.uint8]:
    """A disc whose grey values are a smooth random field (sigma 22 DN), before an even grey; 2 x 2 samples a pixel."""
    n = 2
    v, u = (np.mgrid[: 120 * n, : 160 * n] + 0.5) / n - 0.5
    field = cv2.GaussianBlur(rng.normal(size=v.shape), (0, 0), n * coarse_px)
    inside = np.hypot(u - centre[0], v - centre[1]) < radius
    light = np.where(inside, GREY + contrast + 22.0 * field / field.std(), GREY).astype(np.float32)
    light = cv2.GaussianBlur(cv2.resize(light, (160, 120), interpolation=cv2.INTER_AREA), (0, 0), 1.0)
    return rounded(light + rng.normal(0, 1.5, light.shape))


def rounded(light: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Eight bits."""
    return np.clip(np.rint(light), 0, 255).astype(np.uint8)


def covered(
    picture: NDArray[np.uint8], columns: tuple[int, int], rows: tuple[int, int], grey: float = 60.0
) -> NDArray[np.uint8]:
    """The picture behind a plain plate."""
    out = picture.copy()
    out[max(rows[0], 0) : rows[1], max(columns[0], 0) : columns[1]] = int(grey)
    return out
