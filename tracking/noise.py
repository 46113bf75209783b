"""The noise model of a sensor: variance of a pixel's grey value as a function of its level."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geometry.arrays import Array
from geometry.camera import SensorNoise
from tracking.rounding import clipped_normal

Picture: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]

CLIPPED_SHARE = 0.02  # share of pixels at zero above which the background counts as clipped
# Of the sigma: least median change between neighbours of which one is not zero, where hardly any and all are zero.
# White noise changes by 0.95 and 0.3, noise in a JPEG of quality 75 by 0.4 and 0.4; black objects by less than 0.2.
_LEAST_JUMP = 0.35, 0.15
BLOCK = 8  # px: side of the blocks in which pictures are searched
ROUNDING_DN2 = 1.0 / 12.0  # variance of rounding to whole DN

# Electrons at full scale, for sensors with unknown gain: typical of small industrial sensors (5 000 to 60 000). With
# 8 bits this is 59 electrons per DN.
FULL_SCALE_E = 15_000.0

_KEPT = 3.5  # sigmas: larger differences are outliers ...
_KEPT_VARIANCE = 0.99389  # ... and this is the variance of standard normal deviates truncated there
NORMAL_68, NORMAL_95 = 0.994457883, 1.959963985  # quantiles 0.68 and 0.95 of |standard normal|


@dataclass(frozen=True, slots=True)
class SpotProfile:
    """The shape that the lens and the pixels of a camera give to narrow spots: Gaussians of one centre."""

    near: float = 0.0  # share of the light in a near wing; with no wing they are single Gaussians
    near_px: float = 0.0  # by which its sigma is larger than the core's, in quadrature
    far: float = 0.0  # share of the light in a far wing
    uneven: float = 0.0  # of each pixel's light: 1-sigma deviations from this shape
    shape_px2: tuple[float, float, float] = (0.0, 0.0, 0.0)  # uu, uv, vv: usual covariance of a spot with its wings
    shape_sigma_px2: float = 0.0  # of a spot's covariance about the usual one; 0: that is not known


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Variance of a pixel that expects v DN: floor_dn2 + slope_dn (v - black_dn), at least floor_dn2 - shadow_dn2."""

    floor_dn2: float  # read noise and rounding, DN^2 (if estimated: all noise at the background's level)
    slope_dn: float  # DN^2 per DN: 1 / (electrons per DN)
    black_dn: float = 0.0  # grey value at which the variance is the floor
    texture: float = 0.0  # contrast of the background's fixed structure over a few pixels, as a fraction of its level;
    # used for the detection threshold only. Its effect on the positions of spots: noise_estimation/texture_shift.py
    banding_dn: float = 0.0  # sigma of rounding errors that neighbouring pixels share, because the noise is small
    correlation: float = 1.0  # variance of means of neighbouring pixels over that of independent pixels: above 1 in
    # compressed pictures. A spot's centre is such a mean, so detection uses `of_means`
    compression_dn2: float = 0.0  # variance that lossy compression adds to pixels with light, whose details it rounds
    profile: SpotProfile = SpotProfile()  # of narrow spots
    shadow_dn2: float = 0.0  # of the floor: what places with less light than the background lack, at most
    # (n, m): texture of each block of BLOCK x BLOCK pixels, at most `texture`; None: that everywhere
    local_texture: NDArray[np.float32] | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        if not (self.floor_dn2 > 0 and self.slope_dn >= 0):
            raise ValueError(
                f"noise model: expected floor_dn2 > 0 and slope_dn >= 0, got {self.floor_dn2} and {self.slope_dn}"
            )
        if not self.correlation >= 1:
            raise ValueError(f"noise model: expected correlation >= 1, got {self.correlation}")

    @staticmethod
    def of(sensor: SensorNoise) -> NoiseModel:
        """The model of a sensor with known gain, read noise and black level (rig.yaml: cameras.*.noise)."""
        read_dn = sensor.read_noise_e / sensor.gain_e_per_dn
        return NoiseModel(read_dn**2 + ROUNDING_DN2, 1.0 / sensor.gain_e_per_dn, sensor.black_dn)

    @property
    def of_means(self) -> NoiseModel:
        """The model of independent pixels whose means have the variance of this one's."""
        c = self.correlation
        floor, shadow = c * self.floor_dn2, c * self.shadow_dn2
        return replace(self, floor_dn2=floor, slope_dn=c * self.slope_dn, shadow_dn2=shadow, correlation=1.0)

    def in_steps(self, steps: float) -> NoiseModel:
        """The model of pictures in so many steps per DN."""
        return replace(
            self, floor_dn2=self.floor_dn2 * steps**2, slope_dn=self.slope_dn * steps, black_dn=self.black_dn * steps,
            shadow_dn2=self.shadow_dn2 * steps**2, banding_dn=self.banding_dn * steps,
            compression_dn2=self.compression_dn2 * steps**2,
        )  # fmt: skip

    def texture_of_blocks(self, rows: int, columns: int) -> NDArray[np.float32] | float:
        """The texture of each block of a picture of so many blocks; the same for all if it is not known for each."""
        local = self.local_texture
        return self.texture if local is None or local.shape != (rows, columns) else local

    def variance(self, level_dn: ArrayLike) -> Array:
        """Variance, DN^2, of pixels with the given expected grey values, DN, any shape."""
        rise = self.slope_dn * (np.asarray(level_dn) - self.black_dn)
        return self.floor_dn2 + np.maximum(rise, -self.shadow_dn2)


