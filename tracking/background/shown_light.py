"""How much of the light of the background a picture shows, and where it does: on a sample of the pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import MEDIAN_TO_SIGMA, Array, Bools, upper_median
from tracking.background.mean_pictures import LEAST_CHANGE, LEAST_LIGHT, MOST_LIGHT
from tracking.background.places import AROUND_SPOT
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture

_SAMPLE, _LEAST_SAMPLES = 10, 24  # every such row of a picture is in the sample; rows of that, in small pictures
_SMOOTH = (9, 9)  # of these pixels: what varies over them is not structure
_AROUND = (11, 11)  # of these pixels: 100 px: a part of the picture that shows the structure or does not
_CLEAR_SIGMAS = 4.0  # of the measured light
_EFFICIENCY = 2.0  # sigma of the median over places, of those that show most structure, over that of one fit
_MOST_LEFT = 2.5  # sigmas: more counts as much, since somebody in front of the screen is in many pixels
_BY_CHANCE = 4.0  # sigmas of the sum of squares, of few pixels between lights at rest
LARGEST_MISFIT = 1.3  # sigma of what is left over that of the noise; above it the camera or the light has moved

# Light that differs from row to row: sigma of its smoothing, in rows of the sample; its usual size; residuals beyond so
# many of their sigmas count as much; fits.
_ROWS, _USUAL_BAND, _LARGEST_LEFT, _FITS = 2.0, 0.2, 2.0, 4
_BAND_SIGMAS = 6.0  # of the light of a row that differs: there are up to 100 of them in a picture

_SOME = (slice(None, None, 2), slice(None, None, 2))  # of the sample, for medians over the whole picture
_Values: TypeAlias = NDArray[np.float32]


class Shown(NamedTuple):
    """What a picture (h, w) shows of a background."""

    light: float  # relative to the background
    clear: Bools  # on the sample: without lights
    left: _Values  # on the sample: what the background leaves, sigmas
    misfit: float  # its usual size
    # (2, h): light of each row, and its level, DN, where lamps flicker while a sensor reads its rows; None: all alike
    rows: Array | None = None

    @property
    def is_usual(self) -> bool:
        """Whether the picture is in the light of the background."""
        return self.light == 1.0 and self.rows is None

    def of_rows(self, height: int) -> Array:
        """(2, h): the light of each row, and its level, DN."""
        return np.outer((self.light, 0.0), np.ones(height)) if self.rows is None else self.rows


@dataclass(frozen=True, slots=True)
class ShownLight:
    """The structure of the background on a sample (a, b) of the pixels of pictures (h, w)."""

    size: tuple[int, int]  # h, w
    smooth: _Values  # (a, b), DN: the smooth part of the background
    level: _Values  # (a, b), DN: the background
    own: _Values  # (a, b), DN: the background without its smooth part
    plain: _Values  # (a, b): 1, and 0 near lights
    showing: Bools  # (a, b): the half of the places that show most structure
    noise: NoiseModel  # of the pictures
    noise_share: float  # variance of the background's own noise over that of a picture
    reference: float = 1.0  # what of the structure, which contains noise, the pictures show; 0: too little to measure
    in_mean: float = 0.0  # what a picture shows besides if its own noise is in the structure

    @staticmethod
    def of(
        structure: _Values, smooth: _Values, near_lights: Bools, noise: NoiseModel, noise_share: float, count: int,
        pictures: Sequence[Picture],
    ) -> ShownLight:  # fmt: skip
        """structure, near_lights: (h, w); smooth: on the sample. The light is 1 in a typical one of these pictures.

        Each of the pictures is one of `count` in the mean, whose noise it shows with a weight of one over their number.
        """
        rows, columns = sample_of(structure.shape)
        plain = (~near_lights[::rows, ::columns]).astype(np.float32)
        own = structure[::rows, ::columns]
        about = own - cv2.blur(own * plain, _SMOOTH) / np.maximum(cv2.blur(plain, _SMOOTH), np.float32(1e-3))
        seen = np.where(plain > 0, about, np.float32(0.0))
        power = _sums(seen * seen)
        first = ShownLight(
            structure.shape, smooth, smooth + own, own, plain, power >= np.median(power), noise, noise_share,
        )  # fmt: skip
        lights = [first._measured(first._seen(p))[0] for p in pictures]
        if not lights or not plain.any():
            return replace(first, reference=0.0)
        where = plain > 0
        of_noise = float(np.mean(noise.variance(smooth[where]))) / count
        in_mean = of_noise / max(float(np.mean(seen[where] ** 2)), 1e-12)
        reference = float(np.median(lights)) - in_mean
        return replace(first, reference=reference if reference > LEAST_LIGHT else 0.0, in_mean=in_mean)

    def in_picture(self, picture: Picture, largest_misfit: float = LARGEST_MISFIT) -> Shown | None:
        """How much of the structure a picture shows, relative to the background, and what it leaves.

        1 if it is the same within the errors of its measurement. None: the picture and the background do not fit.
        """
        if picture.shape != self.size:
            return None
        seen = self._seen(picture)
        light, clear, left, shown, misfit = self._fitted(seen)
        if not LEAST_LIGHT < light < MOST_LIGHT:
            return None
        of_rows, levels, differ = np.ones((len(seen), 1), np.float32), np.zeros((len(seen), 1), np.float32), False
        for _ in range(_FITS if self.reference else 0):
            differs, beyond = _light_of_rows(left, shown, clear, misfit)
            if not (differ or beyond.any()):
                break
            differ, step = (
                True,
                np.clip(1 + differs / np.float32(light), np.float32(LEAST_LIGHT), np.float32(MOST_LIGHT)),
            )
            counted = clear.astype(np.float32)
            level = _over_rows(counted * (seen - np.float32(light) * step * self.own))
            level /= np.maximum(_over_rows(counted), np.float32(1e-3))
            seen = (seen - level) / step
            of_rows, levels = of_rows * step, of_rows * level + levels
            light, clear, left, shown, misfit = self._fitted(seen)
        if misfit > largest_misfit:
            return None
        if not differ:
            return Shown(light, clear, left, misfit)
        at, known = np.arange(self.size[0]), np.arange(len(seen)) * sample_of(self.size)[0]
        every = np.array([np.interp(at, known, x[:, 0]) for x in (light * of_rows, levels)])
        return Shown(light, clear, left, misfit, every)

    def _seen(self, picture: Picture) -> _Values:
        """(a, b), DN: what the sample of a picture shows above the smooth part."""
        rows, columns = sample_of(self.size)
        return picture[::rows, ::columns].astype(np.float32) - self.smooth

    def _fitted(self, seen: _Values) -> tuple[float, Bools, _Values, _Values, float]:
        """The light relative to the background; and, on the sample: what is clear of lights, what the background
        leaves, its structure, both in sigmas of a pixel; the usual size of what it leaves.

        seen (a, b), DN: above the smooth part.
        """
        light, above, structure, clear, variance = self._measured(seen)
        light /= self.reference or 1.0
        power = float(np.sum(np.square(clear * structure)))
        sigma = (
            _EFFICIENCY * float(np.sqrt(upper_median(variance[_SOME]) / max(power, 1e-12))) / (self.reference or 1.0)
        )
        usual = max(LEAST_CHANGE, _CLEAR_SIGMAS * sigma)
        # Whether a picture is one of those in the mean is not known here: both of its lights are usual.
        if not self.reference or -usual < light - 1 < usual + self.in_mean / self.reference:
            light = 1.0
        sigmas = np.sqrt(variance * np.float32(1 + light**2 * self.noise_share))
        shown = structure / sigmas
        left = above / sigmas - np.float32(light) * shown
        return light, clear, left, shown, MEDIAN_TO_SIGMA * upper_median(np.abs(left[_SOME][clear[_SOME]]))

    def _measured(self, seen: _Values) -> tuple[float, _Values, _Values, Bools, _Values]:
        """The light, not yet relative to the reference; and, on the sample: what is above the smooth part, and the
        structure, DN, about the means around them; whether the place is clear of lights; variances, DN^2.

        seen (a, b), DN: above the smooth part.
        """
        more = upper_median(seen[_SOME])
        slope, black = np.float32(self.noise.slope_dn), np.float32(self.noise.black_dn - more)
        variance = np.float32(self.noise.floor_dn2) + slope * np.maximum(self.level - black, np.float32(0.0))
        sigmas = 6 * np.sqrt(variance)
        # Wide lights are in the means around them.
        even = self.plain * (np.abs(seen - more - self.own) < sigmas + np.abs(self.own))
        around = np.maximum(cv2.blur(even, _SMOOTH), np.float32(1e-3))
        above, structure = (x - cv2.blur(x * even, _SMOOTH) / around for x in (seen, self.own))
        clear = (self.plain > 0) & (np.abs(above) < sigmas + 4 * np.abs(structure))
        shown = clear * structure
        share = _sums(shown * above)[self.showing] / np.maximum(_sums(shown * shown)[self.showing], np.float32(1e-12))
        return upper_median(share), above, structure, clear, variance


def _light_of_rows(left: _Values, structure: _Values, clear: Bools, misfit: float) -> tuple[_Values, Bools]:
    """(a, 1) each: by how much the light of each row of the sample differs from their mean; where beyond its errors.

    left (a, b): what the background leaves, usually misfit; structure (a, b): of it; in sigmas of a pixel.
    """
    seen = clear * structure
    power = _over_rows(seen * seen) + np.float32(_USUAL_BAND**-2)
    most = np.float32(_LARGEST_LEFT * max(misfit, 1.0))
    differs = _over_rows(seen * np.clip(left, -most, most)) / power
    differs -= np.sum(power * differs) / np.sum(power)
    sigma = np.sqrt(1 / (2 * np.sqrt(np.pi) * _ROWS * power))
    return differs, np.asarray(np.abs(differs) > np.maximum(LEAST_CHANGE, _BAND_SIGMAS * sigma))


def sample_of(shape: tuple[int, ...]) -> tuple[int, int]:
    """Every such row and column of a picture (h, w) shows how much of the structure is in it."""
    rows = min(max(min(shape) // _LEAST_SAMPLES, 1), _SAMPLE)
    return rows, rows + 1


def fits_around(clear: Bools, left: _Values, spots: Detections, sample: tuple[int, int]) -> Bools:
    """(n,): whether what a picture leaves around spots, sigmas, is noise about its mean: before a person it is more.

    clear: the pixels of the sample that count; those of the spots do not: they explain them. The light of wide spots
    is in what `left` has been reduced by. sample: `sample_of` the picture.
    """
    clear = clear.copy()
    widths, more = AROUND_SPOT
    for at, reach in zip(spots.uv_px[:, ::-1] / sample, widths * spots.major_px + more, strict=True):
        most = np.ceil(reach / np.array(sample)).astype(int)
        rows, columns = (np.arange(max(int(x) - m, 0), int(x) + m + 2) for x, m in zip(at, most, strict=True))
        away2 = ((rows - at[0]) * sample[0])[:, None] ** 2 + ((columns - at[1]) * sample[1]) ** 2
        part = clear[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        part &= away2[: part.shape[0], : part.shape[1]] > reach**2
    counted = clear.astype(np.float32)
    means = cv2.blur(left * counted, _SMOOTH) / np.maximum(cv2.blur(counted, _SMOOTH), np.float32(1e-3))
    count, left2 = _sums(counted), np.square(left - means)
    least = LARGEST_MISFIT**2 * count + _BY_CHANCE * np.sqrt(2 * count)
    fits = _sums(np.asarray(counted * np.minimum(left2, _MOST_LEFT**2), np.float32)) <= least
    row, column = (np.clip(spots.uv_px[:, 1 - i] // sample[i], 0, n - 1).astype(int) for i, n in enumerate(fits.shape))
    return np.asarray(fits[row, column])


def _over_rows(values: _Values) -> _Values:
    """(a, 1): sums of the rows of the sample, smoothed over rows."""
    return np.asarray(cv2.GaussianBlur(values.sum(axis=1, keepdims=True), (1, 0), 0.1, sigmaY=_ROWS), np.float32)


def _sums(values: _Values) -> _Values:
    """Sums over the surroundings of each pixel of the sample."""
    return np.asarray(cv2.boxFilter(values, -1, _AROUND, normalize=False), np.float32)
