"""A static background estimated from pictures spread over a recording: without what moves, or moves slowly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools, evenly_spread
from tracking.background.behind_lights import LARGEST_PATH_PX, BehindLights, Exposures, passing_lights
from tracking.background.mean_pictures import MOST_BYTES, means_of, smooth_part, usable
from tracking.background.places import AROUND_LIGHT, AROUND_SPOT, ON_LIGHT, SAME_LIGHT, near_each, places_of
from tracking.background.shown_light import LARGEST_MISFIT, Shown
from tracking.background.slow_lights import ROUNDS, SlowLights, as_pictures_show, light_at
from tracking.background.static_background import TRIED, StaticBackground
from tracking.detection.detect import find_spots
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture
from tracking.noise_estimation.speckle import grainy
from tracking.noise_estimation.texture_shift import TextureShift, local_shifts, shifts_at_rest
from tracking.parameters import DetectParameters

PICTURES = 15  # from which a background is made, spread over the recording
_LEAST_PICTURES = 9  # usable ones
_MANY_LIGHTS = 4  # at rest, from which the subtraction is used in any case: it spares their fits
_LEAST_FOUND = 0.2  # further or better spots per picture from which the subtraction is used
_ALWAYS = 0.9  # share of the pictures in which another light passes over one at rest, above which that is part of it
_WIDER = 2.0  # widths of the lights that move, at most, of what the places of one of them have in common
_ODD = 0.2  # share of the peak that the fit of an object leaves; lights on strong edges leave up to 0.15
MOSTLY = 0.7  # share of the pictures with lights that move, above which those at rest in all of them are no spots
# Contrast up to which the structure is that of the screen's surface, and modulates the spots' light in full. Of what is
# more, prints or objects, the spots show a part: 0.25 to 0.57 where photographs modulate their light by up to 60 %.
_OF_SURFACE, _OF_OBJECTS = 0.1, 0.4
_AS_BRIGHT = 0.8  # share of the flux of a spot that a picture shows of it: less is a part, or an edge in its light
_CLEARLY_BETTER = 0.5  # ratio of the variances of two measurements of a spot
_SETTLED = 0.01  # sigmas of a pixel: the background behind a light that changes by less is the last one
# Of the modulation, what is not undone: by edges, since the surface is seen blurred and in other light, at least; by
# texture as fine as the spots, since the background also shows the offsets of the pixels.
_LEAST_LEFT, _OF_TEXTURE = 0.05, 0.2
# Error of a light by the misfit of its fit, in widths: of spots at most .01, of objects .1 to .5.
_LARGEST_MISFIT = 0.05
_NO_GAUSSIAN = 0.02  # share of a light at rest that a Gaussian leaves in a pixel; it is no structure of the background


def static_background(
    pictures: Sequence[Picture], model: NoiseModel, shift: TextureShift, parameters: DetectParameters,
    others_move: bool = False, in_any_case: bool = False,
) -> StaticBackground | None:  # fmt: skip
    """The background of pictures spread over a recording.

    None: too few, or of different sizes or types, or, unless it is wanted in any case, with few lights at rest, while
    the differences from it show the spots in them no better. model: of the camera's noise and texture; shift: errors of
    its spots by the texture; parameters: with the grey value at which the sensor clips; others_move: lights that the
    parameters exclude.
    """
    every = usable(pictures)
    if len(every) < _LEAST_PICTURES:
        return None
    light = EqualLight.of(every, model, parameters)
    if len(light.pictures) < len(every):
        passed = EqualLight.of(every, model, parameters, passed=True)
        light = max(light, passed, key=lambda x: len(x.pictures))
    background, some = light.background, light.pictures
    if len(some) < _LEAST_PICTURES:
        return None
    few = len(background.lights.found) < _MANY_LIGHTS and not in_any_case
    if few and any(len(background.spots_in(p, parameters, shift)) for p in some[::TRIED]):
        # A few pictures decide, unless one of them shows a better spot; then the others count as well.
        asked = better = 0
        for part in (some[::TRIED], [p for i, p in enumerate(some) if i % TRIED]):
            asked, better = asked + len(part), better + sum(_better_in(background, p, shift) for p in part)
            enough = better >= max(_LEAST_FOUND * asked, 2)
            if enough or not better:
                break
        if not enough:
            return None
    return _without_slow_lights(light, shift, others_move)


@dataclass(frozen=True, slots=True)
class EqualLight:
    """Pictures (h, w) that fit a background, and they in its light."""

    background: StaticBackground  # from the lower half of their grey values
    mean: NDArray[np.float32]  # (h, w), DN, of the middle half
    pictures: Sequence[Picture]
    equal: Sequence[NDArray[Any]]
    strength: Array  # (n, h): of the moving lights in each row of the pictures in equal light

    @staticmethod
    def of(
        pictures: Sequence[Picture], model: NoiseModel, parameters: DetectParameters, passed: bool = False
    ) -> EqualLight:
        """passed: as in `means_of`. Where the light differs, the first mean is no picture in any light."""
        equal: Sequence[NDArray[Any]] = pictures
        for largest in (np.inf, LARGEST_MISFIT, 0.0):
            lower, mean = means_of(equal, passed)
            background = StaticBackground.of_mean(lower, pictures, model, parameters).with_light(equal)
            if not largest:
                break
            shown = [(p, fit) for p in pictures if (fit := background.shown.in_picture(p, largest)) is not None]
            fitting = [(p, fit) for p, fit in shown if fit.misfit <= LARGEST_MISFIT]
            usual = len(fitting) >= _LEAST_PICTURES and all(fit.is_usual for _, fit in fitting)
            most = MOST_BYTES // (4 * lower.size)
            shown = fitting if usual else [shown[i] for i in evenly_spread(np.arange(len(shown)), most)]
            pictures = equal = [p for p, _ in shown]
            strength = np.array([1 / fit.of_rows(len(lower))[0] for _, fit in shown])
            if usual or len(pictures) < _LEAST_PICTURES:
                break
            equal = [_in_light(p, fit, lower - background.structure) for p, fit in shown]
        return EqualLight(background, mean, pictures, equal, strength)


def _in_light(picture: Picture, fit: Shown, smooth: NDArray[np.float32]) -> NDArray[np.float32]:
    """The picture (h, w) in the light of the background, DN, of which it shows `fit`; smooth: the smooth part."""
    if fit.rows is None:
        return smooth + (picture - smooth_part(picture.astype(np.float32))) / fit.light
    light, level = np.asarray(fit.rows[..., None], np.float32)
    return smooth + (picture - smooth - level) / light


def _without_slow_lights(light: EqualLight, shift: TextureShift, others_move: bool) -> StaticBackground:
    """The background from the mean of these pictures, given the one from the lower half.

    A light that moves slowly, or rests for a part of the recording, is in the mean of the pictures. Where it is in
    some of them the others count; where its absence leaves a hole, those with the hole.
    """
    background, mean, pictures, equal = light.background, light.mean, light.pictures, light.equal
    fits = [background.shown.in_picture(p) for p in pictures]
    found = [_searched(background, p, shift, fit) for p, fit in zip(pictures, fits, strict=True)]
    holes = [
        background.spots_in(p, background.parameters, shift, inverted=True, fit=fit)
        for p, fit in zip(pictures, fits, strict=True)
    ]
    found, holes = _without_objects(found, holes, float(background.noise.variance(background.usual_dn())))
    slow = SlowLights.of(equal, found, holes)
    mean[slow.row, slow.column] = slow.means()
    better = background.with_mean(slow.row, slow.column, mean[slow.row, slow.column])
    moved, boxes = slow.moved, slow.boxes(slow.everywhere)
    paths = boxes[boxes[:, 2] < LARGEST_PATH_PX]
    here = [_spots_at(better, p, paths, shift, fit) for p, fit in zip(pictures, fits, strict=True)]
    known = slow[slow.known]
    count = np.full(mean.shape, len(pictures))
    count[slow.row, slow.column] = slow.count * slow.known
    usual_dn = better.usual_dn()
    light_dn = usual_dn / shift.over_light
    # In black places the model leaves more than their noise: also there that of the background counts.
    noise = replace(background.noise, shadow_dn2=0.0)
    seen = Exposures(equal, light.strength, noise, light_dn, usual_dn - light_dn)
    behind = BehindLights.of(seen, here, boxes, passing_lights(seen, found, mean, count))
    mean[behind.row, behind.column] = behind.level_dn
    slow = slow[~slow.known & ~behind.covers(mean.shape)[slow.row, slow.column]]
    if len(slow.row):
        hidden = better.with_mean(behind.row, behind.column, behind.level_dn)
        better = _behind(hidden, slow, mean, pictures, fits, shift)
    else:
        better = StaticBackground.of_mean(mean, pictures, background.noise, background.parameters)
    better.shares[known.row, known.column] = 1 / known.count
    better.shares[behind.row, behind.column] = behind.share
    better = better.with_light(equal)
    if behind.modulation is not None:
        better = better.with_modulation(behind.modulation, (behind.row, behind.column), behind.response)
    return _with_shifts(better, mean, pictures, moved, others_move, shift, behind)


def _without_objects(
    found: list[Detections], holes: list[Detections], variance: float
) -> tuple[list[Detections], list[Detections]]:
    """Points without those that are wider than the lights and no Gaussians: parts of somebody who walks past.

    variance: of a pixel, DN^2.
    """

    def odd(points: Detections) -> Bools:
        left2 = np.zeros(len(points)) if points.chi2 is None else points.chi2 * variance
        return np.asarray(left2 > (_ODD * points.peak) ** 2)

    widths = np.concatenate([d.major_px[~odd(d)] for d in found])
    widest = _WIDER * float(np.median(widths)) if len(widths) else 0.0
    both = [[d[np.asarray(~odd(d) | (d.major_px < widest))] for d in points] for points in (found, holes)]
    return both[0], both[1]


def _with_shifts(
    background: StaticBackground, mean: NDArray[np.float32], pictures: Sequence[Picture], moved: bool,
    others_move: bool, shift: TextureShift, behind: BehindLights,
) -> StaticBackground:  # fmt: skip
    """The background with the errors of lights by its texture, and with those of its lights that stay at rest.

    mean (h, w), DN: it is made from; behind: of it, what is known from fits of lights.
    """
    modulation = behind.modulation
    found = [background.spots_in(p, background.parameters, shift) for p in pictures[::TRIED]]
    # Of a light at rest that trembles something is left in the difference: that stays in its place.
    alone = [d[np.asarray(~near_each(d, background.lights.found, ON_LIGHT).any(axis=1))] for d in found]
    gone = [bool((~near_each(d, later, SAME_LIGHT).any(axis=1)).any()) for d, later in pairwise(alone)]
    moved = others_move or (moved and float(np.mean(gone)) > MOSTLY)
    if not moved:
        background = background.with_lights_on_edges(mean, modulation)
    still = background.lights.found
    still_px = np.sqrt(still.major_px * still.minor_px)
    widths = np.concatenate([np.sqrt(d.major_px * d.minor_px) for d in found])
    width = float(np.median(widths if len(widths) else still_px)) if len(widths) + len(still) else 0.0  # spots may rest
    shown, changes, passes = zip(*(background.lights.in_picture(p) for p in pictures), strict=True)
    changed, passed = np.array(changes), np.array(passes)
    moving = background.lights.which_move(np.array([d.uv_px for d in shown]), ~changed & ~passed)
    # What is alone and unchanged in hardly any picture is what the places of a light have in common that moves
    # by less than its width: that place is searched in the pictures. A wider one is an object, a square of a board, and
    # so is what a light leaves that has been fitted.
    always = ((passed | changed).mean(axis=0) > _ALWAYS) & (still_px < _WIDER * width) & ~behind.leave(still)
    common = np.column_stack([still.uv_px, background.lights.half_px])[always]
    unknown = np.concatenate([background.unknown, common])
    lights, fixed = replace(background.lights, moving=moving), ~changed.any(axis=0) & ~moving & moved
    better = replace(background, unknown=unknown, lights=lights, fixed=np.asarray(fixed))
    if not width:
        return better
    mean = background.plain()
    own = (background.shares * background.noise.variance(mean)).astype(np.float32)
    share = replace(shift, misfit_share=float("nan")).with_lights(found).misfit_share
    # What no Gaussian explains, a board or a lamp, is a part of the surface for the lights that move over it.
    off = np.zeros(len(still)) if still.misfit is None else np.sqrt(still.misfit * still.variance_px2)
    gaussian = off < _LARGEST_MISFIT * np.sqrt(still.major_px * still.minor_px)
    _subtract(still[gaussian], mean, own)
    undone, even = background.gain is not None, background.noise.texture < _OF_SURFACE
    if modulation is None or even:
        part = shift.over_light * (_OF_TEXTURE if undone else 1.0 if even else _OF_OBJECTS)
        shifts_px = np.float32(part) * local_shifts(mean, own, width)
    else:
        part = np.hypot(modulation.unlike, (_LEAST_LEFT if undone else 1.0) * modulation.share)
        shifts_px = np.float32(part) * local_shifts(*modulation.sensitivity(mean, own), width)
    _subtract(still[~gaussian], mean, own)
    rest_shifts_px = shift.over_light * shifts_at_rest(mean, own, still)
    return replace(
        better, spot_px=width, shifts_px=shifts_px, rest_shifts_px=rest_shifts_px, misfit_share=share,
        grainy=grainy(pictures[::TRIED], alone, background.noise),
    )  # fmt: skip


def _subtract(lights: Detections, mean: NDArray[np.float32], own: NDArray[np.float32]) -> None:
    """Subtract lights from a mean (h, w) in place, DN, and add what no Gaussian explains to its variance, DN^2."""
    at = row, column = np.nonzero(places_of(lights, mean.shape, AROUND_LIGHT))
    light = light_at(lights, column, row)
    mean[at] -= light
    own[at] += (_NO_GAUSSIAN * light) ** 2


def _behind(
    background: StaticBackground, slow: SlowLights, mean: NDArray[np.float32], pictures: Sequence[Picture],
    fits: Sequence[Shown | None], shift: TextureShift,
) -> StaticBackground:  # fmt: skip
    """The background from a mean (h, w), improved behind lights that are nearly everywhere in all pictures.

    background: the one so far; fits: what it shows of itself in the pictures.
    """
    better, boxes = background, slow.boxes(slow.everywhere)
    at = (slow.row, slow.column)
    behind: Array = mean[at].astype(float)
    information = np.zeros(len(behind))
    for k in range(ROUNDS):
        if k == 0:
            found = [_spots_at(better, p, boxes, shift, fit) for p, fit in zip(pictures, fits, strict=True)]
        else:
            found = [
                better.spots_in(p, background.parameters, shift, regions=boxes, fit=fit)
                for p, fit in zip(pictures, fits, strict=True)
            ]
        before, variance = behind, background.noise.variance(behind)
        behind, information = slow.behind(found, before, variance)
        better = better.with_mean(*at, behind)
        if float(np.max(np.abs(behind - before) / np.sqrt(variance), initial=0.0)) < _SETTLED:
            break
    mean[at] = behind
    better = StaticBackground.of_mean(mean, pictures, background.noise, background.parameters)
    better.shares[at] = 1 / np.maximum(information, 1e-3)
    hidden = ~slow.is_sure(information)
    better.near_lights[at] |= hidden
    better.blind[at] |= hidden
    return replace(better, unknown=slow.boxes(hidden))


def _spots_at(
    background: StaticBackground, picture: Picture, boxes: Array, shift: TextureShift, fit: Shown | None
) -> Detections:
    """The spots of a picture in boxes (k, 3), whether the background contains some of their light or not."""
    found = background.spots_in(picture, background.parameters, shift, regions=boxes, fit=fit)
    return as_pictures_show(found, find_spots(picture, background.parameters, background.noise, boxes))


def _better_in(background: StaticBackground, picture: Picture, shift: TextureShift) -> int:
    """How many spots the difference of a picture shows that the picture does not, or clearly more precisely."""
    found = shift.added_to(find_spots(picture, background.parameters, background.noise), background.noise)
    spots = background.spots_in(picture, background.parameters, shift)
    same = near_each(spots, found, AROUND_SPOT) & (found.flux > _AS_BRIGHT * spots.flux[:, None])
    better = spots.variance_px2[:, None] < _CLEARLY_BETTER * found.variance_px2
    return int(np.count_nonzero(~np.any(same & ~better, axis=1)))


def _searched(background: StaticBackground, picture: Picture, shift: TextureShift, fit: Shown | None) -> Detections:
    """The points of a picture that move or have changed; all points of one that does not fit."""
    parts = background.parts(picture, background.parameters, shift, fit)
    if parts is not None:
        return parts[0]
    return shift.added_to(find_spots(picture, background.parameters, background.noise), background.noise)
