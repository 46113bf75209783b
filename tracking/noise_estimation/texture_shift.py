"""Errors of the spots' centres due to the screen's texture, predicted from the texture of the background.

A fit with equal weights moves by s^2 sum(x G d) / sum(x^2 G^2) if the light changes by d, with G the spot's Gaussian of
sigma s. Texture of relative contrast t changes the spot's own light, A G, by A G t and that of the background, B, by
B t. So the error is the output of two linear filters of t, with the kernels s^2 x G^2 / sum(x^2 G^2) and, times B / A,
s^2 x G / sum(x^2 G^2). Their outputs anywhere on the background have the distribution of the errors of the spots.
Source: ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array
from tracking.noise import NoiseModel, Picture, quantile_variance

_BLOCK = 8  # px: as in texture.py, so that the background is the same
_WIDTHS_PX = (0.8, 1.6, 3.2)  # of spots; wider ones have the last error: that of a grain finer than the spot
_LARGEST_CONTRAST = 0.3  # more is an edge or an object
_REACH = 3.0  # sigmas of the kernel to each side
_FEWER_PIXELS = 1.6  # pixels per sigma of a spot above which pixels are averaged in pairs
_SAMPLED = 3  # px: step of the sample of the filters' outputs
LARGEST_SHARE = 0.1  # of the spot's width: a larger error is not assumed


@dataclass(frozen=True, slots=True)
class TextureShift:
    """Sigmas, px and per coordinate, of spots of the widths (k,), px, at any place of the screen."""

    widths_px: tuple[float, ...]
    light_px: tuple[float, ...]  # by the texture in the spot's own light
    background_px: tuple[float, ...]  # by the texture in the background, for a spot as bright as the background

    @staticmethod
    def none() -> TextureShift:
        """No texture."""
        return TextureShift((1.0,), (0.0,), (0.0,))

    def sigma_px(self, width_px: Array, contrast: Array) -> Array:
        """Sigmas (n,), px, of spots with these widths (n,), px, and peaks (n,) relative to the background.

        Both parts come from the same texture, so they are added. nan where a width is not known.
        """
        at, widths = np.log(np.maximum(width_px, 1e-3)), np.log(self.widths_px)
        light = np.interp(at, widths, self.light_px)
        background = np.interp(at, widths, self.background_px)
        return np.minimum(light + background / np.maximum(contrast, 1e-3), LARGEST_SHARE * np.asarray(width_px))


def texture_shift(pictures: Sequence[Picture], noise: NoiseModel) -> TextureShift:
    """The errors of spots on the background of pictures (h, w) of one camera, less those by noise.

    As in `texture_of`, the mean of the pictures is used, and the background without its smooth part.
    """
    height, width = (n // _BLOCK * _BLOCK for n in pictures[0].shape)
    mean = np.asarray(np.mean([p[:height, :width] for p in pictures], axis=0), dtype=np.float32)
    coarse = cv2.resize(mean, (width // _BLOCK, height // _BLOCK), interpolation=cv2.INTER_AREA)
    background = cv2.resize(cv2.medianBlur(coarse, 5), (width, height), interpolation=cv2.INTER_LINEAR)
    level = np.maximum(background, 1.0)
    texture: NDArray[Any] = np.clip((mean - background) / level, -_LARGEST_CONTRAST, _LARGEST_CONTRAST)
    sample = level[::_BLOCK, ::_BLOCK].astype(float)
    cell = 1
    white = float(np.median(noise.of_means.variance(sample) / sample**2)) / len(pictures)
    light, around = [], []
    for sigma_px in _WIDTHS_PX:
        if sigma_px > _FEWER_PIXELS * cell:
            cell *= 2
            texture = np.asarray(cv2.resize(texture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
        light.append(cell * _shift(texture, sigma_px / cell, 2, white / cell**2))
        around.append(cell * _shift(texture, sigma_px / cell, 1, white / cell**2))
    return TextureShift(_WIDTHS_PX, tuple(light), tuple(around))


def _shift(texture: NDArray[Any], sigma_px: float, power: int, white: float) -> float:
    """Sigma, px, of the filter with G^power of a texture (h, w), less the part of white noise of this variance."""
    reach = int(np.ceil(_REACH * sigma_px / np.sqrt(power)))
    inner = reach + 2 * _BLOCK
    if min(texture.shape) < 2 * inner + 4 * _SAMPLED:
        return 0.0
    x = np.arange(-reach, reach + 1)
    G = np.exp(-0.5 * (x / sigma_px) ** 2)
    smooth = G**power
    odd = sigma_px**2 * x * smooth / (np.sum(x**2 * G**2) * np.sum(G**2))
    middle = slice(inner, -inner, _SAMPLED)
    outputs = [cv2.sepFilter2D(texture, cv2.CV_32F, *k)[middle, middle] for k in ((odd, smooth), (smooth, odd))]
    variance = quantile_variance(np.abs(np.concatenate([o.ravel() for o in outputs])))
    return float(np.sqrt(max(variance - white * np.sum(odd**2) * np.sum(smooth**2), 0.0)))
