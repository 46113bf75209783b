"""The small rotations of a camera from picture to picture, measured by what stands still in front of it.

A camera on a floor that vibrates turns by some microradians between pictures: by a tenth of a pixel, which is several
sigmas of a spot. The walls and screens in its pictures show these turns far better than the spots do. A picture is
moved to where the camera points on average, by a shift, a rotation and a stretch, so that all that stands still is in
the same pixels; the spots are corrected by what these leave of a rotation of the camera. Source: ours; the step is
that of a registration of pictures (Lucas & Kanade 1981), with the rotation of a calibrated camera for its movement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools, Ints, robust_sigma
from geometry.camera import Camera
from geometry.compilation.jit import compiled_for_threads
from tracking.background.mean_pictures import MIDDLE_VARIANCE, means_of
from tracking.background.places import AROUND_LIGHT, places_of
from tracking.detection.detect import find_spots, saturation_of
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture
from tracking.parameters import DetectParameters

_LEAST_PICTURES, _SMALLEST_PX = 5, 160  # fewer do not show a scatter; a smaller one has no room for the tiles
_TILES = 16  # of a picture, along each side: the landmarks are spread over them
_FEW, _PER_TILE = 3, 8  # landmarks per tile and direction: whether the camera moves; by how much
_STEEP = 8.0  # sigmas of a pixel's noise per px: least slope of a landmark
_SINGLE = 4.0  # sigmas of a pixel, and of its slope: a pixel that differs by more from those around it is a hot one
_LEAST_TILES = 16  # with landmarks: lights of an unlit room are in fewer, and may be those of the vehicle
_MARGIN, _SPARSE = 12, 2  # px: no landmarks at the edge; every such pixel may be one
_BLUR_PX, _RADIUS = 1.0, 2  # px: of the pictures at the landmarks, whose slopes would be noise otherwise
_SHARED = 4 * np.pi * _BLUR_PX**2  # landmarks that share their noise, at most
FARTHEST_PX = 8  # largest movement that is corrected
_SOME = 4  # every such landmark shows which movement of a whole picture is nearest
_LEAST_PEAK = 0.3  # of a correlation of pictures: .3 to .5 in front of a room, .16 of eight lights that move alike
_LEAST_STRUCTURE = 0.1  # share of the pixels: compressed videos of rooms have .27 and more, of even screens .01 to .06
_ROUNDS = 6  # of the fit, whose weights and whose place change
_NEAR_PX, _ON_PX = 0.03, 0.005  # a movement that is not undone but corrected; one that is no movement
_OUTLIER = 3.0  # sigmas: what a landmark leaves counts in full up to this, and not at all beyond twice of it
_LARGEST_MISFIT = 1.6  # sigma of what the landmarks leave over their noise; above it something else has changed
_UNDETERMINED = 1e12  # condition of the fit: of long focal lengths, where a rotation is nearly a shift, up to 1e9
_MOSTLY, _STILL_SHARE = 0.85, 0.5  # of the pictures, in which a landmark stands still; least share of those that do
_LEAST_PX = 0.01  # movements with a smaller root mean square are none: few spots are better than that
_CLEAR = 0.75  # times its error, which is 3.5 times that of landmarks with noise of their own: a movement is corrected
_ONE = 0.5  # of the farthest movement: a larger one between two pictures is that of a camera that is moved once
_PARTS, _STEP = 10, 9.0  # of a recording; square of their mean movement over its variance, above which that is a step
_SLOW_SHARE = 0.3  # variance of the mean of the movements over theirs, above which they are slow
_BEFORE = 3  # pixels before a place in the filter of 8 pixels that moves a picture
_CHANGE_PX = 0.01  # for the derivatives of that filter
_SIDE = 32  # px of a row that are moved by the same
_FREE = 5  # unknowns of a motion: a rotation and a shift


class Turn(NamedTuple):
    """Of a camera in one picture, from its mean attitude."""

    motion: Array  # (5,): rotation of what it sees, in its frame, rad, and shift of its pictures, px
    covariance: Array  # (5, 5)
    movement: Array  # (2, 3), px per (1, u, v): what `stilled` has undone of it


class _Fit(NamedTuple):
    motion: Array  # (5,): small
    covariance: Array  # (5, 5)
    left: Array  # (k,), sigmas
    misfit: float  # sigma of these


@dataclass(frozen=True, slots=True)
class CameraMotion:
    """What stands still in the pictures (h, w) of a camera, and how much the camera turns about its mean attitude."""

    camera: Camera
    usual: NDArray[np.float32]  # (h, w), DN: a picture in which it does not turn
    pixels: Ints  # (k, 2): u, v of landmarks
    values: Array  # (k,), DN: of the landmarks where the camera does not turn
    slopes: Array  # (k, 2), DN/px
    sigma: Array  # (k,), DN: of a difference
    moved: Array  # (k, 2, 5): movement of each, px, by a motion
    mean_motion: Array  # (5,): of the pictures that `stilled` gives, from the landmarks
    offset: Array  # (5,): mean of the recording, from those pictures
    rms_px: float = 0.0  # of the movements
    farthest_px: float = 0.0  # between two pictures
    mean_variance_px2: float = 0.0  # of their mean, along each axis: the same in all pictures
    pictures: int = 1  # from which the mean is known
    moved_between: tuple[int, int] | None = None  # numbers of pictures; None: not at once

    @staticmethod
    def of(
        pictures: Sequence[Picture], camera: Camera, noise: NoiseModel, parameters: DetectParameters
    ) -> CameraMotion | None:
        """From pictures spread over a recording. None: the camera stands still, or they do not show that it moves."""
        if not pictures:
            return None
        middle, clips = pictures[len(pictures) // 2], saturation_of(parameters, pictures[0])
        if (seen := CameraMotion.at_first(pictures, camera, noise, clips)) is None:
            return None
        # The noise of one picture makes slopes too steep, that of a mean less. In the middle half of the values is no
        # light that moves, whose traces would be the landmarks of an even wall.
        about, at_first = seen
        moved = [moved_by(p, about._movement(turn.motion - about.mean_motion), clips) for p, turn in at_first]
        mean = means_of(moved)[1]
        lit = places_of(find_spots(middle, parameters, noise), middle.shape, AROUND_LIGHT) | (mean >= clips)
        motion = _landmarks(mean, len(moved) / MIDDLE_VARIANCE, lit, camera, noise, _PER_TILE)
        turned = motion._turns_in(pictures, clips)
        if turned is None:
            return None
        fits = [motion._fitted(moved_by(p, turn.movement, clips), 0.0) for p, turn in turned]
        still = np.mean([fit.left < _OUTLIER for fit in fits if fit is not None], axis=0) > _MOSTLY
        if still.mean() < _STILL_SHARE:
            return None
        motion = motion._only(still)
        turned = motion._turns_in(pictures, clips)
        return None if turned is None else motion._about_mean([turn for _, turn in turned])

    @staticmethod
    def at_first(
        pictures: Sequence[Picture], camera: Camera, noise: NoiseModel, clips: float
    ) -> tuple[CameraMotion, list[tuple[Picture, Turn]]] | None:
        """That of a few landmarks of a single picture, and the pictures that show their turns. None: as in `of`."""
        size = camera.image_size_px
        if len(pictures) < _LEAST_PICTURES or any(p.shape[::-1] != size for p in pictures) or min(size) < _SMALLEST_PX:
            return None
        middle = pictures[len(pictures) // 2]
        motion = _landmarks(middle.astype(np.float32), 1, np.zeros(middle.shape, bool), camera, noise, _FEW)
        turned = motion._turns_in(pictures, clips)
        about = None if turned is None else motion._about_mean([turn for _, turn in turned])
        return None if turned is None or about is None else (about, turned)

    def with_mean_of(self, pictures: Mapping[int, Picture], clips: float) -> CameraMotion:
        """With the mean attitude of more pictures of the recording, by number, as that to which spots are corrected."""
        turns = {number: found[1].motion for number, p in pictures.items() if (found := self._turned(p, clips))}
        if len(turns) <= max(self.pictures, len(pictures) // 2):
            return self
        numbers, motions = list(turns), np.array(list(turns.values()))
        moved = (motions - motions.mean(axis=0)) @ self._middle.T
        out = replace(self, offset=motions.mean(axis=0), pictures=len(motions))._with_spread(moved)
        steps = np.linalg.norm(np.diff(moved, axis=0), axis=1)
        at = int(np.argmax(steps))
        return replace(out, moved_between=(numbers[at], numbers[at + 1])) if steps[at] > _ONE * out.farthest_px else out

    def stilled(self, picture: Picture, clips: float) -> tuple[Picture | None, Turn | None]:
        """A picture (h, w) moved to where the camera does not turn, and its turn, which `corrected` needs.

        clips, DN: of the sensor. None: the picture does not show how the camera has turned.
        """
        found = self._turned(picture, clips)
        return (None, None) if found is None else (in_whole_dn(found[0], picture), found[1])

    def _turned(self, picture: Picture, clips: float) -> tuple[NDArray[Any], Turn] | None:
        """As `stilled`, not rounded."""
        if picture.shape[::-1] != self.camera.image_size_px:
            return None
        return self._found(picture, np.zeros(_FREE), clips) or self._found(
            picture, np.append(np.zeros(3), shift_between(self.usual, picture)), clips
        )

    def _found(self, picture: Picture, motion: Array, clips: float) -> tuple[NDArray[Any], Turn] | None:
        """As `_turned`, from a first estimate of the motion."""
        for k in range(_ROUNDS):
            if np.abs(self._middle @ motion).max() > FARTHEST_PX:
                break
            movement = self._movement(motion)
            moved: NDArray[Any] = moved_by(picture, movement, clips) if motion.any() else picture
            found = self._fitted(moved, self.moved @ motion - _undone(movement, self.pixels))
            if found is None:
                break
            left = found.motion - self.mean_motion
            motion = motion + left
            if np.abs(self._middle @ left).max() < (_NEAR_PX if k else _ON_PX):
                return None if found.misfit > _LARGEST_MISFIT else (moved, Turn(motion, found.covariance, movement))
        return None

    def corrected(self, found: Detections, turn: Turn | None) -> Detections:
        """The points of a picture that `stilled` has moved where they would be if the camera had not turned.

        Those of a picture whose turn is not known have the usual error.
        """
        if turn is None:
            return replace(found, cov_px2=found.cov_px2 + self.rms_px**2 * np.eye(2))
        moved = _movements(self.camera, found.uv_px)
        uv = found.uv_px + _undone(turn.movement, found.uv_px) - moved @ (turn.motion - self.offset)
        return replace(found, uv_px=uv, cov_px2=found.cov_px2 + moved @ turn.covariance @ moved.transpose(0, 2, 1))

    @property
    def is_slow(self) -> bool:
        """Whether the camera moves once, or slowly, so that the mean of its pictures is no attitude of calibration."""
        return self.mean_variance_px2 > _SLOW_SHARE * self.rms_px**2

    @property
    def _middle(self) -> Array:
        """(2, 5): mean movement of the landmarks, px, by a motion."""
        return np.asarray(self.moved.mean(axis=0))

    def _movement(self, motion: Array) -> Array:
        """(2, 3), px per (1, u, v): what is nearest to a motion among those that a whole picture can follow."""
        some = slice(None, None, _SOME)
        places = np.column_stack([np.ones(len(self.pixels[some])), self.pixels[some]])
        return np.asarray(np.linalg.lstsq(places, self.moved[some] @ motion, rcond=None)[0].T)

    @property
    def _tiles(self) -> int:
        """Number of tiles with landmarks."""
        return len(np.unique(self.pixels * _TILES // np.array(self.camera.image_size_px), axis=0))

    def _only(self, kept: Bools) -> CameraMotion:
        return replace(
            self, pixels=self.pixels[kept], values=self.values[kept], slopes=self.slopes[kept],
            sigma=self.sigma[kept], moved=self.moved[kept],
        )  # fmt: skip

    def _turns_in(self, pictures: Sequence[Picture], clips: float) -> list[tuple[Picture, Turn]] | None:
        """The pictures that show their turns, and these; None: the landmarks are too few, or most pictures do not."""
        if self._tiles < _LEAST_TILES:
            return None
        known = [(p, found[1]) for p in pictures if (found := self._turned(p, clips)) is not None]
        return known if len(known) > len(pictures) // 2 else None

    def _about_mean(self, turns: Sequence[Turn]) -> CameraMotion | None:
        """With turns from the mean of these; None: they are no more than their errors."""
        mean = np.mean([turn.motion for turn in turns], axis=0)
        moved = np.array([self._middle @ (turn.motion - mean) for turn in turns])
        error2 = np.mean([np.trace(self._middle @ turn.covariance @ self._middle.T) for turn in turns]) / 2
        rms = float(np.sqrt(np.mean(moved**2)))
        if rms < max(_LEAST_PX, _CLEAR * float(np.sqrt(error2))):
            return None
        about = replace(self, mean_motion=self.mean_motion + mean, rms_px=rms, pictures=len(turns))
        return about._with_spread(moved)

    def _with_spread(self, moved: Array) -> CameraMotion:
        """With what movements (n, 2) from their mean, px, show of its error, and how far they are apart."""
        farthest_px = float(np.linalg.norm(np.ptp(moved, axis=0)))
        return replace(self, farthest_px=farthest_px, mean_variance_px2=_variance_of_mean(moved))

    def _seen(self, picture: NDArray[Any]) -> Array:
        """(k,), DN: what is in a picture at the landmarks."""
        at = self.pixels @ [1, picture.shape[1]]
        return np.asarray(picture.ravel()[at[:, None] + _NEAR @ [1, picture.shape[1]]] @ _WEIGHTS)

    def _design(self) -> Array:
        """(k, 7), sigmas: what a motion, more light and a brighter level change at the landmarks."""
        columns = -np.einsum("ki,kij->kj", self.slopes, self.moved)
        return np.column_stack([columns, self.values, np.ones(len(self.values))]) / self.sigma[:, None]

    def _off(self, picture: NDArray[Any], known_px: Array | float = 0.0) -> Array:
        """(k,), sigmas: differences of a picture from the landmarks after a known movement (k, 2), px, of each."""
        expected = self.values - np.sum(self.slopes * known_px, axis=1)
        return np.asarray((self._seen(picture) - expected) / self.sigma)

    def _fitted(self, picture: NDArray[Any], known_px: Array | float) -> _Fit | None:
        """By a robust fit what has changed beside a known movement (k, 2), px; None: it is not determined."""
        design, off = self._design(), self._off(picture, known_px)
        scale = np.linalg.norm(design, axis=0)
        if not scale.all():
            return None
        design /= scale
        left, before = np.abs(off), np.inf  # at first: where a spot was in one of the pictures, they differ by far
        for _ in range(_ROUNDS):
            spread = float(robust_sigma(left))
            if spread > 0.99 * before:
                break
            weights = np.clip(2 - left / (_OUTLIER * max(spread, 1.0)), 0.0, 1.0)
            weighted = design * weights[:, None]
            normal = weighted.T @ design
            if np.linalg.cond(normal) > _UNDETERMINED:
                return None
            inverse = np.linalg.inv(normal)
            left, before = np.abs(off - design @ (solution := inverse @ (weighted.T @ off))), spread
        spread = float(robust_sigma(left))
        covariance = _SHARED * max(spread, 1.0) ** 2 * inverse / np.outer(scale, scale)
        return _Fit(solution[:_FREE] / scale[:_FREE], covariance[:_FREE, :_FREE], left, spread)


def shift_between(first: Picture | NDArray[np.float32], second: Picture) -> Array:
    """(2,), px: by what a second picture (h, w) is moved; 0 where they have no structure in common, or differ in size.

    By phase correlation of the signs of their curvature, in which bright lights count no more than what else is there.
    """
    if first.shape != second.shape:
        return np.zeros(2)
    window = cv2.createHanningWindow(first.shape[::-1], cv2.CV_32F)
    curved = _curvature(first), _curvature(second)
    if min(map(np.count_nonzero, curved)) < _LEAST_STRUCTURE * first.size:
        return np.zeros(2)
    shift, peak = cv2.phaseCorrelate(*curved, np.asarray(window, np.float32))
    return np.array(shift) if peak > _LEAST_PEAK else np.zeros(2)


def _curvature(picture: NDArray[Any]) -> NDArray[np.float32]:
    """(h, w): the sign of the curvature of a picture."""
    blurred = cv2.GaussianBlur(picture, (0, 0), _BLUR_PX)
    return np.asarray(np.sign(cv2.Laplacian(blurred, cv2.CV_32F)), np.float32)


def _variance_of_mean(deviations: Array) -> float:
    """Of the mean of successive values, per coordinate, from their deviations (n, 2) from it.

    After a step, or with a slow movement, the attitude of the calibration may be any of those in the recording.
    """
    n = len(deviations)
    parts = np.array_split(deviations, min(_PARTS, n // 3))  # of three values and more
    independent = 0.5 * float(np.mean(np.diff(deviations, axis=0) ** 2))
    means2 = [float(np.mean(part.mean(axis=0) ** 2)) for part in parts]
    steps = [x for x, part in zip(means2, parts, strict=True) if x > _STEP * independent / len(part)]
    return max(steps, default=float(np.mean(deviations**2)) / n)


def moved_by(picture: Picture, movement: Array, clips: float) -> NDArray[np.float32]:
    """A picture (h, w) whose pixel at x shows what was at x + movement @ (1, u, v), px; clipped ones stay so.

    movement (2, 3); clips: in DN.
    """
    moved, spare = np.empty((2, *picture.shape), np.float32)
    _move(picture.astype(np.float32), movement, _TABLE, spare, moved)
    clipped, most = picture >= clips, np.iinfo(picture.dtype).max
    if clipped.any():
        beside = cv2.dilate(clipped.astype(np.uint8), np.ones((3, 3)))  # and by less than a pixel elsewhere
        shift = np.rint(movement @ [1, *(0.5 * np.array(picture.shape[::-1]))]).astype(int)
        moved[np.roll(beside, -shift[::-1], (0, 1)) > 0] = most
    return moved


def in_whole_dn(moved: NDArray[Any], picture: Picture) -> Picture:
    """Grey values (h, w) in the type of a picture.

    With a random part before they are rounded: a small movement changes whole numbers by less than half, and rounding
    would undo it.
    """
    whole = np.clip(np.floor(moved + _dither(moved.shape)), 0, np.iinfo(picture.dtype).max)
    return whole.astype(np.uint8) if picture.dtype == np.uint8 else whole.astype(np.uint16)


@cache
def _dither(shape: tuple[int, ...]) -> NDArray[np.float32]:
    return np.random.default_rng(0).random(shape, np.float32)


@compiled_for_threads
def _move(
    grey: NDArray[np.float32], movement: Array, table: NDArray[np.float32], spare: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:  # fmt: skip
    """Along u, then along v. The weights are those of the middle of some pixels of a row."""
    height, width = grey.shape
    steps = table.shape[0] - 1
    for v in range(height):
        for first in range(0, width, _SIDE):
            last = min(first + _SIDE, width)
            gap = movement[0, 0] + movement[0, 1] * 0.5 * (first + last - 1) + movement[0, 2] * v
            whole = int(np.floor(gap))
            w = table[int((gap - whole) * steps + 0.5)]
            begin = first + whole - _BEFORE
            if begin >= 0 and last + whole + _BEFORE + 1 <= width:
                seen = grey[v, begin : begin + last - first + 2 * _BEFORE + 1]
                for j in range(last - first):
                    spare[v, first + j] = (
                        w[0] * seen[j] + w[1] * seen[j + 1] + w[2] * seen[j + 2] + w[3] * seen[j + 3]
                        + w[4] * seen[j + 4] + w[5] * seen[j + 5] + w[6] * seen[j + 6] + w[7] * seen[j + 7]
                    )  # fmt: skip
            else:
                for j in range(first, last):
                    total = np.float32(0.0)
                    for k in range(8):
                        total += w[k] * grey[v, min(max(j + whole + k - _BEFORE, 0), width - 1)]
                    spare[v, j] = total
    for v in range(height):
        for first in range(0, width, _SIDE):
            last = min(first + _SIDE, width)
            gap = movement[1, 0] + movement[1, 1] * 0.5 * (first + last - 1) + movement[1, 2] * v
            whole = int(np.floor(gap))
            w = table[int((gap - whole) * steps + 0.5)]
            to = out[v, first:last]
            to[:] = np.float32(0.0)
            for k in range(8):
                seen = spare[min(max(v + whole + k - _BEFORE, 0), height - 1), first:last]
                for j in range(last - first):
                    to[j] += w[k] * seen[j]


def _weights(part: float) -> Array:
    """(8,): weights of the pixels from 3 before to 4 after a place, for the value at 0 to 1 px from it (Lagrange).

    They are right for polynomials: those of windowed sinc functions move slopes by some percent too little.
    """
    x = np.arange(-_BEFORE, _BEFORE + 2)
    gaps = np.where(np.eye(len(x), dtype=bool), 1.0, x[:, None] - x)
    return np.asarray(np.where(np.eye(len(x), dtype=bool), 1.0, part - x).prod(axis=1) / gaps.prod(axis=1))


_TABLE = np.array([_weights(part) for part in np.linspace(0.0, 1.0, 1025)], np.float32)  # 1/1024 px is no error
_VALUE, _SLOPE = _weights(0.0), (_weights(_CHANGE_PX) - _weights(-_CHANGE_PX)) / (2 * _CHANGE_PX)
_NEAR = np.array([(u, v) for v in range(-_RADIUS, _RADIUS + 1) for u in range(-_RADIUS, _RADIUS + 1)])
_WEIGHTS = np.exp(-0.5 * np.sum(_NEAR**2, axis=1) / _BLUR_PX**2)
_WEIGHTS /= _WEIGHTS.sum()


def _filtered(picture: NDArray[Any], along: Array, across: Array) -> NDArray[np.float32]:
    """A picture (h, w) with weights as `_weights` along u and v."""
    return np.asarray(cv2.sepFilter2D(picture, cv2.CV_32F, along, across, anchor=(_BEFORE, _BEFORE)), np.float32)


def _undone(movement: Array, pixels: Array | Ints) -> Array:
    """(n, 2), px: by how much `moved_by` moves what pixels (n, 2) show."""
    return np.asarray(movement[:, 0] + pixels @ movement[:, 1:].T)


def _movements(camera: Camera, pixels: Array | Ints) -> Array:
    """(n, 2, 5): movements, px, of what pixels (n, 2) show by a rotation, rad, and by a shift, px."""
    return np.concatenate(
        [camera.by_turns(np.asarray(pixels, float)), np.broadcast_to(np.eye(2), (len(pixels), 2, 2))], axis=2
    )


def _landmarks(
    grey: NDArray[np.float32], pictures: float, lit: Bools, camera: Camera, noise: NoiseModel, per_tile: int
) -> CameraMotion:
    """The pixels of a mean of pictures (h, w) with the steepest structure, but for lights and for what is beside them.

    pictures: the number whose mean has its variance. lit (h, w): lights.
    """
    plain = np.asarray(cv2.medianBlur(grey, 3), np.float32)
    variance = np.asarray(noise.variance(plain) / pictures, np.float32)
    # A hot pixel belongs to the sensor, and turns with it.
    steep2 = np.square(cv2.Sobel(plain, cv2.CV_32F, 1, 0)) + np.square(cv2.Sobel(plain, cv2.CV_32F, 0, 1))
    single = np.square(grey - plain) > _SINGLE**2 * (variance + steep2 / 64)
    beside = cv2.dilate((single | lit).astype(np.uint8), np.ones((2 * _BEFORE + 1,) * 2)) > 0
    grey = np.asarray(cv2.GaussianBlur(grey, (2 * _RADIUS + 1,) * 2, _BLUR_PX), np.float32)
    variance *= float(np.sum(_WEIGHTS**2))
    along, across = _filtered(grey, _SLOPE, _VALUE), _filtered(grey, _VALUE, _SLOPE)
    some = np.s_[_MARGIN:-_MARGIN:_SPARSE, _MARGIN:-_MARGIN:_SPARSE]
    along_some, across_some = along[some], across[some]
    usable = (along_some**2 + across_some**2 > _STEEP**2 * variance[some]) & ~beside[some]
    # As many for each direction: a picture may show the edges of shelves, and little that is upright.
    steep = [np.abs(slope) * usable for slope in (along_some, across_some)]
    chosen = np.unique(np.concatenate([_spread_over_tiles(slope, per_tile) for slope in steep]), axis=0)
    pixels = _SPARSE * chosen + _MARGIN
    moved = _movements(camera, pixels)
    known = np.isfinite(moved).all(axis=(1, 2))
    pixels, moved = pixels[known], moved[known]
    at = pixels[:, 1], pixels[:, 0]
    slopes = np.column_stack([along[at], across[at]]).astype(float)
    sigma = np.sqrt((1 + pictures) * variance[at]).astype(float)
    return CameraMotion(
        camera, plain, pixels, grey[at].astype(float), slopes, sigma, moved, np.zeros(_FREE), np.zeros(_FREE)
    )


def _spread_over_tiles(slope: NDArray[np.float32], per_tile: int) -> Ints:
    """(k, 2): column, row of the largest positive values of each tile of an array (h, w)."""
    rows, columns = (np.linspace(0, n, _TILES + 1).astype(int) for n in slope.shape)
    chosen = []
    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            tile = slope[top:bottom, left:right].ravel()
            best = np.argpartition(tile, -per_tile)[-per_tile:]
            row, column = np.divmod(best[tile[best] > 0], right - left)
            chosen.append(np.stack([column + left, row + top], axis=-1))
    return np.concatenate(chosen)
