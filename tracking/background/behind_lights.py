"""The background behind lights that move by a few of their widths at most, from joint fits of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median_low
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools, Ints
from tracking.background.joint_fit import MODULATED, UNLIKE, JointFit, Modulation, fitted, mean_of, share_at
from tracking.background.places import AROUND_LIGHT, AROUND_SPOT, ON_LIGHT, inside, near_each, nearest
from tracking.detections import Detections
from tracking.noise import NoiseModel

LARGEST_PATH_PX = 250.0  # half side of the box around the places of such a light
_LARGEST_PATH = 12.0  # half side, in widths of the light
_LEAST_PICTURES, _LEAST_SHARE = 6, 2 / 3  # pictures in which the light is found; share of those with it
_AROUND = 1.5  # widths beyond the box that are fitted
_LEAST_CLEAR = 0.5  # share of these pixels that other lights do not reach
_SAMPLES, _MOST_SAMPLES = 3.0, 2500  # pixels that are fitted: per width of the light, and in all
_USUAL_FITS = 2.0  # as many fits as the usual scatter counts
_LARGEST_SIGMA = 0.1  # of the modulated share
_SHARES = np.linspace(0.0, 1.0, 101)  # modulated ones that are compared
_LACKS = 0.5  # of the height, by which a picture without the light is darker
_MOST_PASSING = 10  # lights on uneven ground that are fitted: those that show the modulation best
_ALSO_BRIGHT, _SELDOM = 0.3, 0.2  # of the brightest's flux: a second light in the box; share of the pictures with it
_OFTEN = 0.1  # share of the pictures in which a light has left a place that it passes
_LIT = 1e-3  # of the peak: there the background comes from the fit


@dataclass(frozen=True, slots=True)
class Exposures:
    """n pictures (h, w) of one camera in equal light of the room."""

    pictures: Sequence[NDArray[Any]]
    strength: Array  # (n, h), of the lights in each row
    noise: NoiseModel
    usual_dn: float  # light of the surface, above black
    black_dn: float  # grey value without light

    def strength_at(self, which: Sequence[int] | Ints, places: Array) -> Array:
        """(k, 1): of a light that is at these places (k, 2) in some pictures."""
        return self.strength[which, nearest(places[:, 1], self.strength.shape[1])][:, None]

    def around(self, which: Sequence[int] | Ints, box: Array, more: float, step: int) -> tuple[Array, Array, Array]:
        """Light above black, DN, and its variances (k, m) in some pictures, in pixels (m, 2) around a box.

        `more`: px to each side; every `step`-th pixel.
        """
        (height, width), half = self.pictures[0].shape, box[2] + more
        rows = np.arange(max(int(box[1] - half), 0), min(int(box[1] + half) + 1, height), step)
        columns = np.arange(max(int(box[0] - half), 0), min(int(box[0] + half) + 1, width), step)
        v, u = (x.ravel() for x in np.meshgrid(rows, columns, indexing="ij"))
        values = np.array([self.pictures[k][v, u] for k in which], dtype=float).reshape(-1, len(u))
        return values - self.black_dn, self.noise.variance(values), np.column_stack([u, v]).astype(float)


@dataclass(frozen=True, slots=True)
class BehindLights:
    """The m pixels of a picture (h, w) behind such lights."""

    row: Ints  # (m,)
    column: Ints  # (m,)
    level_dn: Array  # (m,): the background
    share: Array  # (m,): variance of its errors over that of a picture's noise
    response: Array  # (m,): the light over that on usual ground, as the fits of the lights show it
    lights: Sequence[tuple[Array, JointFit]]  # the box (3,) around each such light, and its fit
    modulation: Modulation | None  # of the lights by the surface; None: they do not show it

    @staticmethod
    def of(
        seen: Exposures, found: Sequence[Detections], boxes: Array, passing: Sequence[JointFit] = ()
    ) -> BehindLights:
        """From the points found in each picture inside boxes (k, 3): u, v and half side, px.

        The modulation that most lights of a camera show, and those that pass (`passing_lights`), helps with the others.
        """
        lights = [light for box in boxes for light in _lights_of(seen, found, box)]
        parts = _behind_each(lights, _modulation(passing, seen))
        modulation = _modulation([*(part.fit for part in parts), *passing], seen)
        if modulation is not None:
            parts = _behind_each(lights, modulation)
        if not parts:
            nowhere, none = np.zeros(0, np.int64), np.zeros(0)
            return BehindLights(nowhere, nowhere, none, none, none, [], modulation)
        columns = zip(*(part[:-2] for part in parts), strict=True)
        row, column, level, share, response = (np.concatenate(values) for values in columns)
        return BehindLights(row, column, level, share, response, [part[-2:] for part in parts], modulation)

    def leave(self, points: Detections) -> Bools:
        """Which points (n,) near such a light it leaves in some pictures: they are no part of it."""
        out = np.zeros(len(points), dtype=bool)
        for box, fit in self.lights:
            gap = np.linalg.norm(fit.light.places[:, None] - points.uv_px, axis=-1)
            away = gap > ON_LIGHT[0] * float(fit.light.widths_px[0]) + ON_LIGHT[1]
            out |= inside(box[None], points) & (away.mean(axis=0) > _OFTEN)
        return out

    def covers(self, shape: tuple[int, ...]) -> Bools:
        """(h, w): its pixels."""
        out = np.zeros(shape, dtype=bool)
        out[self.row, self.column] = True
        return out


def passing_lights(
    seen: Exposures, found: Sequence[Detections], background: NDArray[np.float32], count: Ints
) -> list[JointFit]:
    """Fits of single lights on uneven ground that other pictures show without them, where they show the modulation.

    found: the lights of each picture; background (h, w), DN, the mean of `count` (h, w) pictures without a light.
    """
    ground = background - np.float32(seen.black_dn)
    every = [(_shown_by(ground, count, d[i : i + 1], seen), k, i) for k, d in enumerate(found) for i in range(len(d))]
    fits: list[JointFit] = []
    used = Detections.none()  # lights on the same ground have the same errors of it
    for _, k, i in sorted((x for x in every if x[0] > 1 / UNLIKE), reverse=True):
        light = found[k][i : i + 1]
        if len(used) == _MOST_PASSING:
            break
        others = np.arange(len(found[k])) != i
        if near_each(light, used, ON_LIGHT).any() or near_each(light, found[k][others], AROUND_LIGHT).any():
            continue
        used = used.joined(light, _MOST_PASSING)
        width = float(np.sqrt(light.major_px[0] * light.minor_px[0]))
        box = np.array([*light.uv_px[0], width])
        values, variance, uv = seen.around([k], box, _AROUND * width, _step(width))
        column, row = uv.T.astype(np.int64)
        empty = ground[row, column].astype(float), count[row, column] / variance[0]
        height, strength = float(light.peak[0]), seen.strength_at([k], light.uv_px)
        fit = fitted(uv, values, variance, light.uv_px, width, height, empty, strength=strength)
        if fit is not None:
            fits.append(fit)
    return fits


def _step(width_px: float) -> int:
    """Every such pixel of a light of this width is fitted."""
    return max(int(width_px / _SAMPLES), 1)


def _shown_by(background: NDArray[np.float32], count: Ints, light: Detections, seen: Exposures) -> float:
    """1 / sigma of the share that usual ground modulates, as a light on ground (h, w), DN above black, shows it."""
    reach = max(float(light.major_px[0]), 1.0)
    (left, top), (right, low) = (light.uv_px[0] + more for more in (-reach, reach))
    box = np.s_[max(int(top), 0) : max(int(low) + 2, 0), max(int(left), 0) : max(int(right) + 2, 0)]
    part = background[box]
    if not part.size or not count[box].any():
        return 0.0
    level = max(float(np.mean(part)), 1.0)
    unlit, lit = seen.noise.variance(level + seen.black_dn + np.array([0.0, light.peak[0]]))
    own = float(unlit) / float(np.mean(count[box]))
    clear = float(light.peak[0]) * np.sqrt(part.size / float(lit))
    slope = float(share_at(np.array(MODULATED[0]), np.array(level / seen.usual_dn))[1])
    return float(np.sqrt(max(float(np.var(part)) - 2 * own, 0.0))) / level * clear * slope


def _modulation(fits: Sequence[JointFit], seen: Exposures) -> Modulation | None:
    """The modulation of all lights of a camera: the most likely one, by errors with outliers, and the scatter.

    That is known beforehand to be usual. Lights on even ground do not show the modulation, on unlit ground hardly.
    """
    share, variance, level = np.array([(*fit.shown, fit.level_dn) for fit in fits]).reshape(-1, 3).T
    ratio = level / seen.usual_dn
    expected, slope = share_at(_SHARES, ratio[:, None])
    spread2 = variance[:, None] + (UNLIKE * slope) ** 2
    off2 = (share[:, None] - expected) ** 2 / spread2
    cost = np.sum(0.5 * np.log(spread2) + 2 * np.log1p(off2 / 3), axis=0)  # Student's, 3 degrees of freedom
    middle = float(_SHARES[np.argmin(cost)])
    likely = np.exp(np.min(cost) - cost)
    expected, slope = share_at(np.array(middle), ratio)
    off, variance = (share - expected) / slope, variance / slope**2  # of shares on usual ground
    weight = 1 / (variance + UNLIKE**2)
    if float(np.sum(weight)) < 1 / (UNLIKE**2 + _LARGEST_SIGMA**2):
        return None
    # Each fit counts by how precisely it shows the scatter.
    clear = (UNLIKE**2 * weight) ** 2
    scatter = _USUAL_FITS * UNLIKE**2 + float(np.sum(clear * np.maximum(off**2 - variance, 0.0)))
    unlike2 = scatter / (_USUAL_FITS + max(float(np.sum(clear)) - 1, 0.0))
    own = float(likely @ (_SHARES - middle) ** 2 / np.sum(likely))
    return Modulation(middle, seen.usual_dn, float(np.sqrt(unlike2 + own)), seen.black_dn)


class _Part(NamedTuple):
    """The pixels (m,) behind one light."""

    row: Ints
    column: Ints
    level_dn: Array
    share: Array
    response: Array
    box: Array  # (3,)
    fit: JointFit


@dataclass(frozen=True, slots=True)
class _Light:
    """A light that moves by a few of its widths, and the pictures that show it."""

    seen: Exposures
    there: Ints  # pictures with the light
    places: Array  # (n, 2) px: in these
    width_px: float
    height_dn: float
    empty: Ints  # pictures without it
    box: Array  # (3,)
    others: Array  # (k, 3): places and sizes of other lights in the pictures with it

    def behind(self, modulation: Modulation | None) -> _Part | None:
        """All pixels that the light reaches; None: no fit."""
        side = 2 * (self.box[2] + _AROUND * self.width_px)
        step = max(_step(self.width_px), int(np.ceil(side / np.sqrt(_MOST_SAMPLES))))
        uv, values, variance, without = self._around(_AROUND * self.width_px, step)
        if len(uv) < _LEAST_CLEAR * (side / step) ** 2:
            return None
        seen, strength = self.seen, self.seen.strength_at(self.there, self.places)
        fit = fitted(uv, values, variance, self.places, self.width_px, self.height_dn, without, modulation, strength)
        if fit is None:
            return None
        uv, values, variance, without = self._around(2 * _AROUND * self.width_px, 1)
        level, information, light = fit.behind(uv, values, variance, without)
        lit = light > _LIT
        column, row = uv[lit].astype(np.int64).T
        share = fit.share + 1 / np.maximum(information[lit], 1e-3)
        own = Modulation(fit.modulated_share(seen.usual_dn)[0], seen.usual_dn)
        return _Part(row, column, level[lit] + seen.black_dn, share, own.response(level[lit]), self.box, fit)

    def _around(self, more: float, step: int) -> tuple[Array, Array, Array, tuple[Array, Array]]:
        """Pixels (m, 2) that no other light reaches, light and variances of the pictures there, mean of those without.

        more, step: as in Exposures.around.
        """
        values, variance, uv = self.seen.around(self.there, self.box, more, step)
        without = self.seen.around(self.empty, self.box, more, step)[0]
        reach = self.box[2] + more + 1 + self.others[:, 2]
        others = self.others[np.abs(self.others[:, :2] - self.box[:2]).max(axis=1) < reach]
        near = np.linalg.norm(others[:, None, :2] - uv, axis=-1) < others[:, None, 2]
        clear = ~near.any(axis=0)
        variance = variance[:, clear]
        return uv[clear], values[:, clear], variance, mean_of(without[:, clear], variance)


def _behind_each(lights: Sequence[_Light], modulation: Modulation | None) -> list[_Part]:
    parts = [light.behind(modulation) for light in lights]
    return [part for part in parts if part is not None]


def _lights_of(seen: Exposures, found: Sequence[Detections], box: Array) -> list[_Light]:
    """The brightest light in a box, or the lights of which most pictures show one each."""
    if box[2] > LARGEST_PATH_PX:
        return []
    rows = [np.flatnonzero(inside(box[None], d)) for d in found]
    bright = [r[found[k].flux[r] > _ALSO_BRIGHT * found[k].flux[r].max()] if len(r) else r for k, r in enumerate(rows)]
    several = [k for k, r in enumerate(bright) if len(r) > 1]
    if len(several) <= _SELDOM * sum(len(r) > 0 for r in rows):
        first = [r[[int(found[k].flux[r].argmax())]] if len(r) else r for k, r in enumerate(rows)]
        every = [first]
    else:
        # Each is nearest to where it was in one of the pictures: they are further apart than they move.
        number = median_low(len(bright[k]) for k in several)
        start = next(k for k in several if len(bright[k]) == number)
        at = found[start].uv_px[bright[start]]
        gap = [np.linalg.norm(found[k].uv_px[r, None] - at, axis=-1) for k, r in enumerate(bright)]
        every = [[r[g.argmin(axis=1) == i] for r, g in zip(bright, gap, strict=True)] for i in range(number)]
        every = [rows for rows in every if all(len(r) < 2 for r in rows)]
    lights = [_light_at(seen, found, rows, box) for rows in every]
    return [light for light in lights if light is not None]


def _light_at(seen: Exposures, found: Sequence[Detections], rows: Sequence[Ints], box: Array) -> _Light | None:
    """A light in a box: one point, or none, of each picture. None: it is in too few pictures, or moves too far."""
    every = range(len(found))
    shown = np.array([k for k in every if len(rows[k])], np.int64)
    if len(shown) < _LEAST_PICTURES:
        return None
    points = [found[k][rows[k]] for k in shown]
    width = float(np.median([np.sqrt(d.major_px[0] * d.minor_px[0]) for d in points]))
    places = np.concatenate([d.uv_px for d in points])
    # The box is that of all that moves here, a shadow beside the light, too.
    least, most = places.min(axis=0), places.max(axis=0)
    own = 0.5 * float(np.max(most - least)) + ON_LIGHT[0] * width + ON_LIGHT[1] + AROUND_SPOT[1]
    if own < box[2]:
        box = np.array([*0.5 * (least + most), own])
    if box[2] > _LARGEST_PATH * width:
        return None
    height, middle = float(np.median([d.peak[0] for d in points])), np.median(places, axis=0)
    others = [d[~inside(box[None], d)] for d in found]
    reach = [np.column_stack([d.uv_px, ON_LIGHT[0] * d.major_px + ON_LIGHT[1]]) for d in others]
    beside = np.concatenate([np.zeros((0, 3)), *reach])
    at = np.tile(middle, (len(found), 1))
    light = _Light(seen, np.array(every), at, width, height, shown[:0], box, beside)
    uv, values, _, _ = light._around(_AROUND * width, 1)
    if not len(uv):
        return None
    flux = 2 * np.pi * width**2 * height
    # A light that moves is in none of the medians, and most of the pixels show the light of the room alone.
    more = values - np.median(values[shown], axis=0)
    total = np.sum(more - np.median(more, axis=1, keepdims=True), axis=1)
    gone = total < np.median(total[shown]) - _LACKS * flux
    lacks = _lacking(seen, shown, middle, width) > _LACKS * height
    # What is found in the middle although the light has left is an edge.
    true = ~(lacks[shown] & (np.linalg.norm(places - middle, axis=1) < width))
    there = ~gone
    there[shown] = true
    if np.count_nonzero(there) < max(_LEAST_PICTURES, _LEAST_SHARE * len(found)):
        return None
    # Of one that is there and not found: the first moment of what the picture shows more than the mean, in the unit of
    # the places found. What is found of a light that the mean contains is fainter than the light.
    moment = (values - values.mean(axis=0)) @ (uv - middle)
    known, found_at = moment[shown[true]], places[true] - middle
    at = middle + moment * np.sum(known * found_at) / max(np.sum(known**2), 1e-9)
    at[shown[true]] = places[true]
    empty = lacks & gone
    empty[shown] = False
    return replace(light, there=np.flatnonzero(there), places=at[there], empty=np.flatnonzero(empty))


def _lacking(seen: Exposures, shown: Sequence[int] | Ints, place: Array, width: float) -> Array:
    """(n,), DN: by how much less light of this width each picture has at a place than most of those shown.

    Where a vehicle rests for a part of the recording, the other pictures show the background behind its lights.
    """
    values, _, uv = seen.around(range(len(seen.pictures)), np.array([*place, width]), width, 1)
    light = np.exp(-0.5 * np.sum((uv - place) ** 2, axis=1) / width**2)
    return np.asarray((np.median(values[shown], axis=0) - values) @ light / np.sum(light**2))
