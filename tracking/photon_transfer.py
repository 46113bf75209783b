"""A sensor's noise from its own pictures: photon transfer on what stays still, bounded by what sensors are like.

The variance of a pixel is the variance of the difference of two pictures, halved, where the scene stays still
(Janesick, Photon Transfer, SPIE 2007, chapter 5; EMVA Standard 1288, release 4.0, 6.6). Texture, edges and spots of a
vehicle at rest cancel in it. What does not cancel (moving spots, changing light) is removed by its local mean and by
robust statistics. The evidence for the slope is weighed together with a broad prior, so neither a structure nor a lack
of bright pixels can lead to a model that no sensor has. The combination is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import NormalDist
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools
from tracking.detect import find_spots
from tracking.noise import FULL_SCALE_E, NoiseModel, Picture, guess_noise, quantile_variance
from tracking.noise_of_spots import SpotResiduals, residuals_of_spots
from tracking.normal_tail import clipped_normal

Floats: TypeAlias = NDArray[Any]

_SIDE = 15  # px: changes of the light that are smooth over so many pixels are no noise
_KEPT = 3.5  # sigmas: differences beyond are outliers ...
_KEPT_VARIANCE = 0.99389  # ... and this is the variance of normal deviates that are cut there
_STRIPE = 64  # rows
_LEAST_PIXELS = 200  # of one level
_LEVELS = 12
_GRAIN = 1.25  # excess of the variance of means over white noise, below which it is taken for white
_CLIPPED = 0.02  # share of pixels at zero from which the background counts as clipped
_WELL_E = (1_000.0, 200_000.0)  # electrons at full scale: what sensors have, from the smallest to the largest
_WELL_SPREAD = 1.2  # sigma of the logarithm about FULL_SCALE_E: a decade is two sigmas
_READ_E = (0.7, 20.0)  # electrons of read noise, from scientific sensors to old ones
_LARGEST_MISFIT = 9.0  # squared sigmas: a level that contradicts the line by more is not noise alone
_SURE = 0.25  # sigma of the slope's logarithm from which spots are not asked: photon transfer is the better evidence
_LEAST_OF_SPOTS, _MOST_OF_SPOTS = 30, 300  # pixels of one brightness; residuals of one spot are not independent
_CONTRASTS = (0.0, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32)  # of the light's grain
_GRAIN_SIGMA = 0.5  # share of its own variance to which the grain is known


@dataclass(frozen=True, slots=True)
class NoiseEstimate:
    """A noise model that was estimated from pictures, with its uncertainty."""

    model: NoiseModel
    floor_sigma: float  # of the floor's logarithm
    slope_sigma: float  # of the slope's logarithm; 1.2: nothing but the prior
    saturation_dn: float | None  # level at which the sensor clips, as seen; None: not seen to clip
    step_dn: float  # grey values are multiples of this: 16 for 12 bits at the upper end of 16
    pictures: int  # that were looked at
    temporal: bool  # from differences in time; False: within pictures, where structure counts as noise


@dataclass(frozen=True, slots=True)
class _Levels:
    """Variances by grey level; k levels."""

    level: Array  # (k,), DN
    variance: Array  # (k,), DN^2
    sigma: Array  # (k,), DN^2, of the variance
    temporal: bool

    def scaled(self, floor: float) -> _Levels:
        """With all variances larger by so much that the least is near `floor`, where that is larger by _GRAIN."""
        factor = floor / max(float(self.variance.min()), 1e-12) if len(self.variance) else 1.0
        return replace(self, variance=self.variance * factor, sigma=self.sigma * factor) if factor > _GRAIN else self


def estimate_noise(pictures: Sequence[Picture]) -> NoiseEstimate:
    """The noise of a sensor from pictures (h, w) of one camera in their order of time, best in pairs of neighbours.

    One picture is enough for a usable model; two to six make it right. Pictures of other sizes than the first are left
    out.

    Errors: ValueError without a picture.
    """
    if not pictures:
        raise ValueError("estimate_noise: expected at least one picture, got none")
    usable = [p for p in pictures if p.shape == pictures[0].shape and p.dtype == pictures[0].dtype]
    step = _step(usable)
    saturation = saturation_level(usable, step)
    full = _full_scale(usable, step)
    rounding = step**2 / 12
    if min(usable[0].shape) < 2 * _SIDE:
        model = NoiseModel(max(_small_picture_variance(usable), rounding), full / FULL_SCALE_E)
        return NoiseEstimate(model, 1.0, _WELL_SPREAD, saturation, step, len(usable), temporal=False)
    top = float(np.iinfo(usable[0].dtype).max) if saturation is None else saturation
    levels = _levels(usable, top, rounding)
    background = float(np.median(np.concatenate([p[::8, ::8].ravel() for p in usable])))
    dark = _clipped_background(usable, step)
    floor, floor_sigma = _floor(levels, background)
    if dark is not None:
        background, floor = dark
    floor = max(floor, rounding)
    slopes = np.geomspace(full / _WELL_E[1], full / _WELL_E[0], 81)
    belief = _prior(slopes, full, floor, rounding, background) + _of_levels(slopes, levels, floor, background)
    slope, slope_sigma = _summary(slopes, belief)
    if slope_sigma > _SURE:  # nothing still is bright enough: the spots themselves
        found = [find_spots(p, noise=NoiseModel(floor, slope, background)) for p in usable]
        belief = belief + _of_spots(slopes, residuals_of_spots(usable, found, top), floor, background)
        slope, slope_sigma = _summary(slopes, belief)
    model = NoiseModel(floor, slope, background)
    return NoiseEstimate(model, floor_sigma, slope_sigma, saturation, step, len(usable), levels.temporal)


# What the numbers of the pictures are -------------------------------------------------------------------------------


def _step(pictures: Sequence[Picture]) -> float:
    """Greatest common divisor of the grey values, as sampled."""
    divisor = 0
    for picture in pictures:
        sample = np.unique(picture[::3, ::3]) if picture.size else np.zeros(1, picture.dtype)
        divisor = int(np.gcd.reduce(np.append(sample.astype(np.int64), divisor)))
    # A constant picture has any divisor; real steps are powers of two.
    return float(divisor & -divisor) if 0 < divisor & -divisor <= 64 else 1.0


def saturation_level(pictures: Sequence[Picture], step_dn: float) -> float | None:
    """The grey value at which the sensor clips, where the pictures show one; None: only the type's largest number.

    Light that is cut off piles up at one value: there are many more pixels at it than one step below. 10 and 12 bits in
    files of 16 show it at 1023 or 4095, a camera with an offset anywhere.
    """
    top = max((int(p.max()) for p in pictures if p.size), default=0)
    if not pictures or top == np.iinfo(pictures[0].dtype).max or top == 0:
        return None
    at_top = sum(int(np.count_nonzero(p == top)) for p in pictures)
    below = sum(int(np.count_nonzero(p == top - int(step_dn))) for p in pictures if top >= step_dn)
    full_of_bits = top / step_dn + 1 in (1024, 2**12, 2**14)
    return float(top) if at_top > 3 * below + (2 if full_of_bits else 12) else None


def _full_scale(pictures: Sequence[Picture], step_dn: float) -> float:
    """The largest grey value of the camera's own bit depth, at least 8 bits, DN."""
    top = max(int(p.max()) for p in pictures) if pictures[0].size else 0
    bits = max(int(np.ceil(np.log2(top / step_dn + 1))), 8)
    return float(min(step_dn * 2.0**bits - step_dn, np.iinfo(pictures[0].dtype).max))


