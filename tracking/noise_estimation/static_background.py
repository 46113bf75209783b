"""Faint spots on a textured screen: found after the fixed structure of the background has been subtracted.

The cameras and screens of a recording do not move, so texture, seams and the offsets of pixels are the same in all of
its pictures. They limit the detection in a single picture to spots well above the texture; in the difference from the
fixed picture only the noise is left. A light at rest and a reflection look the same in that picture, so the places of
its lights are left to the search in the whole picture (detection/detect.py), whose spots stay as they are. Source:
ours; the subtraction of a mean background is usual in particle image velocimetry, e.g. Raffel et al. (2018), "Particle
Image Velocimetry".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Bools, evenly_spread
from tracking.detection.detect import find_spots
from tracking.detections import Detections
from tracking.noise import BLOCK, NoiseModel, Picture
from tracking.noise_estimation.texture_shift import TextureShift
from tracking.parameters import DetectParameters

PICTURES = 15  # from which a background is made, spread over the recording
_LEAST_PICTURES = 9
_MOST_BYTES = 150_000_000  # of these pictures
_HIGHEST = 30.0  # sigmas of noise and texture
_LEAST_CLEAR = 7  # of these pictures without a light at a pixel
_CUT = 0.25  # share of the lowest and of the highest grey values of a pixel that is left out
_MEAN_VARIANCE = 1.4  # variance of these means of normal deviates times their number: 1.4 lower half, 1.2 middle
_LIMITING = 1.0  # variance of the texture over that of the noise, for means of 3x3 pixels, from which it matters
_SMOOTH_BLOCKS = 6.0  # blocks: sigma of the smooth part of the background, which is not subtracted
_STEPS = 16  # grey values per DN: the differences are not rounded to whole DN
_TRIED = 3  # every such picture shows whether there are further spots
_LEAST_FOUND = 0.2  # further or better spots per picture from which the subtraction is used
_SAMPLE = (7, 8)  # rows and columns: every such pixel shows how much of the structure is in a picture
_SMOOTH_SAMPLE = (13, 13)  # of these pixels: what varies over them is not structure
_AROUND_SAMPLE = (15, 15)  # of these pixels: 100 px: a part of the picture that shows the structure or does not
_LOCAL_LIGHT = 0.4  # largest difference of the light there from that of the whole picture, as a share
_CLEAR_SIGMAS = 4.0  # ... and in sigmas
_SAME_LIGHT = 0.03  # the light has not changed by more than this share: the structure is not scaled
_LEAST_LIGHT, _MOST_LIGHT = 0.2, 5.0  # changes of the light beyond which a picture is searched without subtraction
_LARGEST_MISFIT = 1.3  # sigma of what is left over that of the noise; above it the camera or the light has moved
_CLEARLY_BETTER = 0.5  # ratio of the variances of two measurements of a spot
# Widths, and px: kept clear of lights at rest; of other spots; a light itself.
_AROUND_LIGHT, _AROUND_SPOT, _ON_LIGHT = (3.0, 3.0), (3.0, 2.0), (2.5, 1.5)


def is_limited_by_texture(model: NoiseModel) -> bool:
    """Whether the texture of a camera's background hides spots that its noise would show."""
    contrast = model.texture if model.local_texture is None else float(np.median(model.local_texture))
    noise = float(model.of_means.variance(model.black_dn)) / 9
    return (contrast * model.black_dn) ** 2 > _LIMITING * noise


