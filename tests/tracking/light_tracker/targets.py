"""Pictures of a synthetic target: a bright ring with a spot beside its middle, before a smooth texture."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

SIZE = (200, 160)
_FINE = 4


@lru_cache
def texture(seed: int, strength: float = 12.0) -> np.ndarray:
    """(h, w) a smooth background."""
    rng = np.random.default_rng([seed, 5])
    coarse = rng.standard_normal((SIZE[1] // 8, SIZE[0] // 8)).astype(np.float32)
    return 90 + strength * cv2.resize(coarse, SIZE, interpolation=cv2.INTER_CUBIC)


def picture(
    targets: list[tuple[float, float, float]],
    seed: int = 0,
    noise: float = 2.0,
    gain: float = 1.0,
    hidden: tuple[float, float, float] | None = None,
    background: np.ndarray | None = None,
    alike: tuple[float, float, float] | None = None,
) -> np.ndarray:
    """(h, w) 8 bit. targets, hidden, alike: u, v, diameter.

    hidden: a grey disc in front; alike: a ring whose middle is only a little darker than its surroundings.
    """
    mean = (texture(1) if background is None else background).copy()
    for u, v, diameter in targets:
        _draw(mean, u, v, diameter, ((0, 0.5, 200.0), (0, 0.34, 45.0), (0.12, 0.1, 150.0)))
    if alike is not None:
        _draw(mean, *alike, ((0, 0.5, 200.0), (0, 0.34, 140.0)))
    if hidden is not None:
        _draw(mean, *hidden, ((0, 0.5, 130.0),))
    rng = np.random.default_rng([seed, 6])
    return np.clip(np.rint(gain * mean + noise * rng.standard_normal(mean.shape)), 0, 255).astype(np.uint8)


def _draw(mean: np.ndarray, u: float, v: float, diameter: float, discs: tuple[tuple[float, float, float], ...]) -> None:
    """Draw discs (shift to the right and radius in diameters, grey value) into the pixels around a target."""
    reach = diameter / 2 + 2
    left, right = max(int(u - reach), 0), min(int(u + reach) + 1, SIZE[0])
    top, bottom = max(int(v - reach), 0), min(int(v + reach) + 1, SIZE[1])
    if left >= right or top >= bottom:
        return
    fine = (np.arange(_FINE) + 0.5) / _FINE - 0.5
    x = (np.arange(left, right)[:, None] + fine).ravel()[None, :] - u
    y = (np.arange(top, bottom)[:, None] + fine).ravel()[:, None] - v
    layer = np.kron(mean[top:bottom, left:right], np.ones((_FINE, _FINE)))
    for shift, radius, grey in discs:
        layer[np.hypot(x - shift * diameter, y) <= radius * diameter] = grey
    small = layer.reshape(bottom - top, _FINE, right - left, _FINE)
    mean[top:bottom, left:right] = small.mean(axis=(1, 3))
