"""The background behind lights that move by a few of their widths at most, from joint fits of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools, Ints
from tracking.background.joint_fit import JointFit, fitted
from tracking.background.places import inside
from tracking.detections import Detections
from tracking.noise import NoiseModel

LARGEST_PATH_PX = 100.0  # half side of the box around the places of such a light
_LARGEST_PATH = 12.0  # half side, in widths of the light
_LEAST_PICTURES, _LEAST_SHARE = 6, 2 / 3  # of the pictures that show the light
_AROUND = 1.5  # widths beyond the box that are fitted
_SAMPLES, _MOST_SAMPLES = 3.0, 2500  # pixels that are fitted: per width of the light, and in all
_LIT = 1e-3  # of the peak: there the background comes from the fit


@dataclass(frozen=True, slots=True)
class BehindLights:
    """The m pixels of a picture (h, w) behind such lights."""

    row: Ints  # (m,)
    column: Ints  # (m,)
    level_dn: Array  # (m,): the background
    share: Array  # (m,): variance of its errors over that of a picture's noise

    @staticmethod
    def of(
        pictures: Sequence[NDArray[Any]], found: Sequence[Detections], boxes: Array, noise: NoiseModel
    ) -> BehindLights:
        """From the points found in each picture inside boxes (k, 3): u, v and half side, px."""
        parts = [part for box in boxes if (part := _behind_one(pictures, found, box, noise)) is not None]
        if not parts:
            return BehindLights(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
        rows, columns, levels, shares = (np.concatenate(x) for x in zip(*parts, strict=True))
        return BehindLights(rows, columns, levels, shares)

    def covers(self, shape: tuple[int, ...]) -> Bools:
        """(h, w): its pixels."""
        out = np.zeros(shape, dtype=bool)
        out[self.row, self.column] = True
        return out


def _behind_one(
    pictures: Sequence[NDArray[Any]], found: Sequence[Detections], box: Array, noise: NoiseModel
) -> tuple[Ints, Ints, Array, Array] | None:
    """Rows, columns, levels and shares of the pixels behind the brightest light in a box; None: no fit."""
    if box[2] > LARGEST_PATH_PX:
        return None
    here = [d[inside(box[None], d)] for d in found]
    shown = [k for k, d in enumerate(here) if len(d)]
    if len(shown) < max(_LEAST_PICTURES, _LEAST_SHARE * len(pictures)):
        return None
    brightest = [here[k][here[k].flux == here[k].flux.max()][:1] for k in shown]
    width = float(np.median([np.sqrt(d.major_px[0] * d.minor_px[0]) for d in brightest]))
    if box[2] > _LARGEST_PATH * width:
        return None
    some = [pictures[k] for k in shown]
    places = np.concatenate([d.uv_px for d in brightest])
    side = 2 * (box[2] + _AROUND * width)
    step = max(int(width / _SAMPLES), int(np.ceil(side / np.sqrt(_MOST_SAMPLES))), 1)
    values, uv = _around(some, box, _AROUND * width, step)
    height = float(np.median([d.peak[0] for d in brightest]))
    fit = fitted(uv, values, noise.variance(values), places, width, height)
    return None if fit is None else _whole(some, box, width, fit, noise)


def _whole(
    pictures: Sequence[NDArray[Any]], box: Array, width: float, fit: JointFit, noise: NoiseModel
) -> tuple[Ints, Ints, Array, Array]:
    """What `_behind_one` returns, from all pixels that the light of a fit reaches."""
    values, uv = _around(pictures, box, 2 * _AROUND * width, 1)
    level, information, light = fit.behind(uv, values, noise.variance(values))
    lit = light > _LIT
    column, row = uv[lit].astype(np.int64).T
    return row, column, level[lit], fit.share + 1 / np.maximum(information[lit], 1e-3)


def _around(pictures: Sequence[NDArray[Any]], box: Array, more: float, step: int) -> tuple[Array, Array]:
    """Values (n, m) of n pictures in a box that is larger by so many px, every `step`-th pixel, and pixels (m, 2)."""
    (height, width), half = pictures[0].shape, box[2] + more
    rows = np.arange(max(int(box[1] - half), 0), min(int(box[1] + half) + 1, height), step)
    columns = np.arange(max(int(box[0] - half), 0), min(int(box[0] + half) + 1, width), step)
    v, u = (x.ravel() for x in np.meshgrid(rows, columns, indexing="ij"))
    return np.array([p[v, u] for p in pictures], dtype=float), np.column_stack([u, v]).astype(float)