def _small_picture_variance(pictures: Sequence[Picture]) -> float:
    pixels = np.concatenate([np.abs(np.diff(p.astype(float), axis=1)).ravel() for p in pictures] or [np.zeros(0)])
    return quantile_variance(pixels / np.sqrt(2)) if pixels.size else 0.0


# Variances by level --------------------------------------------------------------------------------------------------


def _levels(pictures: Sequence[Picture], top: float, rounding: float) -> _Levels:
    """Variance as a function of level: in time if the scene stays still, else within the pictures."""
    within = _binned(*_within(pictures[0], top), rounding)
    # Noise that goes together over pixels (JPEG, demosaicing) hardly shows in differences of near ones.
    within = replace(within, temporal=False).scaled(guess_noise(pictures[0]).floor_dn2)
    samples = [_between(a, b, top) for a, b in _pairs(pictures)]
    if not samples:
        return within
    level, difference, grain = (np.concatenate(x) for x in zip(*samples, strict=True))
    between = _binned(level, difference, rounding)
    between = replace(between, variance=between.variance * np.median(grain), sigma=between.sigma * np.median(grain))
    at = float(np.median(level))
    if _floor(between, at)[0] > 1.5 * max(_floor(within, at)[0], 2 * rounding):
        return within  # the camera or the scene shakes
    return between


