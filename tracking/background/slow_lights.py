"""The background behind lights that move slowly, or rest for a part of the recording.

Where such a light is in some of the pictures, the others show the background. A light that moves by less than its own
size is nearly everywhere in all of them: there what is left without the light of the fitted spots counts, the less the
more light there was, since texture modulates it. Source: ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools, Ints
from tracking.background.places import AROUND_SPOT, ON_LIGHT, near_each, places_of
from tracking.detections import Detections

LEAST_CLEAR = 3  # pictures without a light at a pixel, from which these alone count
ROUNDS = 10  # of spots and of the background behind them
_SURE = 0.1  # as many pictures, or more, have the information on the background that counts as sufficient
_MODULATED = 0.3  # share of the fitted light of a spot by which the true one may differ
_MOVED = 1.7  # ratio of the places of moving lights in all pictures to those in one
_WELL = 1.5  # chi-square per degree of freedom of a fit to the picture, up to which the spot stands on even ground
_UNEXPLAINED = 5.0  # sigmas of light that is in no fitted spot: such a pixel of a picture does not count
_UNLIT = 16.0  # widths from a light, beyond which it is 0 in single precision


@dataclass(frozen=True, slots=True)
class SlowLights:
    """The m pixels of n pictures (h, w) in which lights were found that are not in all of them."""

    row: Ints  # (m,)
    column: Ints  # (m,)
    values: NDArray[np.float32]  # (n, m), DN
    clear: Bools  # (n, m): no light there
    shape: tuple[int, ...]
    moved: bool  # the lights have been in clearly more places than they fill

    @staticmethod
    def of(pictures: Sequence[NDArray[Any]], found: Sequence[Detections], holes: Sequence[Detections]) -> SlowLights:
        """From the lights of each picture, and the holes that their absence leaves in the background used so far."""
        shape = pictures[0].shape
        there, absent = (np.array([places_of(d, shape, ON_LIGHT) for d in all_]) for all_ in (found, holes))
        row, column = np.nonzero(there.any(axis=0) | absent.any(axis=0))
        filled = np.count_nonzero(there, axis=(1, 2))
        moved = np.median(filled) > 0 and len(row) > _MOVED * np.median(filled)
        clear, hole = ~there[:, row, column], absent[:, row, column]
        clear &= hole | ~hole.any(axis=0)
        return SlowLights(
            row, column, np.array([p[row, column] for p in pictures], np.float32), clear, shape, bool(moved)
        )

    def __getitem__(self, pixels: Bools) -> SlowLights:
        """Some of the pixels."""
        return SlowLights(
            self.row[pixels], self.column[pixels], self.values[:, pixels], self.clear[:, pixels], self.shape, self.moved
        )

    @property
    def count(self) -> Ints:
        """(m,): number of pictures without a light."""
        return np.asarray(np.count_nonzero(self.clear, axis=0), np.int64)

    @property
    def known(self) -> Bools:
        """(m,): pixels that enough pictures show without a light."""
        return np.asarray(self.count >= LEAST_CLEAR)

    def means(self) -> Array:
        """(m,): of the clear pictures; where these are too few, nearly the lowest value."""
        mean = (self.values * self.clear).sum(axis=0) / np.maximum(self.count, 1)
        return np.where(self.known, mean, np.sort(self.values, axis=0)[1])

    def behind(self, found: Sequence[Detections], before: Array, variance: Array) -> tuple[Array, Array]:
        """The background (m,) without the light of the spots found in each picture, and its information in pictures.

        before (m,): background in which they were found; variance (m,), DN^2: of a pixel.
        """
        light = np.array([light_at(d, self.column, self.row) for d in found])
        left = self.values - light
        weight = variance / (variance + (_MODULATED * light) ** 2)
        weight[left - before > _UNEXPLAINED * np.sqrt(variance / weight)] = 0.0
        total = weight.sum(axis=0)
        return np.where(total > 0, (weight * left).sum(axis=0) / np.maximum(total, 1e-9), before), total

    @property
    def everywhere(self) -> Bools:
        """(m,): all of the pixels."""
        return np.ones(len(self.row), dtype=bool)

    def boxes(self, pixels: Bools) -> Array:
        """Boxes (k, 3) around the connected parts of these pixels (m,): u, v and half side, px."""
        if not pixels.any():
            return np.zeros((0, 3))
        chosen = np.zeros(self.shape, np.uint8)
        chosen[self.row[pixels], self.column[pixels]] = 1
        _, _, places, _ = cv2.connectedComponentsWithStats(chosen)
        left, top, width, height = places[1:, : cv2.CC_STAT_AREA].T.astype(float)
        half = 0.5 * np.maximum(width, height) + AROUND_SPOT[1]
        return np.column_stack([left + 0.5 * (width - 1), top + 0.5 * (height - 1), half])

    @staticmethod
    def is_sure(information: Array) -> Bools:
        """Whether so many pictures, (m,), as `behind` returns them, show the background."""
        return np.asarray(information >= _SURE)


def light_at(spots: Detections, u: Ints, v: Ints) -> NDArray[np.float32]:
    """The light of Gaussian spots at pixels (m,), DN; v rises."""
    out = np.zeros(len(u), np.float32)
    for i in range(len(spots)):
        reach = _UNLIT * (float(spots.major_px[i]) + 1.0)
        near = slice(*np.searchsorted(v, spots.uv_px[i, 1] + [-reach, reach]))
        du, dv = u[near] - spots.uv_px[i, 0], v[near] - spots.uv_px[i, 1]
        turn = np.radians(spots.angle_deg[i])
        major, minor = (np.hypot(x, np.sqrt(1 / 12)) for x in (spots.major_px[i], spots.minor_px[i]))
        along, across = du * np.cos(turn) + dv * np.sin(turn), dv * np.cos(turn) - du * np.sin(turn)
        height = spots.flux[i] / (2 * np.pi * major * minor)
        out[near] += (height * np.exp(-0.5 * ((along / major) ** 2 + (across / minor) ** 2))).astype(np.float32)
    return out


def as_pictures_show(spots: Detections, found: Detections) -> Detections:
    """The spots of a difference from a background that contains some of their light, with those of the picture itself.

    Those that fit the picture well count instead of the spots near them: all of their light is in it.
    """
    well = found[(np.zeros(len(found)) if found.chi2 is None else found.chi2) < _WELL]
    same = near_each(spots, well, AROUND_SPOT)
    alone, shown = np.asarray(~same.any(axis=1)), np.asarray(same.any(axis=0))
    return spots[alone].joined(well[shown], len(spots) + len(found))
