"""Pictures of sums of square groups of pixels, in which wide lights are as wide as usual spots. Source: ours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture
from tracking.parameters import DetectParameters

WIDE_SIDE = 8  # px: side of the squares in which lights are searched that are too wide for pictures themselves


def squares_of(picture: Picture, side: int = WIDE_SIDE) -> NDArray[np.uint16]:
    """(h / side, w / side): sums of the pixels of a grey picture (h, w); means of 16 bit ones, whose sums have no room.

    side: of the squares, px, at most 8.
    """
    import cv2  # 50 ms, which runs of points save

    height, width = (n // side for n in picture.shape)
    if not (height and width):
        return np.zeros((height, width), np.uint16)
    whole = picture[: side * height, : side * width].astype(np.uint16) * np.uint16(_gain_of_squares(picture, side))
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint16)


def _gain_of_squares(picture: Picture, side: int) -> float:
    """Grey value in `squares_of` a picture over that in the picture."""
    return float(side**2) if picture.dtype == np.uint8 else 1.0


def noise_of_squares(noise: NoiseModel, picture: Picture, side: int = WIDE_SIDE) -> NoiseModel:
    """That of `squares_of` a picture: the noise of a sum of pixels is that of its pixels."""
    model, pixels, gain = noise.of_means, float(side**2), _gain_of_squares(picture, side)
    return NoiseModel(
        gain**2 * model.floor_dn2 / pixels + 1 / 12, gain * model.slope_dn / pixels, gain * model.black_dn,
        model.texture, gain * model.banding_dn,
    )  # fmt: skip


def for_squares(parameters: DetectParameters, picture: Picture, side: int = WIDE_SIDE) -> DetectParameters:
    """The same, with a saturation_dn, in `squares_of` a picture."""
    clips = parameters.saturation_dn
    return replace(
        parameters, max_sigma_px=parameters.max_sigma_px / side,
        saturation_dn=None if clips is None else _gain_of_squares(picture, side) * clips,
    )  # fmt: skip


def of_squares(found: Detections, picture: Picture, side: int = WIDE_SIDE) -> Detections:
    """The points found in `squares_of` a picture, in its pixels and grey values."""
    pixels, gain = float(side**2), _gain_of_squares(picture, side)
    return replace(
        found, uv_px=side * found.uv_px + 0.5 * (side - 1), cov_px2=pixels * found.cov_px2,
        flux=pixels / gain * found.flux, peak=found.peak / gain,
        major_px=side * found.major_px, minor_px=side * found.minor_px,
        place_px2=None if found.place_px2 is None else pixels * found.place_px2,
    )  # fmt: skip
