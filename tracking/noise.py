"""How much the grey value of a pixel scatters, as a function of its level."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias, cast

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from geometry.arrays import Array
from geometry.camera import SensorNoise

Picture: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]

ROUNDING_DN2 = 1.0 / 12.0  # variance of rounding to whole DN

# Where nothing is known of the gain: a full scale of 10 000 electrons, as small industrial sensors have. 8 bit: 39
# electrons per DN.
_FULL_SCALE_E = 10_000.0

# Binomial coefficients of a fourth difference: blind to anything cubic, and all but blind to a spot of sigma >= 1.5 px,
# of which the second difference (Immerkaer's) would take a fifth of the variance for noise.
_FOURTH_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
_KERNEL_POWER = float(np.sum(_FOURTH_DIFFERENCE**2)) ** 2
_NORMAL_68, _NORMAL_95 = 0.994457883, 1.959963985  # quantiles 0.68 and 0.95 of |standard normal|
_LEVELS, _LEAST_PIXELS = 12, 60


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Variance of one pixel of expected grey value v: floor_dn2 + slope_dn (v - black_dn), the floor below black_dn."""

    floor_dn2: float  # read noise and rounding, DN^2 (estimated: all noise at the background's level)
    slope_dn: float  # DN^2 per DN: 1 / (electrons per DN)
    black_dn: float = 0.0  # level that the floor belongs to

    def __post_init__(self) -> None:
        if not (self.floor_dn2 > 0 and self.slope_dn >= 0):
            raise ValueError(
                f"noise model: expected floor_dn2 > 0 and slope_dn >= 0, got {self.floor_dn2} and {self.slope_dn}"
            )

    @staticmethod
    def of(sensor: SensorNoise) -> NoiseModel:
        """The model of a sensor whose gain, read noise and black level are known (rig.yaml: cameras.*.noise)."""
        read_dn = sensor.read_noise_e / sensor.gain_e_per_dn
        return NoiseModel(read_dn**2 + ROUNDING_DN2, 1.0 / sensor.gain_e_per_dn, sensor.black_dn)

    def variance(self, level_dn: ArrayLike) -> Array:
        """Variance, DN^2, of pixels whose expected grey values are given, any shape."""
        return self.floor_dn2 + self.slope_dn * np.maximum(np.asarray(level_dn) - self.black_dn, 0.0)


def guess_noise(image: Picture) -> NoiseModel:
    """A quick model from one picture's background (0.3 ms at 1280x1024); the slope is that of a usual sensor.

    The floor comes from differences of neighbours in a sparse sample, so texture counts as noise, as it should: it
    shifts a spot just as noise does. Both the 68 % and the 95 % quantile are asked and the larger believed, for in a
    picture that is black-clipped most differences are zero.
    """
    sample = image[2:-2:17, ::2].astype(np.float32) if min(image.shape) > 40 else image.astype(np.float32)
    jump = np.abs(sample[:, 1::4][:, : sample[:, ::4].shape[1]] - sample[:, ::4][:, : sample[:, 1::4].shape[1]])
    level = float(np.median(sample[:, ::4])) if sample.size else 0.0
    floor = _robust_variance(jump / np.sqrt(2.0)) if jump.size else 0.0
    return NoiseModel(max(floor, ROUNDING_DN2), _usual_slope(image.dtype), level)


def estimate_noise(images: Iterable[Picture]) -> NoiseModel:
    """The model of a sensor from some of its pictures, for a rig that states none (about 8 ms per megapixel picture).

    The picture is freed of everything smooth by a fourth difference in u and in v; what remains scatters in proportion
    to the noise, which is then read at the levels that the pictures have: background, screen, spots. A straight
    line over them is the model. Levels without enough pixels leave the slope of a usual sensor. One picture is
    enough; some (three to eight) make the slope trustworthy. Ours; after Immerkaer (1996), "Fast noise variance
    estimation", Computer Vision and Image Understanding 64, with the higher difference for the spots' sake.

    Errors: ValueError without a picture.
    """
    images = list(images)
    model = _from_differences(images)
    large = [image for image in images if min(image.shape) >= 18]
    halves = [cast(Picture, cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)) for image in large]
    if not halves:
        return model
    # White noise falls to a quarter in the mean of four pixels. That of JPEG pictures, of demosaiced ones and of a
    # screen's texture falls by less, and shows between pixels two apart: then all noise weighs so much more in a spot.
    coarse = 4 * (_from_differences(halves).floor_dn2 - ROUNDING_DN2)
    apart = float(np.median([guess_noise(image).floor_dn2 for image in large]))
    grain = max(coarse, apart) / model.floor_dn2
    grain = grain if grain > 1.25 else 1.0
    return NoiseModel(model.floor_dn2 * grain, model.slope_dn * grain, model.black_dn)


