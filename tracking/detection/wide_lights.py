"""Lights wider than the fit's windows: beams on a bare sensor, spots out of focus, lamps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tracking.detection.detect import find_spots
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture, guess_noise
from tracking.parameters import DetectParameters

WIDE_PX = 30.0  # sigma above which a light is sought in sums of pixels; a plain fit has windows for twice that
_SIDE = 8  # px: side of the squares
_BRIGHT = 0.5  # share of the picture's range that the peak of a light must have to be named as overlooked
_INSIDE = 2.0  # sigmas of a wide light: detections of its speckle and its edges are nearer than this ...
_PART = 1 / 3  # ... and wider than this share of it; a narrower one is a spot of its own


def find_all_sizes(picture: Picture, parameters: DetectParameters, noise: NoiseModel | None) -> Detections:
    """`find_spots`; lights wider than WIDE_PX, if max_sigma_px admits them, are found in sums of 8x8 pixels."""
    if parameters.max_sigma_px <= WIDE_PX:
        return find_spots(picture, parameters, noise)
    wide = find_wide_lights(picture, parameters, noise)
    others = find_spots(picture, replace(parameters, max_sigma_px=WIDE_PX), noise)
    return others[~_parts(others, wide)].joined(wide, parameters.max_detections)


def find_wide_lights(picture: Picture, parameters: DetectParameters, noise: NoiseModel | None) -> Detections:
    """Lights (n) with a sigma of WIDE_PX to max_sigma_px in a grey picture (h, w); their flux is in DN of its pixels.

    The noise of a sum of pixels is that of its pixels. A sum of 16 bit pixels is reduced to a mean.
    """
    model = noise or guess_noise(picture)
    height, width = (n // _SIDE for n in picture.shape)
    if min(height, width) < 2 * _SIDE:
        return Detections.none()
    cells = picture[: _SIDE * height, : _SIDE * width].reshape(height, _SIDE, width, _SIDE)
    means = cells.mean(axis=(1, 3), dtype=np.float32)
    pixels = float(_SIDE**2)
    gain = pixels if picture.dtype == np.uint8 else 1.0
    small = np.rint(gain * means).astype(np.uint16)
    top = np.iinfo(picture.dtype).max if parameters.saturation_dn is None else parameters.saturation_dn
    finer = replace(
        parameters, min_sigma_px=0.5 * WIDE_PX / _SIDE, max_sigma_px=parameters.max_sigma_px / _SIDE,
        saturation_dn=gain * float(top),
    )  # fmt: skip
    of_sums = NoiseModel(
        gain**2 * model.of_means.floor_dn2 / pixels + 1 / 12, gain * model.of_means.slope_dn / pixels,
        gain * model.black_dn, model.texture, gain * model.banding_dn,
    )  # fmt: skip
    found = find_spots(small, finer, of_sums)
    found = found[_SIDE * found.major_px > WIDE_PX]
    return replace(
        found, uv_px=_SIDE * found.uv_px + 0.5 * (_SIDE - 1), cov_px2=pixels * found.cov_px2,
        flux=pixels / gain * found.flux, peak=found.peak / gain,
        major_px=_SIDE * found.major_px, minor_px=_SIDE * found.minor_px,
    )  # fmt: skip


def overlooked_lights(
    picture: Picture, parameters: DetectParameters, noise: NoiseModel | None, found: Detections
) -> Detections:
    """Bright lights of any width that max_sigma_px excludes and of which nothing as wide is among the points found."""
    lights = find_wide_lights(picture, replace(parameters, max_sigma_px=float(max(picture.shape))), noise)
    low, high = np.quantile(picture[::4, ::4], [0.5, 0.999])
    lights = lights[(lights.major_px > parameters.max_sigma_px) & (lights.peak > _BRIGHT * (high - low))]
    apart = np.linalg.norm(lights.uv_px[:, None] - found.uv_px[None], axis=2) / lights.major_px[:, None]
    as_wide = found.major_px[None] > 0.5 * lights.major_px[:, None]
    return lights[~((apart < 1.0) & as_wide).any(axis=1)]


def _parts(found: Detections, wide: Detections) -> np.ndarray:
    """Which of the points (n,) are parts of a wide light."""
    apart = np.linalg.norm(found.uv_px[:, None] - wide.uv_px[None], axis=2)
    inside = (apart < _INSIDE * wide.major_px) & (found.major_px[:, None] > _PART * wide.minor_px)
    return np.asarray(inside.any(axis=1))