@dataclass(frozen=True, slots=True)
class StaticBackground:
    """The fixed structure of the pictures (h, w) of one camera."""

    pictures: int  # from which it is made
    structure: NDArray[np.float32]  # (h, w), DN: the fixed picture without its smooth part
    smooth: NDArray[np.float32]  # (h, w), DN, on the pixels of _SAMPLE
    near_lights: Bools  # (h, w): near lights that do not move
    steps: int  # grey values per DN of the difference
    offset_dn: float  # added to it
    subtracted: NDArray[np.uint16]  # (h, w): what is added to a picture in these steps
    model: NoiseModel  # of the difference, in its steps
    noise: NoiseModel  # of the pictures

    @staticmethod
    def of(pictures: Sequence[Picture], model: NoiseModel, shift: TextureShift) -> StaticBackground | None:
        """The background of pictures spread over a recording.

        None: too few, or of different sizes or types, or the differences from it show the spots in them no better.
        model: of the camera's noise and texture; shift: errors of its spots by the texture.
        """
        some = _usable(pictures)
        if len(some) < _LEAST_PICTURES:
            return None
        lower, mean = _means(some)
        background = StaticBackground._of_mean(lower, some, model)
        shown = [(p, fit[0]) for p in some if (fit := background._light_in(p)) is not None]
        some, lights = [p for p, _ in shown], [light for _, light in shown]
        if len(some) < _LEAST_PICTURES:
            return None
        equal: Sequence[NDArray[Any]] = some
        if max(lights) - min(lights) > 2 * _SAME_LIGHT:
            if 4 * some[0].size * len(some) > _MOST_BYTES:
                return None
            smooth = lower - background.structure
            equal = [smooth + (p - _smooth_part(p.astype(np.float32))) / light for p, light in shown]
            lower, mean = _means(equal)
            background = StaticBackground._of_mean(lower, some, model)
        tried = some[::_TRIED]
        if sum(background._found_in(p, shift)[1] for p in tried) < max(_LEAST_FOUND * len(tried), 2):
            return None
        return background._without_slow_lights(mean, some, equal, shift)

    def _without_slow_lights(
        self, mean: NDArray[np.float32], pictures: Sequence[Picture], equal: Sequence[NDArray[Any]], shift: TextureShift
    ) -> StaticBackground:
        """The background from the mean (h, w) of these pictures (in equal light), given the one from the lower half.

        A light that moves slowly, or rests for a part of the recording, is in the mean of the pictures. Where it is in
        some of them the others count; where its absence leaves a hole, those with the hole.
        """
        found = [self._found_in(p, shift)[0] for p in pictures]
        holes = [self.spots_in(p, DetectParameters(), shift, inverted=True) for p in pictures]
        there, absent = (np.array([_places_of(d, mean.shape, _ON_LIGHT) for d in all_]) for all_ in (found, holes))
        row, column = np.nonzero(there.any(axis=0) | absent.any(axis=0))
        clear, hole = ~there[:, row, column], absent[:, row, column]
        clear &= hole | ~hole.any(axis=0)
        count = np.count_nonzero(clear, axis=0)
        values = np.array([p[row, column] for p in equal], np.float32)
        enough = count >= _LEAST_CLEAR
        mean[row[enough], column[enough]] = ((values * clear).sum(axis=0) / np.maximum(count, 1))[enough]
        better = StaticBackground._of_mean(mean, pictures, self.noise)
        better.near_lights[row[~enough], column[~enough]] = True
        return better

    def _found_in(self, picture: Picture, shift: TextureShift) -> tuple[Detections, int]:
        """The spots found in a picture or in its difference, and how many of them the difference shows better."""
        usual = DetectParameters()
        in_picture = shift.added_to(find_spots(picture, usual, self.noise), self.noise)
        spots = self.spots_in(picture, usual, shift)
        kept, replaced = _compared(spots, in_picture)
        found = _joined(in_picture[~replaced], spots[kept], len(in_picture) + len(spots))
        return found, int(np.count_nonzero(kept))

    @property
    def _noise_share(self) -> float:
        """Variance of the background's own noise over that of a picture."""
        return _MEAN_VARIANCE / self.pictures

    @staticmethod
    def _of_mean(mean: NDArray[np.float32], pictures: Sequence[Picture], model: NoiseModel) -> StaticBackground:
        share = _MEAN_VARIANCE / len(pictures)
        smooth = _smooth_part(mean)
        sigma = float(np.hypot(np.sqrt(model.floor_dn2), model.texture * model.black_dn))
        structure = np.minimum(mean - smooth, _HIGHEST * sigma)  # what is higher is a light, or a hot pixel
        offset, steps = float(np.ceil(max(structure.max(), 0.0))), _STEPS
        top = max(int(p.max()) for p in pictures)
        while steps > 1 and (top + 2 * offset) * steps > np.iinfo(np.uint16).max:
            steps //= 2
        floor, slope = model.floor_dn2 * steps**2, model.slope_dn * steps
        fixed = replace(
            model, floor_dn2=floor * share, slope_dn=slope * share, black_dn=model.black_dn * steps,
            banding_dn=0.0, compression_dn2=0.0,
        )  # fmt: skip
        lights = find_spots(_in_steps(mean, steps), DetectParameters(), fixed)
        of_difference = replace(
            model, floor_dn2=floor * (1 + share), slope_dn=slope, black_dn=(model.black_dn + offset) * steps,
            texture=0.0, local_texture=None, banding_dn=model.banding_dn * steps,
            compression_dn2=model.compression_dn2 * steps**2,
        )  # fmt: skip
        rows, columns = _SAMPLE
        near = _places_of(lights, mean.shape, _AROUND_LIGHT) | (
            cv2.dilate((mean - smooth) - structure, np.ones((3, 3))) > 0
        )
        return StaticBackground(
            len(pictures), structure, smooth[::rows, ::columns].copy(), near, steps, offset,
            _in_steps(offset - structure, steps), of_difference, model,
        )  # fmt: skip

    def improved(
        self, found: Detections, picture: Picture, parameters: DetectParameters, shift: TextureShift
    ) -> Detections:
        """The points found in a picture and those found in its difference from the background, brightest first.

        Of two measurements of one spot that in the picture is kept, unless the other one is clearly more precise: then
        the texture under the spot is its largest error.
        """
        spots = self.spots_in(picture, parameters, shift)
        kept, replaced = _compared(spots, found)
        return _joined(found[~replaced], spots[kept], parameters.max_detections) if kept.any() else found

    def spots_in(
        self, picture: Picture, parameters: DetectParameters, shift: TextureShift, inverted: bool = False
    ) -> Detections:
        """The spots in the difference of a picture (h, w) from the background, apart from those near lights at rest.

        shift: errors of spots by the texture; the part that the background causes is subtracted with it. inverted: the
        holes of the difference instead.
        """
        fit = self._light_in(picture)
        if fit is None:
            return Detections.none()
        light, fits = fit
        added, model = self.subtracted, self.model
        if abs(light - 1) > _SAME_LIGHT:
            added = _in_steps(self.offset_dn - light * self.structure, self.steps)
            own = self._noise_share
            model = replace(model, floor_dn2=model.floor_dn2 * (1 + light**2 * own) / (1 + own))
        raised: NDArray[np.uint16] = np.multiply(picture, np.uint16(self.steps), dtype=np.uint16)
        difference = np.asarray(cv2.add(raised, added), np.uint16)
        if inverted:
            difference = np.asarray(cv2.subtract(np.full_like(difference, 2 * self.model.black_dn), difference))
        spots = find_spots(difference, replace(parameters, saturation_dn=None), model)
        row, column = (_nearest(spots.uv_px[:, i], picture.shape[1 - i]) for i in (1, 0))
        sampled = np.minimum(row // _SAMPLE[0], len(fits) - 1), np.minimum(column // _SAMPLE[1], fits.shape[1] - 1)
        spots = spots[~self.near_lights[row, column] & fits[sampled]]
        if not len(spots):
            return spots
        spots = replace(spots, flux=spots.flux / self.steps, peak=spots.peak / self.steps)
        # The background's own noise is the same in all pictures.
        fixed = self._noise_share / (1 + self._noise_share) * 0.5 * np.trace(spots.cov_px2, axis1=1, axis2=2)
        of_light = replace(shift, background_px=(0.0,) * len(shift.background_px))
        spots = of_light.added_to(spots, self.noise)
        place = np.zeros(len(spots)) if spots.place_px2 is None else spots.place_px2
        return replace(spots, place_px2=place + fixed)

    def _light_in(self, picture: Picture) -> tuple[float, Bools] | None:
        """How much of the structure a picture shows, relative to the background, and where it does.

        Places: on the pixels of _SAMPLE. None: the picture and the background do not fit.
        """
        if picture.shape != self.structure.shape:
            return None
        rows, columns = _SAMPLE
        plain = ~self.near_lights[::rows, ::columns]
        structure = _without_smooth_part(self.structure[::rows, ::columns], plain)
        above = picture[::rows, ::columns].astype(np.float32) - self.smooth
        more = float(np.median(above))
        above = _without_smooth_part(above, plain)
        variance = self.noise.variance(self.smooth + more).astype(np.float32)
        clear = plain & (np.abs(above) < 6 * np.sqrt(variance) + 4 * np.abs(structure))
        seen = np.where(clear, structure, 0.0)
        # A part of what is seen is the background's own noise, which the picture does not show.
        own = self._noise_share * self.noise.variance(self.smooth).astype(np.float32)
        # Where somebody stands in front of the screen the picture has another structure.
        power = np.maximum(_around(seen * seen - np.where(clear, own, 0.0)), 1e-12)
        here, sigma = _around(seen * above) / power, np.sqrt(_around(variance) / power / _around(np.ones_like(power)))
        light = float(np.median(here[sigma <= np.median(sigma)]))
        if not _LEAST_LIGHT < light < _MOST_LIGHT:
            return None
        left = np.where(clear, (above - light * structure) / np.sqrt(variance + light**2 * own), 0.0)
        if 1.4826 * float(np.median(np.abs(left[clear]))) > _LARGEST_MISFIT:
            return None
        others = _around(left * left) > _LARGEST_MISFIT**2 * _around(clear.astype(np.float32))
        return light, (np.abs(here - light) < np.maximum(_LOCAL_LIGHT * light, _CLEAR_SIGMAS * sigma)) & ~others


def _without_smooth_part(values: NDArray[np.float32], plain: Bools) -> NDArray[np.float32]:
    """Values on the pixels of _SAMPLE less the means of plain ones around them."""
    weight = plain.astype(np.float32)
    mean = cv2.blur(values * weight, _SMOOTH_SAMPLE) / np.maximum(cv2.blur(weight, _SMOOTH_SAMPLE), 1e-3)
    return np.asarray(values - mean, np.float32)


def _around(values: NDArray[Any]) -> NDArray[Any]:
    """Sums over the surroundings of each pixel of _SAMPLE."""
    return np.asarray(cv2.boxFilter(values, -1, _AROUND_SAMPLE, normalize=False))


def _joined(found: Detections, more: Detections, most: int) -> Detections:
    """The points of both lists, brightest first, at most so many."""
    if not len(more):
        return found
    values: dict[str, Any] = {}
    for name in Detections.__slots__:
        parts = [getattr(d, name) for d in (found, more)]
        known = [np.zeros(len(d)) if p is None else p for p, d in zip(parts, (found, more), strict=True)]
        values[name] = np.concatenate(known)
    return Detections(**values)[np.argsort(-values["flux"], kind="stable")[:most]]


def _usable(pictures: Sequence[Picture]) -> list[Picture]:
    """As many of the pictures as may be in memory, evenly spaced; none if they are too small or not alike."""
    if not pictures or min(pictures[0].shape) < 4 * BLOCK:
        return []
    if any(p.shape != pictures[0].shape or p.dtype != pictures[0].dtype for p in pictures):
        return []
    return [pictures[i] for i in evenly_spread(np.arange(len(pictures)), _MOST_BYTES // pictures[0].nbytes)]


def _means(pictures: Sequence[NDArray[Any]]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The means (h, w) of the lower half of each pixel's grey values, without the lowest, and of the middle half.

    The lower half does not contain lights that were elsewhere in half of the pictures; its noise is larger.
    """
    lower, middle = np.empty((2, *pictures[0].shape), np.float32)
    count = len(pictures)
    cut, strip = int(_CUT * count), 16 * BLOCK
    for top in range(0, len(lower), strip):
        values = np.sort([p[top : top + strip] for p in pictures], axis=0)
        lower[top : top + strip] = values[1 : count // 2].mean(axis=0, dtype=np.float32)
        middle[top : top + strip] = values[cut : count - cut].mean(axis=0, dtype=np.float32)
    return lower, middle


def _smooth_part(mean: NDArray[np.float32]) -> NDArray[np.float32]:
    """What of a picture (h, w) varies over many blocks, without small lights."""
    height, width = mean.shape
    whole = height // BLOCK * BLOCK, width // BLOCK * BLOCK
    blocks = cv2.resize(mean[: whole[0], : whole[1]], (width // BLOCK, height // BLOCK), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(cv2.medianBlur(blocks, 5), (0, 0), _SMOOTH_BLOCKS)
    return np.asarray(cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def _in_steps(values: NDArray[np.float32], steps: int) -> NDArray[np.uint16]:
    return np.clip(np.rint(values * steps), 0, np.iinfo(np.uint16).max).astype(np.uint16)


def _nearest(at: NDArray[np.float64], size: int) -> NDArray[np.int64]:
    return np.clip(np.rint(at), 0, size - 1).astype(np.int64)


def _places_of(lights: Detections, shape: tuple[int, ...], size: tuple[float, float]) -> Bools:
    """(h, w): pixels near the lights. size: widths, and px."""
    out = np.zeros(shape, np.uint8)
    widths, more = size
    for (u, v), width in zip(lights.uv_px, lights.major_px, strict=True):
        cv2.circle(out, (round(u), round(v)), round(widths * width + more), 1, cv2.FILLED)
    return out > 0


def _compared(spots: Detections, found: Detections) -> tuple[Bools, Bools]:
    """Which spots of a difference (n,) are kept, and which of those found in the picture (m,) they replace."""
    near = _near(spots, found)
    size2, usual2 = (np.trace(d.cov_px2, axis1=1, axis2=2) for d in (spots, found))
    replaces = near & (size2[:, None] < _CLEARLY_BETTER * usual2)
    kept = ~np.any(near & ~replaces, axis=1)
    return kept, np.asarray(replaces[kept].any(axis=0))


def _near(spots: Detections, found: Detections) -> Bools:
    """(n, m): spots that are parts of others, or the same."""
    widths, more = _AROUND_SPOT
    gap = np.linalg.norm(spots.uv_px[:, None] - found.uv_px, axis=-1)
    return np.asarray(gap < widths * found.major_px + more)