def _from_differences(images: Iterable[Picture]) -> NoiseModel:
    levels: list[NDArray[np.float32]] = []
    scatters: list[NDArray[np.float32]] = []
    slope, full_scale = None, 255.0
    for image in images:
        slope, full_scale = _usual_slope(image.dtype), float(np.iinfo(image.dtype).max)
        if min(image.shape) < 9:
            continue
        pixels = image.astype(np.float32)
        smooth_free = cv2.sepFilter2D(pixels, cv2.CV_32F, _FOURTH_DIFFERENCE, _FOURTH_DIFFERENCE)[4:-4, 4:-4]
        level = cv2.blur(pixels, (3, 3))[4:-4, 4:-4]
        unclipped = cv2.dilate(image, np.ones((5, 5), np.uint8))[4:-4, 4:-4] < full_scale
        # A sparse sample of the background is enough, but of what is bright every pixel is needed.
        bright = level > np.median(level[::8, ::8]) + 4.0 * np.sqrt(ROUNDING_DN2 + np.var(level[::8, ::8]))
        bright[::4, ::4] = True
        chosen = bright & unclipped
        levels.append(level[chosen])
        scatters.append(np.abs(smooth_free[chosen]) / np.float32(np.sqrt(_KERNEL_POWER)))
    if slope is None:
        raise ValueError("estimate_noise: expected at least one picture, got none")
    if not levels or sum(map(len, levels)) < _LEAST_PIXELS:
        return NoiseModel(ROUNDING_DN2, slope)
    return _line(np.concatenate(levels).astype(float), np.concatenate(scatters).astype(float), slope)


def _line(level: Array, scatter: Array, usual_slope: float) -> NoiseModel:
    background = float(np.median(level))
    spread = np.percentile(np.abs(level - background), 68)
    near = np.abs(level - background) <= max(spread, 1.0)
    floor = max(_robust_variance(scatter[near]), ROUNDING_DN2)
    top = float(level.max())
    first = background + max(3.0 * spread, 4.0 * np.sqrt(floor))
    if top <= first:
        return NoiseModel(floor, usual_slope, background)
    edges = np.geomspace(first - background, top - background + 1e-6, _LEVELS + 1) + background
    slopes, weights = [], []
    for low, high in pairwise(edges):
        here = (level >= low) & (level < high)
        count = int(here.sum())
        if count < _LEAST_PIXELS:
            continue
        variance, lift = _robust_variance(scatter[here]), float(level[here].mean()) - background
        slopes.append((variance - floor) / lift)
        weights.append(count * (lift / variance) ** 2)  # a variance is known to a share of itself
    if not slopes:
        return NoiseModel(floor, usual_slope, background)
    order = np.argsort(slopes)
    share = np.cumsum(np.asarray(weights)[order])
    slope = float(
        np.asarray(slopes)[order][np.searchsorted(share, 0.5 * share[-1])]
    )  # weighted median: texture is local
    return NoiseModel(floor, max(slope, 0.1 * usual_slope), background)


def _robust_variance(scatter: NDArray[np.floating]) -> float:
    """Variance of normal deviates whose absolute values are given, deaf to a few per cent of outliers."""
    low, high = np.quantile(scatter, [0.68, 0.95])
    return float(max(low / _NORMAL_68, high / _NORMAL_95) ** 2)


def _usual_slope(dtype: np.dtype) -> float:
    return float(np.iinfo(dtype).max) / _FULL_SCALE_E
