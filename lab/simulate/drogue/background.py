"""Backgrounds: a gradient of the sky, clouds and ground as fractal noise, or a given picture, with distractors.

A background is drawn once, larger than the picture, and shifted by the offset of the frame; mirrored at its edges.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.simulate.drogue.scene import CLOUDS, GROUND, PICTURE, DrogueBackground, Floats32

_MARGIN = 0.25  # of the picture's size, on each side, that moves into view
_SHIFT = 4  # bits of sub-pixel positions in OpenCV's drawing functions
_BLUE_SKY, _CLOUD, _EARTH, _GRASS = (1.25, 1.02, 0.78), (1.03, 1.0, 0.98), (0.72, 0.95, 1.1), (0.75, 1.08, 0.88)


def background_picture(background: DrogueBackground, size_px: tuple[int, int]) -> Floats32:
    """Colours (h, w, 3) in DN of the background; size_px: width, height. The caller owns the array."""
    picture = background.picture
    content = None if picture is None else (picture.tobytes(), picture.shape)
    texture = _texture(
        background.kind,
        background.seed,
        background.brightness_dn,
        background.contrast_dn,
        background.clutter,
        size_px,
        content,
    )
    (width, height), (du, dv) = size_px, background.offset_px
    left = (texture.shape[1] - width) / 2 - du
    top = (texture.shape[0] - height) / 2 - dv
    whole = float(left).is_integer() and float(top).is_integer() and left >= 0 and top >= 0
    if whole and left + width <= texture.shape[1] and top + height <= texture.shape[0]:
        return texture[int(top) : int(top) + height, int(left) : int(left) + width].copy()
    shift = np.array([[1.0, 0.0, left], [0.0, 1.0, top]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(texture, shift, size_px, flags=flags, borderMode=cv2.BORDER_REFLECT_101))


def fractal_noise(rng: np.random.Generator, size_px: tuple[int, int], coarsest: int, slope: float) -> Floats32:
    """Noise (h, w) of mean 0 and sigma 1: octaves of smooth random fields whose amplitude falls as 2^-slope per octave.

    coarsest: cells of the first octave along the longer side. Source: standard (Perlin 1985; value noise).
    """
    width, height = size_px
    out = np.zeros((height, width), np.float32)
    cells, amplitude = coarsest, 1.0
    while cells <= max(width, height) // 2:
        share = cells / max(width, height)
        grid = rng.standard_normal((max(int(height * share), 2), max(int(width * share), 2)), dtype=np.float32)
        out += np.float32(amplitude) * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        cells, amplitude = 2 * cells, amplitude * 2.0**-slope
    out -= out.mean()
    return out / max(float(out.std()), 1e-9)


@lru_cache(maxsize=4)
def _texture(
    kind: str,
    seed: int,
    brightness_dn: float,
    contrast_dn: float,
    clutter: int,
    size_px: tuple[int, int],
    content: tuple[bytes, tuple[int, ...]] | None,
) -> Floats32:
    """The whole background (H, W, 3). Cached, since the frames of a sequence share it."""
    rng = np.random.default_rng([seed, 733])
    size = (int(size_px[0] * (1 + 2 * _MARGIN)), int(size_px[1] * (1 + 2 * _MARGIN)))
    if kind == PICTURE and content is not None:
        out = _from_picture(np.frombuffer(content[0], np.uint8).reshape(content[1]), size)
    elif kind == GROUND:
        out = _ground(rng, size, brightness_dn, contrast_dn)
    else:
        out = _sky(rng, size, brightness_dn, contrast_dn if kind == CLOUDS else 0.0)
    for _ in range(clutter):
        _draw_distractor(out, rng)
    return out


def _from_picture(picture: NDArray[np.uint8], size_px: tuple[int, int]) -> Floats32:
    """A given picture, scaled to cover the background and cut at its middle."""
    colour = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
    scale = max(size_px[0] / colour.shape[1], size_px[1] / colour.shape[0])
    wide, high = (max(int(np.ceil(n * scale)), m) for n, m in zip(colour.shape[1::-1], size_px, strict=True))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    resized = cv2.resize(colour, (wide, high), interpolation=way)
    top, left = (high - size_px[1]) // 2, (wide - size_px[0]) // 2
    return resized[top : top + size_px[1], left : left + size_px[0]].astype(np.float32)


def _sky(rng: np.random.Generator, size_px: tuple[int, int], brightness_dn: float, contrast_dn: float) -> Floats32:
    """A vertical gradient from blue to haze, with clouds where the noise is high."""
    width, height = size_px
    v = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    blue, haze = np.asarray(_BLUE_SKY, np.float32), np.asarray(_CLOUD, np.float32)
    slope = np.float32(rng.uniform(0.1, 0.35))
    level = np.float32(brightness_dn) * (1 - slope / 2 + slope * v)
    out = np.repeat(level * ((1 - v) * blue + v * haze), width, axis=1)
    if contrast_dn > 0:
        field = fractal_noise(rng, size_px, int(rng.integers(2, 7)), float(rng.uniform(0.7, 1.1)))
        cover = np.clip((field - np.float32(rng.uniform(-0.8, 0.8))) * np.float32(0.9), 0, 1)[..., None]
        shade = fractal_noise(rng, size_px, 8, 1.0)[..., None]
        cloud = (np.float32(brightness_dn + contrast_dn) + np.float32(0.35 * contrast_dn) * shade) * haze
        out = out * (1 - cover) + cloud * cover
    return np.asarray(out, np.float32)


def _ground(rng: np.random.Generator, size_px: tuple[int, int], brightness_dn: float, contrast_dn: float) -> Floats32:
    """Fields of different colours with fine texture."""
    kinds = fractal_noise(rng, size_px, int(rng.integers(4, 12)), 0.8)[..., None]
    fine = fractal_noise(rng, size_px, 16, float(rng.uniform(0.25, 0.7)))[..., None]
    mix = np.clip(kinds + np.float32(0.5), 0, 1)
    colour = mix * np.asarray(_EARTH, np.float32) + (1 - mix) * np.asarray(_GRASS, np.float32)
    level = np.float32(0.8 * brightness_dn) + np.float32(contrast_dn / 2) * (np.float32(0.5) * kinds + fine)
    return np.asarray(np.maximum(level, 4) * colour, np.float32)


def _draw_distractor(picture: Floats32, rng: np.random.Generator) -> None:
    """One disc, thin ring, line or polygon at a random place; anti-aliased, with the colour of something distant."""
    height, width = picture.shape[:2]
    at = rng.uniform([0, 0], [width, height])
    size = float(np.exp(rng.uniform(np.log(4), np.log(0.2 * height))))
    level = float(rng.uniform(15, 245))
    colour = tuple(float(c) for c in np.clip(level * rng.uniform(0.9, 1.1, 3), 0, 255))
    layer = picture.astype(np.uint8)
    kind = rng.integers(4)
    if kind == 0:
        cv2.circle(layer, _fixed(at), int(size / 2 * 2**_SHIFT), colour, -1, cv2.LINE_AA, _SHIFT)
    elif kind == 1:
        radius = int(max(size, 12) / 2 * 2**_SHIFT)
        cv2.circle(layer, _fixed(at), radius, colour, int(rng.integers(1, 3)), cv2.LINE_AA, _SHIFT)
    elif kind == 2:
        end = at + rng.normal(0, 3 * size, 2)
        cv2.line(layer, _fixed(at), _fixed(end), colour, int(rng.integers(1, 6)), cv2.LINE_AA, _SHIFT)
    else:
        turn = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 7))))
        reach = size * rng.uniform(0.3, 1.2, len(turn))
        corners = at + reach[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        points = np.round(corners * 2**_SHIFT).astype(np.int32)
        cv2.fillPoly(layer, [points], colour, cv2.LINE_AA, _SHIFT)
    changed = np.any(layer != picture.astype(np.uint8), axis=2)
    picture[changed] = layer[changed]


def _fixed(point_px: NDArray[np.float64]) -> tuple[int, int]:
    """A point in OpenCV's fixed-point numbers."""
    u, v = np.round(np.asarray(point_px) * 2**_SHIFT).astype(int)
    return int(u), int(v)
