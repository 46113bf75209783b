"""What moves in front of a fixed background: found after the background has been subtracted.

The cameras and screens of a recording do not move, so texture, objects, lamps and the offsets of pixels are the same in
all of its pictures. They limit the detection in a single picture; in the difference from the fixed picture only what
moves is left, and the noise. Lights at rest are measured separately (resting_lights.py). Source: ours; the subtraction
of a mean background is usual in particle image velocimetry, e.g. Raffel et al. (2018), "Particle Image Velocimetry".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Bools
from tracking.background.mean_pictures import (
    MOST_BYTES,
    highest_of_blocks,
    in_steps,
    means_of,
    raised_difference,
    smooth_part,
    usable,
)
from tracking.background.places import (
    AROUND_LIGHT,
    AROUND_SPOT,
    ON_LIGHT,
    inside,
    nearest,
    number_of_better,
    places_of,
)
from tracking.background.resting_lights import RestingLights
from tracking.background.shown_light import SAME_LIGHT, SAMPLE, ShownLight
from tracking.detection.detect import find_spots, saturation_of
from tracking.detection.pixels import TEXTURE_SHARE
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture
from tracking.noise_estimation.texture_shift import TextureShift
from tracking.parameters import DetectParameters

PICTURES = 15  # from which a background is made, spread over the recording
_LEAST_PICTURES = 9
_HIGHEST = 30.0  # sigmas of noise and texture
_LEAST_CLEAR = 7  # of these pictures without a light at a pixel
_MEAN_VARIANCE = 1.4  # variance of these means of normal deviates times their number: 1.4 lower half, 1.2 middle
_LOW = 0.25  # quantile of the background whose noise the difference is taken to have; brighter places count as uneven
_STEPS = 16  # grey values per DN: the differences are not rounded to whole DN
_TRIED = 3  # every such picture shows whether there are further spots
_MANY_LIGHTS = 4  # at rest, from which the subtraction is used in any case: it spares their fits
_LEAST_FOUND = 0.2  # further or better spots per picture from which the subtraction is used


@dataclass(frozen=True, slots=True)
class StaticBackground:
    """The fixed structure of the pictures (h, w) of one camera."""

    pictures: int  # from which it is made
    structure: NDArray[np.float32]  # (h, w), DN: the fixed picture without its smooth part
    smooth: NDArray[np.float32]  # DN, on the pixels of shown_light.SAMPLE
    near_lights: Bools  # (h, w): near lights that do not move
    blind: Bools  # (h, w): the difference does not show what is there
    lights: RestingLights
    unknown: NDArray[np.float64]  # (m, 3): u, v and half side, px, of places that are searched in the pictures
    parameters: DetectParameters
    steps: int  # grey values per DN of the difference
    level_dn: float  # of the difference
    low_dn: float  # level of the pictures whose noise `model` has at that level
    subtracted: NDArray[np.uint16]  # (h, w): what is added to a picture in these steps
    model: NoiseModel  # of the difference, in its steps
    noise: NoiseModel  # of the pictures
    shown: ShownLight

    @staticmethod
    def of(
        pictures: Sequence[Picture], model: NoiseModel, shift: TextureShift, parameters: DetectParameters
    ) -> StaticBackground | None:
        """The background of pictures spread over a recording.

        None: too few, or of different sizes or types, or with few lights at rest, while the differences from it show
        the spots in them no better. model: of the camera's noise and texture; shift: errors of its spots by the
        texture; parameters: with the grey value at which the sensor clips.
        """
        some = usable(pictures)
        if len(some) < _LEAST_PICTURES:
            return None
        lower, mean = means_of(some)
        background = StaticBackground._of_mean(lower, some, model, parameters)._with_light(some)
        shown = [(p, fit[0]) for p in some if (fit := background.shown.in_picture(p)) is not None]
        some, lights = [p for p, _ in shown], [light for _, light in shown]
        if len(some) < _LEAST_PICTURES:
            return None
        equal: Sequence[NDArray[Any]] = some
        if set(lights) != {1.0}:
            if 4 * some[0].size * len(some) > MOST_BYTES:
                return None
            smooth = lower - background.structure
            equal = [smooth + (p - smooth_part(p.astype(np.float32))) / light for p, light in shown]
            lower, mean = means_of(equal)
            background = StaticBackground._of_mean(lower, some, model, parameters)._with_light(some)
        tried = some[::_TRIED]
        few = len(background.lights.found) < _MANY_LIGHTS
        if few and sum(background._better_in(p, shift) for p in tried) < max(_LEAST_FOUND * len(tried), 2):
            return None
        return background._without_slow_lights(mean, some, equal, shift)

    def _without_slow_lights(
        self, mean: NDArray[np.float32], pictures: Sequence[Picture], equal: Sequence[NDArray[Any]], shift: TextureShift
    ) -> StaticBackground:
        """The background from the mean (h, w) of these pictures (in equal light), given the one from the lower half.

        A light that moves slowly, or rests for a part of the recording, is in the mean of the pictures. Where it is in
        some of them the others count; where its absence leaves a hole, those with the hole.
        """
        found = [self._searched(p, self.parameters, shift) for p in pictures]
        holes = [self.spots_in(p, self.parameters, shift, inverted=True) for p in pictures]
        there, absent = (np.array([places_of(d, mean.shape, ON_LIGHT) for d in all_]) for all_ in (found, holes))
        row, column = np.nonzero(there.any(axis=0) | absent.any(axis=0))
        clear, hole = ~there[:, row, column], absent[:, row, column]
        clear &= hole | ~hole.any(axis=0)
        count = np.count_nonzero(clear, axis=0)
        values = np.array([p[row, column] for p in equal], np.float32)
        enough = count >= _LEAST_CLEAR
        mean[row[enough], column[enough]] = ((values * clear).sum(axis=0) / np.maximum(count, 1))[enough]
        better = StaticBackground._of_mean(mean, pictures, self.noise, self.parameters)
        unknown = np.zeros(mean.shape, np.uint8)
        unknown[row[~enough], column[~enough]] = 1
        better.near_lights[unknown > 0] = True
        better.blind[unknown > 0] = True
        _, _, places, _ = cv2.connectedComponentsWithStats(unknown)
        left, top, width, height = places[1:, : cv2.CC_STAT_AREA].T.astype(float)
        half = 0.5 * np.maximum(width, height) + AROUND_SPOT[1]
        boxes = np.column_stack([left + 0.5 * (width - 1), top + 0.5 * (height - 1), half])
        return replace(better, unknown=boxes)._with_light(pictures)

    def _with_light(self, pictures: Sequence[Picture]) -> StaticBackground:
        """The background whose light is 1 in a typical one of the pictures that it is made from."""
        shown = ShownLight.of(
            self.structure, self.smooth, self.near_lights, self.noise, self._noise_share, self.pictures,
            pictures[::_TRIED],
        )  # fmt: skip
        return replace(self, shown=shown)

    def _better_in(self, picture: Picture, shift: TextureShift) -> int:
        """How many spots the difference of a picture shows that the picture does not, or clearly more precisely."""
        in_picture = shift.added_to(find_spots(picture, self.parameters, self.noise), self.noise)
        return number_of_better(self.spots_in(picture, self.parameters, shift), in_picture)

    def _searched(self, picture: Picture, parameters: DetectParameters, shift: TextureShift) -> Detections:
        """The points of a picture that move or have changed; all points of one that does not fit."""
        parts = self._parts(picture, parameters, shift)
        return shift.added_to(find_spots(picture, parameters, self.noise), self.noise) if parts is None else parts[0]

    @property
    def _noise_share(self) -> float:
        """Variance of the background's own noise over that of a picture."""
        return _MEAN_VARIANCE / self.pictures

    @staticmethod
    def _of_mean(
        mean: NDArray[np.float32], pictures: Sequence[Picture], model: NoiseModel, parameters: DetectParameters
    ) -> StaticBackground:
        share = _MEAN_VARIANCE / len(pictures)
        smooth = smooth_part(mean)
        sigma = float(np.hypot(np.sqrt(model.floor_dn2), model.texture * model.black_dn))
        # In 16 bits there is no room for what is higher: a light, or a hot pixel.
        structure = mean - smooth if pictures[0].dtype == np.uint8 else np.minimum(mean - smooth, _HIGHEST * sigma)
        plain, most = smooth + structure, float(np.iinfo(np.uint16).max)
        level, steps = float(np.ceil(plain.max())), _STEPS
        while steps > 1 and (max(int(p.max()) for p in pictures) + level) * steps > most:
            steps //= 2
        level = min(level, 0.5 * most / steps)
        floor, slope = model.floor_dn2 * steps**2, model.slope_dn * steps
        once = replace(
            model, floor_dn2=floor, slope_dn=slope, black_dn=model.black_dn * steps,
            banding_dn=model.banding_dn * steps, compression_dn2=model.compression_dn2 * steps**2,
        )  # fmt: skip
        clips = saturation_of(parameters, pictures[0])
        at_rest = find_spots(in_steps(mean, steps), replace(parameters, saturation_dn=(clips - 0.5) * steps), once)
        at_rest = replace(at_rest, flux=at_rest.flux / steps, peak=at_rest.peak / steps)
        # The difference has one level everywhere, and the noise of the picture.
        low = float(np.quantile(plain[::8, ::8], _LOW))
        brighter = model.slope_dn * np.maximum(highest_of_blocks(plain) - max(low, model.black_dn), 0.0)
        uneven = np.asarray(np.sqrt(brighter / 9.0) / (TEXTURE_SHARE * level), np.float32)
        black = level - max(low - model.black_dn, 0.0)
        of_difference = replace(
            model, floor_dn2=floor * (1 + share), slope_dn=slope, black_dn=black * steps, texture=0.0,
            local_texture=uneven, banding_dn=model.banding_dn * steps, compression_dn2=model.compression_dn2 * steps**2,
        )  # fmt: skip
        rows, columns = SAMPLE
        blind = cv2.dilate(mean - np.minimum(plain, level), np.ones((3, 3))) > 1 / steps
        near = places_of(at_rest, mean.shape, AROUND_LIGHT) | blind
        return StaticBackground(
            len(pictures), structure, smooth[::rows, ::columns].copy(), near, blind,
            RestingLights.of(mean, at_rest, model, clips - 0.5), np.zeros((0, 3)), parameters, steps, level, low,
            in_steps(np.asarray(level - plain, np.float32), steps), of_difference, model,
            ShownLight.of(structure, smooth[::rows, ::columns].copy(), near, model, share, len(pictures), ()),
        )  # fmt: skip

    def found_in(self, picture: Picture, parameters: DetectParameters, shift: TextureShift) -> Detections | None:
        """The points of a picture, brightest first, with the errors by texture: what moves, and the lights at rest.

        What moves is searched in the difference from the background; the lights at rest are measured by one step, and
        searched where they have changed. None: the picture and the background do not fit.
        """
        parts = self._parts(picture, parameters, shift)
        return None if parts is None else parts[0].joined(parts[1], parameters.max_detections)

    def _parts(
        self, picture: Picture, parameters: DetectParameters, shift: TextureShift
    ) -> tuple[Detections, Detections] | None:
        """The points of a picture that move or have changed, and the lights at rest that have not."""
        fit = self.shown.in_picture(picture)
        if fit is None:
            return None
        spots = self._moving(picture, parameters, shift, fit)
        lights, changed = self.lights.in_picture(picture)
        boxes = np.column_stack([self.lights.found.uv_px, self.lights.half_px])[changed]
        boxes = np.concatenate([self.unknown, boxes])
        rest = lights[~changed & ~inside(boxes, lights)]
        # The error of the mean picture's fit is the same in all pictures.
        fixed = 0.5 * self._noise_share * np.trace(rest.cov_px2, axis1=1, axis2=2)
        rest = shift.added_to(rest, self.noise)
        place = np.zeros(len(rest)) if rest.place_px2 is None else rest.place_px2
        rest = replace(rest, cov_px2=(1 + self._noise_share) * rest.cov_px2, place_px2=place + fixed)
        found = spots[~inside(boxes, spots)]
        if len(boxes):
            again = shift.added_to(find_spots(picture, parameters, self.noise, boxes), self.noise)
            found = found.joined(again, parameters.max_detections)
        return found, rest

    def spots_in(
        self, picture: Picture, parameters: DetectParameters, shift: TextureShift, inverted: bool = False
    ) -> Detections:
        """The spots in the difference of a picture (h, w) from the background, where that shows them.

        shift: errors of spots by the texture; the part that the background causes is subtracted with it. inverted: the
        holes of the difference instead.
        """
        fit = self.shown.in_picture(picture)
        return Detections.none() if fit is None else self._moving(picture, parameters, shift, fit, inverted)

    def _moving(
        self, picture: Picture, parameters: DetectParameters, shift: TextureShift, fit: tuple[float, Bools],
        inverted: bool = False,
    ) -> Detections:  # fmt: skip
        """`spots_in`, with the result of `ShownLight.in_picture`."""
        light, fits = fit
        model, more = self.model, 0.0
        if abs(light - 1) > SAME_LIGHT:
            own, more = self._noise_share, (1 - light) * self.steps
            model = replace(model, floor_dn2=model.floor_dn2 * (1 + light**2 * own) / (1 + own))
        clips = saturation_of(parameters, picture)
        top = min(int((clips + self.level_dn) * self.steps), np.iinfo(np.uint16).max)
        clipped = np.inf if inverted else clips
        difference = raised_difference(picture, self.steps, self.subtracted, self.structure, more, clipped, top)
        if inverted:
            difference = np.asarray(
                cv2.subtract(np.full_like(difference, 2 * int(self.level_dn * self.steps)), difference)
            )
        spots = find_spots(difference, replace(parameters, saturation_dn=float(top)), model)
        row, column = (nearest(spots.uv_px[:, i], picture.shape[1 - i]) for i in (1, 0))
        sampled = np.minimum(row // SAMPLE[0], len(fits) - 1), np.minimum(column // SAMPLE[1], fits.shape[1] - 1)
        kept = ~self.blind[row, column] & fits[sampled]
        spots, row, column, sampled = spots[kept], row[kept], column[kept], (sampled[0][kept], sampled[1][kept])
        if not len(spots):
            return spots
        spots = replace(spots, flux=spots.flux / self.steps, peak=spots.peak / self.steps)
        bright = self.smooth[sampled] + self.structure[row, column]
        light_of_spot = 0.5 * self.noise.slope_dn * spots.peak
        here, used = (self.noise.variance(at) + light_of_spot for at in (bright, np.full(len(spots), self.low_dn)))
        spots = replace(spots, cov_px2=spots.cov_px2 * (here / used)[:, None, None])
        # The background's own noise is the same in all pictures.
        fixed = self._noise_share / (1 + self._noise_share) * 0.5 * np.trace(spots.cov_px2, axis1=1, axis2=2)
        of_light = replace(shift, background_px=(0.0,) * len(shift.background_px))
        spots = of_light.added_to(spots, self.noise)
        place = np.zeros(len(spots)) if spots.place_px2 is None else spots.place_px2
        return replace(spots, place_px2=place + fixed)