def _pairs(pictures: Sequence[Picture]) -> list[tuple[Picture, Picture]]:
    """Neighbours, each picture in one pair (the last of an odd number in two), without a picture and its copy."""
    some = [(pictures[i], pictures[i + 1]) for i in range(0, len(pictures) - 1, 2)]
    if len(pictures) % 2 and len(pictures) > 1:
        some.append((pictures[-2], pictures[-1]))
    return [(a, b) for a, b in some if not np.array_equal(a, b)]


def _between(a: Picture, b: Picture, top: float) -> tuple[Floats, Floats, Array]:
    """Levels (m,), differences in time over sqrt 2 (m,), and by how much noise goes together over pixels (1,)."""
    a, b = _stripes(a), _stripes(b)
    x, y = a.astype(np.float32), b.astype(np.float32)
    difference = (y - x) * np.float32(np.sqrt(0.5))
    coarse = max(np.sqrt(quantile_variance(np.abs(difference[::4, ::4]))), 0.5)
    held = np.clip(difference, -4 * coarse, 4 * coarse)
    difference -= cv2.blur(held, (_SIDE, _SIDE))
    level = cv2.blur(0.5 * (x + y), (3, 3))
    chosen = _sample(level) & (cv2.dilate(cv2.max(a, b), np.ones((3, 3), np.uint8)) < top) & (cv2.min(a, b) > 0)
    white = trimmed_variance(difference[::4, ::4].ravel())
    grain = 1.0
    for cell in (2, 4):
        small = cv2.resize(difference, None, fx=1 / cell, fy=1 / cell, interpolation=cv2.INTER_AREA)
        share = cell**2 * trimmed_variance(small[::2, ::2].ravel()) / max(white, 1e-12)
        grain = max(grain, share / (1 - cell**2 / _SIDE**2))
    factor = 1 / (1 - 1 / _SIDE**2)
    return level[chosen], difference[chosen] * np.sqrt(factor), np.array([grain if grain > _GRAIN else 1.0])


def _stripes(picture: Picture) -> Picture:
    """Half of the rows, in stripes: enough pixels, at half of the time."""
    high = range(0, picture.shape[0], 2 * _STRIPE)
    return np.concatenate([picture[row : row + _STRIPE] for row in high]) if len(high) > 2 else picture


_FOURTH_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])  # zero for anything cubic; nearly so for a smooth spot


def _within(picture: Picture, top: float) -> tuple[Floats, Floats]:
    """Levels (m,) and fourth differences in u and v (m,), normalised to a pixel's noise. After Immerkaer (1996), "Fast
    noise variance estimation", Computer Vision and Image Understanding 64, with a higher difference."""
    picture = _stripes(picture)
    pixels = picture.astype(np.float32)
    power = float(np.sum(_FOURTH_DIFFERENCE**2))
    rest = cv2.sepFilter2D(pixels, cv2.CV_32F, _FOURTH_DIFFERENCE, _FOURTH_DIFFERENCE) / np.float32(power)
    level = cv2.blur(pixels, (3, 3))
    chosen = _sample(level) & (cv2.dilate(picture, np.ones((5, 5), np.uint8)) < top)
    chosen &= cv2.erode(picture, np.ones((5, 5), np.uint8)) > 0
    return level[chosen], rest[chosen]


def _sample(level: Floats) -> Bools:
    """A sparse sample of the background, and every pixel that is brighter."""
    few = level[::8, ::8]
    middle = np.median(few)
    chosen: Bools = level > middle + 4 * max(float(np.percentile(np.abs(few - middle), 68)), 1.0)
    chosen[::4, ::4] = True
    chosen[:3] = chosen[-3:] = False
    chosen[:, :3] = chosen[:, -3:] = False
    return chosen