def guess_noise(image: Picture) -> NoiseModel:
    """A quick model from one picture's background (0.3 ms at 1280x1024), with the slope of a typical sensor.

    The floor comes from differences of neighbouring pixels in a sparse sample. Texture that is everywhere counts as
    noise; edges and objects, which are in few of the differences, do not. In a picture that is clipped at black the
    normal distribution that was clipped counts if it is wider; black objects on a brighter background do not matter.
    """
    sample = image[2:-2:17, ::2].astype(np.float32) if min(image.shape) > 40 else image.astype(np.float32)
    first, second = sample[:, ::4][:, : sample[:, 1::4].shape[1]], sample[:, 1::4][:, : sample[:, ::4].shape[1]]
    level = float(np.median(sample[:, ::4])) if sample.size else 0.0
    floor = trimmed_variance((second - first) / np.float32(np.sqrt(2.0)))
    if sample.size and np.mean(sample == 0) > CLIPPED_SHARE:
        sigma = clipped_normal(sample.ravel().astype(float))[1]
        if is_clipped_noise(first, second, sigma):
            floor = max(floor, sigma**2 + ROUNDING_DN2)
    slope = float(np.iinfo(image.dtype).max) / FULL_SCALE_E  # of a sensor with so many electrons at the largest value
    return NoiseModel(max(floor, ROUNDING_DN2), slope, level)


def is_clipped_noise(first: NDArray[np.generic], second: NDArray[np.generic], sigma: float) -> bool:
    """Whether neighbouring pixels (any equal shape), many of them zero, differ like noise of this sigma, DN.

    Black objects beside brighter ones have as wide a distribution of grey values, but nearly equal neighbours.
    """
    lit = np.maximum(first, second) > 0
    if not lit.any():
        return True
    least = float(np.interp(np.mean(first == 0), (0.0, 1.0), _LEAST_JUMP)) * sigma
    return bool(np.median(np.abs(second[lit].astype(float) - first[lit])) >= least)


def trimmed_variance(deviates: NDArray[Any]) -> float:
    """Variance of normal deviates, which may be rounded, with up to 20 % of outliers."""
    size = np.abs(deviates)
    variance = (float(np.quantile(size, 0.68)) / NORMAL_68) ** 2 if size.size else 0.0
    for _ in range(3):
        # With little noise, rounded differences are mostly 0 and sometimes one step.
        kept = size[size <= _KEPT * max(np.sqrt(variance), 0.3)]
        variance = float(np.mean(kept.astype(float) ** 2)) / _KEPT_VARIANCE if kept.size else 0.0
    return variance


def quantile_variance(scatter: NDArray[np.floating]) -> float:
    """Variance of normal deviates from their absolute values, robust to a few per cent of outliers."""
    low, high = np.quantile(scatter, [0.68, 0.95])
    return float(max(low / NORMAL_68, high / NORMAL_95) ** 2)
