"""The variance of pixels as a function of their grey level, from differences in time or within a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools
from tracking.noise import Picture, guess_noise, quantile_variance, trimmed_variance
from tracking.rounding import rounding_ripple, unrounded

Floats: TypeAlias = NDArray[Any]

SIDE = 15  # px: side of the local mean that removes smooth changes of the light from the noise
LEAST_PIXELS = 200  # per level
LEVELS = 12  # largest number of levels
_STRIPE = 64  # rows per stripe of the sample
_LEAST_WHITE = 0.01  # DN^2: a smaller variance in time comes from single steps of a few pixels
_GRAIN = 1.25  # ratio of the variance of means to that of white noise up to which the noise counts as white
# Rows that share the change of their light; its sigmas from which it counts; structure over noise that shows it.
_ROWS, _LIGHT_SIGMAS, _STRUCTURE = 17, 8.0, 2.0
_FOURTH_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])  # zero for anything cubic; nearly so for a smooth spot


@dataclass(frozen=True, slots=True)
class LevelVariances:
    """Variances by grey level; k levels."""

    level: Array  # (k,), DN
    variance: Array  # (k,), DN^2
    sigma: Array  # (k,), DN^2, of the variance
    temporal: bool  # from differences in time
    correlation: float = 1.0  # variance of means of neighbouring pixels over that of independent pixels

    def scaled(self, floor: float, level_dn: float) -> LevelVariances:
        """All variances scaled so that the one at a level is `floor`, if that is larger by more than _GRAIN."""
        factor = floor / max(self.nearest(level_dn), 1e-12) if len(self.variance) else 1.0
        return replace(self, variance=self.variance * factor, sigma=self.sigma * factor) if factor > _GRAIN else self

    def nearest(self, level_dn: float) -> float:
        """The variance, DN^2, of the level nearest to `level_dn`; 0 without levels."""
        return float(self.variance[np.argmin(np.abs(self.level - level_dn))]) if len(self.level) else 0.0


def level_variances(pictures: Sequence[Picture], top: float, rounding: float) -> LevelVariances:
    """Variance as a function of level: in time if the scene is static, otherwise within the first picture.

    top: grey value at which the sensor clips, DN; rounding: variance of the rounding error, DN^2.
    """
    within = _binned(*_within(pictures[0], top), rounding)
    # Noise correlated between pixels (JPEG, demosaicing) is underestimated by differences of neighbouring pixels.
    guess = guess_noise(pictures[0])
    within = replace(within, temporal=False).scaled(guess.floor_dn2, guess.black_dn)
    samples = [_between(a, b, top) for a, b in _pairs(pictures)]
    if not samples:
        return within
    level, difference, grain = (np.concatenate(x) for x in zip(*samples, strict=True))
    if not len(level):  # black, or clipped
        return within
    between = _binned(level, difference, rounding)
    at = float(np.median(level))
    if between.nearest(at) > 1.5 * max(within.nearest(at), 2 * rounding):
        return within  # the camera or the scene moves
    return replace(between, correlation=float(np.median(grain)))


def _pairs(pictures: Sequence[Picture]) -> list[tuple[Picture, Picture]]:
    """Pairs of consecutive pictures, each picture in one pair (the last but one of an odd number in two); no copies."""
    some = [(pictures[i], pictures[i + 1]) for i in range(0, len(pictures) - 1, 2)]
    if len(pictures) % 2 and len(pictures) > 1:
        some.append((pictures[-2], pictures[-1]))
    return [(a, b) for a, b in some if not np.array_equal(a, b)]


def _between(a: Picture, b: Picture, top: float) -> tuple[Floats, Floats, Array]:
    """Levels (m,), differences in time over sqrt 2 (m,), and the variance ratio of correlated to white noise (1,)."""
    a, b = _stripes(a), _stripes(b)
    x, y = a.astype(np.float32), b.astype(np.float32)
    difference = (y - x) * np.float32(np.sqrt(0.5))
    coarse = max(np.sqrt(quantile_variance(np.abs(difference[::4, ::4]))), 0.5)
    held = np.clip(difference, -4 * coarse, 4 * coarse)
    difference -= cv2.blur(held, (SIDE, SIDE))
    both = 0.5 * (x + y)
    difference = _in_equal_light(difference, both, 4 * coarse)
    level = cv2.blur(both, (3, 3))
    chosen = _sample(level) & (cv2.dilate(cv2.max(a, b), np.ones((3, 3), np.uint8)) < top) & (cv2.min(a, b) > 0)
    white = trimmed_variance(difference[::4, ::4].ravel())
    grain = 1.0
    for cell in (2, 4) if white > _LEAST_WHITE else ():  # compressed pictures may be constant in time
        small = cv2.resize(difference, None, fx=1 / cell, fy=1 / cell, interpolation=cv2.INTER_AREA)
        share = cell**2 * trimmed_variance(small[::2, ::2].ravel()) / max(white, 1e-12)
        grain = max(grain, share / (1 - cell**2 / SIDE**2))
    factor = 1 / (1 - 1 / SIDE**2)
    return level[chosen], difference[chosen] * np.sqrt(factor), np.array([grain if grain > _GRAIN else 1.0])


def _in_equal_light(difference: Floats, level: Floats, largest: float) -> Floats:
    """A difference (h, w) without what changes of the light make of the structure of its rows; others as they are.

    level (h, w): of the pictures; largest: difference that is noise. Lamps flicker, also while a sensor reads its rows.
    """
    structure = level - cv2.blur(level, (SIDE, SIDE))
    seen = np.where(np.abs(difference) < largest, difference, np.float32(0.0))
    shared, power = (cv2.blur((structure * x).sum(axis=1, keepdims=True), (1, _ROWS)) for x in (seen, structure))
    change = shared / np.maximum(power, np.float32(1e-6))
    noise = trimmed_variance(difference[::4, ::4].ravel())
    changed = change**2 * _ROWS * power > _LIGHT_SIGMAS**2 * noise
    changed &= power > _STRUCTURE**2 * noise * difference.shape[1]
    return difference - change * structure if changed.any() else difference


def _stripes(picture: Picture) -> Picture:
    """Every other stripe of rows: enough pixels in half the time."""
    high = range(0, picture.shape[0], 2 * _STRIPE)
    return np.concatenate([picture[row : row + _STRIPE] for row in high]) if len(high) > 2 else picture


def _within(picture: Picture, top: float) -> tuple[Floats, Floats]:
    """Levels (m,) and fourth differences in u and v (m,), normalised to a pixel's noise.

    Source: after Immerkaer (1996), "Fast noise variance estimation", Computer Vision and Image Understanding 64, with
    a higher difference.
    """
    picture = _stripes(picture)
    pixels = picture.astype(np.float32)
    power = float(np.sum(_FOURTH_DIFFERENCE**2))
    rest = cv2.sepFilter2D(pixels, cv2.CV_32F, _FOURTH_DIFFERENCE, _FOURTH_DIFFERENCE) / np.float32(power)
    level = cv2.blur(pixels, (3, 3))
    chosen = _sample(level) & (cv2.dilate(picture, np.ones((5, 5), np.uint8)) < top)
    chosen &= cv2.erode(picture, np.ones((5, 5), np.uint8)) > 0
    return level[chosen], rest[chosen]


def _sample(level: Floats) -> Bools:
    """A sparse sample of the background and all pixels brighter than it."""
    few = level[::8, ::8]
    middle = np.median(few)
    chosen: Bools = level > middle + 4 * max(float(np.percentile(np.abs(few - middle), 68)), 1.0)
    chosen[::4, ::4] = True
    chosen[:3] = chosen[-3:] = False
    chosen[:, :3] = chosen[:, -3:] = False
    return chosen


def _binned(level: Floats, deviates: Floats, rounding: float) -> LevelVariances:
    """Variances of up to `LEVELS` levels with at least `LEAST_PIXELS` pixels each."""
    if len(level) < LEAST_PIXELS:
        return LevelVariances(np.zeros(0), np.zeros(0), np.zeros(0), temporal=True)
    low, high = np.quantile(level, [0.005, 1.0])
    # Half of the levels divide the background's pixels evenly, the others divide the range of values above it.
    middle = np.quantile(level, np.linspace(0.0, 0.95, LEVELS // 2 + 1))
    above = middle[-1] + np.geomspace(1.0, max(high - middle[-1], 0.0) + 2.0, LEVELS // 2 + 1)[1:] - 1.0
    edges = np.unique(np.concatenate([middle, above]))
    edges[0], edges[-1] = min(edges[0], low) - 1, high + 1
    rows = [(level >= bottom) & (level < ceiling) for bottom, ceiling in pairwise(edges)]
    rows = [here for here in rows if np.count_nonzero(here) >= LEAST_PIXELS]
    variance = np.array([unrounded(trimmed_variance(deviates[here]), rounding) for here in rows])
    count = np.array([np.count_nonzero(here) for here in rows])
    # The systematic errors limit the accuracy of every level: structure, a few per cent, and rounding.
    around = np.convolve(np.pad(variance, 1, mode="edge"), np.full(3, 1 / 3), "valid") if rows else variance
    sigma = np.hypot(variance * np.sqrt(2 / np.maximum(count, 1) + 0.03**2), rounding_ripple(around, rounding))
    return LevelVariances(np.array([np.mean(level[here]) for here in rows]), variance, sigma, temporal=True)