def trimmed_variance(deviates: Floats) -> float:
    """Variance of normal, perhaps rounded, deviates among up to a tenth of outliers."""
    size = np.abs(deviates)
    variance = quantile_variance(size) if size.size else 0.0
    for _ in range(3):
        # Rounded differences of little noise are mostly 0, with some of one step.
        kept = size[size <= _KEPT * max(np.sqrt(variance), 0.3)]
        variance = float(np.mean(kept.astype(float) ** 2)) / _KEPT_VARIANCE if kept.size else 0.0
    return variance


def _binned(level: Floats, deviates: Floats, rounding: float) -> _Levels:
    """Variances of up to `_LEVELS` levels with enough pixels each."""
    if len(level) < _LEAST_PIXELS:
        return _Levels(np.zeros(0), np.zeros(0), np.zeros(0), temporal=True)
    low, high = np.quantile(level, [0.005, 1.0])
    # Half of the levels share the background's pixels evenly, the others the range above it.
    middle = np.quantile(level, np.linspace(0.0, 0.95, _LEVELS // 2 + 1))
    above = middle[-1] + np.geomspace(1.0, max(high - middle[-1], 0.0) + 2.0, _LEVELS // 2 + 1)[1:] - 1.0
    edges = np.unique(np.concatenate([middle, above]))
    edges[0], edges[-1] = min(edges[0], low) - 1, high + 1
    out = []
    for bottom, ceiling in pairwise(edges):
        here = (level >= bottom) & (level < ceiling)
        count = int(np.count_nonzero(here))
        if count < _LEAST_PIXELS:
            continue
        variance = unrounded(trimmed_variance(deviates[here]), rounding)
        # No level is known better than by the statistics' own faults: structure, a few per cent, and rounding.
        rounded = 0.5 * rounding if variance < 3.5 * rounding else 0.0
        out.append((float(np.mean(level[here])), variance, np.hypot(variance * np.sqrt(2 / count + 0.03**2), rounded)))
    columns = np.array(out).reshape(-1, 3).T
    return _Levels(columns[0], columns[1], columns[2], temporal=True)


def unrounded(variance: float, rounding: float) -> float:
    """The variance of noise and rounding, DN^2, from the variance in time of rounded values.

    With little noise a value is rounded to the same number in every picture, and that part of its error does not show
    in time. Over levels that are spread evenly, the variance in time of noise of sigma s (in steps) is the mean of
    p (1 - p), p the normal integral: s / sqrt(pi) where s is small, s^2 + 1/12 where it is not.
    """
    in_steps = variance / (12 * rounding)
    noise = float(np.interp(in_steps, _IN_TIME, _NOISE_STEPS**2)) if in_steps < _IN_TIME[-1] else in_steps - 1 / 12
    return (noise + 1 / 12) * 12 * rounding


def _variance_in_time(sigma: float) -> float:
    """Variance of rounded normal deviates of this sigma, in steps, averaged over the place between two steps."""
    level = (np.arange(64) + 0.5) / 64
    edges = np.arange(-6, 8) - 0.5
    below = np.array([[NormalDist(mean, sigma).cdf(edge) for edge in edges] for mean in level])
    share, value = np.diff(below, axis=1), np.arange(-6, 7)
    return float(np.mean(share @ value**2 - (share @ value) ** 2))


_NOISE_STEPS = np.array([0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.8])
_IN_TIME = np.array([0.0] + [_variance_in_time(float(s)) for s in _NOISE_STEPS[1:]])


def _floor(levels: _Levels, background: float) -> tuple[float, float]:
    """Variance at the background's level, DN^2, and the sigma of its logarithm."""
    if not len(levels.level):
        return 0.0, 1.0
    nearest = int(np.argmin(np.abs(levels.level - background)))
    return float(levels.variance[nearest]), float(levels.sigma[nearest] / max(levels.variance[nearest], 1e-12))


def _clipped_background(pictures: Sequence[Picture], step: float) -> tuple[float, float] | None:
    """Mean and variance before clipping of a background that is partly clipped at zero; None: it is not clipped."""
    # The darker half of the blocks: the others hold light.
    blocks = np.concatenate([_blocks(p) for p in pictures])
    mean = blocks.mean(axis=1, dtype=np.float64)
    sample = blocks[mean <= np.median(mean)].ravel()
    if np.mean(sample == 0) < _CLIPPED:
        return None
    mean, sigma = clipped_normal(sample.astype(float) / step)
    return mean * step, (sigma * step) ** 2 + step**2 / 12


def _blocks(picture: Picture) -> NDArray[np.generic]:
    """Every other row and column of blocks of 32x32 pixels, (blocks, 256)."""
    height, width = (n // 32 for n in picture.shape)
    cut = picture[: 32 * height : 2, : 32 * width : 2].reshape(height, 16, width, 16)
    return cut.transpose(0, 2, 1, 3).reshape(height * width, 256)


# The slope -----------------------------------------------------------------------------------------------------------


def _prior(slopes: Array, full: float, floor: float, rounding: float, background: float) -> Array:
    """Log prior (k,) of slopes, DN: a usual full well, and a read noise that exists."""
    belief = -0.5 * (np.log(slopes * FULL_SCALE_E / full) / _WELL_SPREAD) ** 2
    # The floor holds read noise and the shot noise of the background's light, which lies between 0 and its level.
    read2 = np.maximum(floor - rounding, 0.02 * rounding)
    too_noisy = np.log(np.maximum((_READ_E[0] * slopes) ** 2 / read2, 1.0))
    too_quiet = np.log(np.maximum(read2 / ((_READ_E[1] * slopes) ** 2 + slopes * max(background, 0.0)), 1.0))
    return belief - 2.0 * (too_noisy**2 + too_quiet**2)


def _of_levels(slopes: Array, levels: _Levels, floor: float, background: float) -> Array:
    """Log likelihood (k,) of slopes given variances by level, each of which may be off by more than its sigma."""
    if len(levels.level) < 2 or not levels.temporal:
        return np.zeros(len(slopes))
    expected = floor + slopes[:, None] * np.maximum(levels.level - background, background - levels.level.max())
    expected = np.maximum(expected, 0.05 * floor)
    misfit = np.log(levels.variance / expected) / (levels.sigma / levels.variance)
    return -0.5 * np.minimum(misfit**2, _LARGEST_MISFIT).sum(axis=1)


def _of_spots(slopes: Array, spots: SpotResiduals, floor: float, background: float) -> Array:
    """Log likelihood (k,) of slopes given the residuals of fitted spots, whichever contrast their light's grain has.

    The grain of the light (texture, speckle, a spot that is no Gaussian) adds the square of the contrast times the
    light, known to a share of itself only: where it rules, the residuals say nothing of the slope.
    """
    if len(spots.square) < _LEAST_PIXELS:
        return np.zeros(len(slopes))
    edges = np.geomspace(max(0.03 * float(spots.light.max()), 1e-6), float(spots.light.max()) * 1.001, _LEVELS)
    place = np.digitize(spots.light, edges)
    rows = [here for here in (place == k for k in range(len(edges))) if np.count_nonzero(here) >= _LEAST_OF_SPOTS]
    seen = np.array([np.mean(np.minimum(spots.square[r], 12 * np.median(spots.square[r]) + 1e-9)) for r in rows])
    light = np.array([np.mean(spots.light[r] ** 2) for r in rows])
    lift = np.array([np.mean(np.maximum(spots.level[r] - background, 0.0)) for r in rows])
    count = np.array([np.count_nonzero(r) for r in rows])
    belief = np.zeros((len(_CONTRASTS), len(slopes)))
    for row, contrast in enumerate(_CONTRASTS):
        grain = contrast**2 * light
        expected = floor + slopes[:, None] * lift + grain
        sigma = np.sqrt((2 / np.minimum(count, _MOST_OF_SPOTS) + 0.1**2) * expected**2 + (_GRAIN_SIGMA * grain) ** 2)
        misfit = (seen - expected) / sigma
        belief[row] = -0.5 * np.sum(np.minimum(misfit**2, _LARGEST_MISFIT) + 2 * np.log(sigma), axis=1)
    return np.logaddexp.reduce(belief - belief.max(), axis=0)


def _summary(slopes: Array, belief: Array) -> tuple[float, float]:
    """Mean and sigma of the slope's logarithm, the mean as a slope."""
    weight = np.exp(belief - belief.max())
    weight /= weight.sum()
    log = np.log(slopes)
    mean = float(weight @ log)
    return float(np.exp(mean)), float(np.sqrt(weight @ (log - mean) ** 2))
