"""Speckle that breaks the spots of a camera into grains: in sums of pixels it does not.

Laser light on a matt screen has speckle whose contrast is up to 1, with grains as wide as the spot of the lens's
aperture. Where a grain is no narrower than a pixel and a spot has many of them, each looks like a spot of its own. Sums
of pixels average over the grains; a spot that is still wider than a sum loses nothing. Source: ours; the contrast in
sums is that of Goodman (2007), "Speckle Phenomena in Optics", section 4.6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from geometry.arrays import Array, Bools, Ints
from tracking.detection.detect import find_spots
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture
from tracking.noise_estimation.texture import is_limited_by_texture
from tracking.parameters import DetectParameters
from tracking.squares import for_squares, noise_of_squares, of_squares, squares_of

SIDE = 2  # px: of the squares; where that is not enough, sums of sums
_WIDTH = 2.4  # px: of a spot, at least: in sums its place within a square hardly matters then
_CLEAR = 20.0  # peak of the lights that count, in sigmas of the noise of the background
_MOVING = 0.25  # share of the lights that move, at least: grains of some that rest are seen in some pictures only
_AT_REST = 0.5  # widths: what moves by less between any two pictures is at rest
# rms of what a Gaussian leaves, over its height, without noise: of plain, wide, flat and long spots up to 0.06 in the
# median, of developed speckle 0.08 to 0.14 (pixels as wide as 1 to 5 grains); of objects mostly more.
_GRAINY, _OBJECT, _EVEN = 0.075, 0.25, 0.03
_ROUGH = 0.008  # variance over the square of the mean: 0.03 to 0.2 of speckle, 0.001 of other spots
_FEWEST_LIGHTS = 4  # whose median counts
_INSIDE = 2.0  # widths of a light in sums: points that are nearer to its centre are parts of it ...
_SHARE = 0.05  # ... with at least this share of its flux
_NARROWER = 0.8  # times the smaller half axis of a light: a narrower part of it is no beam beside another
_OFTEN, _FEWEST = 0.08, 2  # share and number of the lights that consist of several points ...
_MOSTLY = 0.5  # ... in front of objects, where there is one in each picture


def shows_grains(pictures: Sequence[Picture], found: Sequence[Detections], model: NoiseModel, clips_dn: float) -> bool:
    """Whether spots of these pictures (h, w) of a camera are grainy, or several of the points found in each of them.

    Then they are measured better in sums of SIDE x SIDE pixels. Objects are grainy, too: in front of them most lights
    must be, or those that move in front of a background. clips_dn: grey value at which the sensor clips.
    """
    objects = is_limited_by_texture(model)
    counted = _counted(found, model, objects)
    if not objects and grainy(pictures, counted, model):
        return True
    left_over = np.concatenate([_left_over(points, model) for points in counted])
    if not len(left_over) or np.median(left_over) < _EVEN:
        return False
    usual = replace(DetectParameters(), saturation_dn=clips_dn)
    lights = _counted([_in_sums(picture, usual, model) for picture in pictures], model, objects)
    several = np.concatenate([_parts(some, points) for some, points in zip(lights, found, strict=True)]) > 1
    often, fewest = (_MOSTLY, len(pictures)) if objects else (_OFTEN, _FEWEST)
    return bool(np.count_nonzero(several) >= fewest and several.mean() > often)


def grainy(pictures: Sequence[Picture], found: Sequence[Detections], model: NoiseModel) -> bool:
    """Whether lights that move are wide enough to be measured in sums of pixels, and most of them are grainy.

    found: in each of the pictures (h, w). Flat beams are no Gaussians either, but from pixel to pixel they are even.
    """
    clear = [_clear(points, model) for points in found]
    wide = [points[_width(points) > _WIDTH] for points in clear]
    left_over = np.concatenate([_left_over(points, model) for points in wide])
    if len(left_over) < _FEWEST_LIGHTS or np.median(left_over) <= _GRAINY:
        return False
    rough = [_roughness(*lights, model) for lights in zip(pictures, wide, strict=True)]
    return bool(np.median(np.concatenate(rough)) > _ROUGH)


def _in_sums(picture: Picture, parameters: DetectParameters, model: NoiseModel) -> Detections:
    """The lights of a picture that are wide enough to be measured in sums of its pixels."""
    of_sums = for_squares(parameters, picture, SIDE), noise_of_squares(model, picture, SIDE)
    found = of_squares(find_spots(squares_of(picture, SIDE), *of_sums), picture, SIDE)
    return found[_width(found) > _WIDTH]


def _width(points: Detections) -> Array:
    return np.asarray(np.sqrt(points.major_px * points.minor_px))


def _left_over(points: Detections, model: NoiseModel) -> Array:
    """(n,): rms of what a Gaussian leaves of each light over its height, without what the noise leaves."""
    assert points.unexplained is not None
    noise = (model.floor_dn2 + 0.5 * model.slope_dn * points.peak) / points.peak**2
    return np.sqrt(np.maximum(points.unexplained**2 - noise, 0.0))


def _roughness(picture: Picture, points: Detections, model: NoiseModel) -> Array:
    """(n,): variance of the pixels in the core of each light, over its mean squared, without noise and slopes."""
    out = np.zeros(len(points))
    for k, (at, width) in enumerate(zip(points.uv_px, _width(points), strict=True)):
        first = np.maximum(np.rint(at - width), 0).astype(int)
        u, v = first + 2 * int(width) + 1
        core = picture[first[1] : v, first[0] : u].astype(float)
        left = np.diff(np.diff(core, axis=0), axis=1)  # of four pixels what no plane explains: twice their sigma
        if left.size:  # at the border there may be no core
            light = max(float(core.mean()) - model.black_dn, 1.0)
            out[k] = (0.25 * np.mean(left**2) - float(model.variance(core.mean()))) / light**2
    return out


def _clear(points: Detections, model: NoiseModel) -> Detections:
    """The points that are clear, and no objects."""
    clear_dn = _CLEAR * float(np.sqrt(model.variance(model.black_dn)))
    return points[(points.peak > clear_dn) & (_left_over(points, model) < _OBJECT)]


def _counted(found: Sequence[Detections], model: NoiseModel, objects: bool) -> list[Detections]:
    """The clear points of each picture that move; where hardly any does, and there are no objects, all."""
    clear = [_clear(points, model) for points in found]
    moving = [points[_moves(points, found[:k], found[k + 1 :])] for k, points in enumerate(clear)]
    return moving if objects or sum(map(len, moving)) > _MOVING * sum(map(len, clear)) else clear


def _parts(lights: Detections, points: Detections) -> Ints:
    """(n,): number of the points that are parts of each light; 1 for beams beside each other, none of them narrow."""
    apart = np.linalg.norm(lights.uv_px[:, None] - points.uv_px[None], axis=2)
    inside = (apart < _INSIDE * _width(lights)[:, None]) & (points.flux[None] > _SHARE * lights.flux[:, None])
    narrow = inside & (_width(points)[None] < _NARROWER * lights.minor_px[:, None])
    return np.asarray(np.where(narrow.any(axis=1), np.count_nonzero(inside, axis=1), inside.any(axis=1)))


def _moves(lights: Detections, *others: Sequence[Detections]) -> Bools:
    """(n,): whether a light is elsewhere in most of the other pictures."""
    reach, elsewhere = _AT_REST * _width(lights)[:, None], np.zeros(len(lights))
    for other in chain(*others):
        apart = np.linalg.norm(lights.uv_px[:, None] - other.uv_px[None], axis=2)
        elsewhere += ~(apart < reach).any(axis=1)
    return np.asarray(elsewhere > 0.5 * sum(map(len, others)))
