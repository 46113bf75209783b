"""Pictures that mix instants: averages of successive ones (by their noise and moving spots), and interlaced ones.

A filter against noise that takes a share r of each picture from the one before makes the noise of pictures that are k
apart correlated by r^k. A spot that moves by v px from picture to picture then lags by r v / (1 - r), which no sigma
contains and all cameras may share, and its second moment along its motion is larger by r v^2 / (1 - r)^2. A shutter
that is open for a share s of the time makes a streak: s^2 v^2 / 12. Filters that spare what moves, and compressed
videos, have such noise without such spots. The two fields of an interlaced picture show what moves at two places, so
that its rows alternate. Ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import NORMAL_MEDIAN, Array

if TYPE_CHECKING:
    from tracking.noise import Picture  # loads OpenCV, which runs of points do without

OPEN_SHUTTER = 1 / 12  # px^2 per (px per picture)^2: of a shutter that is always open
_FASTEST = 3.0  # widths from picture to picture: the pictures of faster spots are apart
LEAST_KEPT = 0.12  # share of the picture before from which a camera averages; without averages 0.03 at most is seen
_FEWEST = 12  # pictures of a spot: three moments of each, of which nine numbers give its own shape and how it changes
_FARTHEST = 3.0  # sigmas of the usual scatter beyond which a moment counts little: an edge or a neighbour deforms it
_LEAST_SCATTER = 0.5  # of the sigmas: spots scatter by this where their sigmas include a texture's errors
_ROUNDS = 10  # of weights: they settle within five
_BLOCK = 16  # px: compressed videos repeat such blocks
_BLOCKS = 2000  # of a picture; a third of them give the correlation to about 0.01
_MOST_REPEATED = 0.02  # share of blocks that repeat exactly: of compressed pictures 0.14 and more, else 0.002 at most
# Rows that alternate this often in turn, and of those that alternate four times. Interlaced edges do in 0.3 to 0.6 of
# these, the texture and the blocks of videos in 0.03 to 0.07. As many columns alternate in texture.
_SHORT, _LONG, _LONG_SHARE, _OF_COLUMNS = 4, 6, 0.2, 4
_LEAST_COMBS = 20  # pixels in all pictures looked at
_COMB_SIGMAS, _COMB_DN = 4.0, 4.0  # least difference of two rows
_SAMPLE = 16  # each so many rows show the noise
_FLATTEST = 1 / 3  # of the blocks: in the others, the structure that a camera moves counts as noise
_PARTS = 6  # of a recording


def kept_of_the_last(pictures: Sequence[Picture], rounding: float) -> float:
    """Share of each picture that comes from the one before, as the noise of three successive ones (h, w) shows it.

    rounding: variance of the rounding error, DN^2. nan where it does not show: fewer pictures, of different sizes,
    compressed, or with less noise than rounding.
    """
    if len(pictures) < 3 or len({p.shape for p in pictures}) > 1 or min(pictures[0].shape) < _BLOCK:
        return float("nan")
    a, b, c = (_blocks(p) for p in pictures[:3])
    steps = b - a, c - b
    if np.mean([np.mean(~step.any(axis=-1)) for step in steps]) > _MOST_REPEATED:
        return float("nan")
    structure = np.var(a + b + c, axis=-1)
    flat = structure <= np.quantile(structure, _FLATTEST)
    near = np.median([np.var(step[flat], axis=-1) for step in steps]) - 2 * rounding
    far = np.median(np.var((c - a)[flat], axis=-1)) - 2 * rounding
    # White noise has a ratio of 1, and a correlation of r from picture to picture one of 1 + r.
    return float(far / near - 1) if near > 2 * rounding else float("nan")


def _blocks(picture: Picture) -> NDArray[np.float32]:
    """(m, 256): the pixels of its whole blocks, of some rows of them in large pictures."""
    rows, columns = (n // _BLOCK for n in picture.shape)
    bands = picture[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK)
    some = bands[:: rows * columns // _BLOCKS + 1].astype(np.float32)
    return some.swapaxes(1, 2).reshape(-1, _BLOCK**2)


@dataclass(slots=True)
class RowCounts:
    """Whether the even and odd rows of pictures show what moves at two places."""

    _short: int = 0  # pixels whose rows alternate
    _long: int = 0
    _columns: int = 0

    def add(self, first: Picture, second: Picture) -> None:
        """Two successive pictures (h, w): what stands still, with its lines, is no part of their difference."""
        if first.shape != second.shape:
            return
        change = np.subtract(second, first, dtype=np.float32)
        if short := _alternating(change, _SHORT):
            self._short += short
            self._long += _alternating(change, _LONG)
            self._columns += _alternating(change.T, _SHORT)

    @property
    def interlaced(self) -> bool:
        enough = self._long >= max(_LEAST_COMBS, _LONG_SHARE * self._short)
        return enough and self._short > _OF_COLUMNS * self._columns


def _alternating(picture: NDArray[Any], count: int) -> int:
    """Pixels from which `count` differences of successive rows have signs in turn, and are clearly more than noise."""
    before, after = picture[:-1], picture[1:]
    size = np.abs(after - before)
    large = size > _COMB_SIGMAS * float(np.median(size[::_SAMPLE])) / NORMAL_MEDIAN + _COMB_DN
    rises = after > before
    turns = (rises[1:] != rises[:-1]) & large[1:] & large[:-1]
    out = turns[: len(turns) - count + 2].copy()
    for k in range(1, count - 1):
        out &= turns[k : k + len(out)]
    return int(np.count_nonzero(out))


def stretch_by_motion(uv_px: Array, profile_px2: Array, variance_px2: Array) -> tuple[float, float]:
    """Growth of the spots' second moments along their motion per squared motion from picture to picture, and its sigma.

    uv_px (k, 3, n, 2): n spots of a camera in k times three successive pictures, nan where not seen; profile_px2
    (k, n, 2, 2): second moments in the middle one; variance_px2 (k, n): of a coordinate of the spots. Both figures have
    no unit; the sigma is inf where no motion shows it.
    """
    fits = []
    for spot in range(uv_px.shape[2]):
        motion = (uv_px[:, 2, spot] - uv_px[:, 0, spot]) / 2
        shape = profile_px2[:, spot]
        size2 = np.trace(shape, axis1=-1, axis2=-2) / 2
        with np.errstate(invalid="ignore"):
            rows = np.flatnonzero(np.sum(motion**2, axis=-1) < _FASTEST**2 * size2)
        if len(rows) < _FEWEST or not motion[rows].any():  # at rest in pictures that repeat
            continue
        # A screen is oblique, so that the shape changes with the place.
        place = uv_px[rows, 1, spot]
        place = (place - place.mean(axis=0)) / max(float(np.std(place)), 1.0)
        own = np.kron(np.column_stack([np.ones(len(rows)), place]), np.eye(3))
        columns = np.column_stack([_moments(motion[rows, :, None] * motion[rows, None, :]).ravel(), own.reshape(-1, 9)])
        weight = 1 / np.sqrt(8 * size2[rows] * variance_px2[rows, spot])  # 2 sqrt 2 widths times the place's sigma
        fits.append(_slope(columns.reshape(-1, 3, 10), _moments(shape[rows]), weight))
    if not fits:
        return 0.0, np.inf
    growth, sigma = np.array(fits).T
    weight = sigma**-2 / np.sum(sigma**-2)
    mean = weight @ growth
    chi2 = np.sum(((growth - mean) / sigma) ** 2) / max(len(fits) - 1, 1)
    return float(mean), float(np.sqrt(max(chi2, 1.0) / np.sum(sigma**-2)))


def _moments(second: Array) -> Array:
    """(m, 3): of symmetric matrices (m, 2, 2), so that the squares of both sum to the same."""
    return np.stack([second[:, 0, 0], np.sqrt(2) * second[:, 0, 1], second[:, 1, 1]], axis=-1)


def _slope(columns: Array, values: Array, weight: Array) -> tuple[float, float]:
    """The first parameter of a robust fit of values (m, 3) by columns (m, 3, p), and its sigma; weight (m,): 1 / sigma.

    Edges and texture deform a spot in successive pictures alike, so that the sigma is that of a jackknife over parts of
    the recording, where that is larger.
    """
    p = columns.shape[-1]
    robust, scatter = np.ones(len(values)), 1.0
    for _ in range(_ROUNDS):
        used = (weight * robust)[:, None]
        rows, wanted = columns * used[..., None], values * used
        solution = np.linalg.lstsq(rows.reshape(-1, p), wanted.ravel(), rcond=None)[0]
        left = np.sqrt(np.mean((values - columns @ solution) ** 2, axis=-1)) * weight
        scatter = max(float(np.median(left)), 1e-9)
        robust = 1 / (1 + (left / (_FARTHEST * scatter)) ** 2)
    flat = rows.reshape(-1, p)
    variance = np.linalg.pinv(flat.T @ flat)[0, 0] * max(scatter, _LEAST_SCATTER) ** 2
    without = np.array([
        np.linalg.lstsq(np.delete(rows, part, 0).reshape(-1, p), np.delete(wanted, part, 0).ravel(), rcond=None)[0][0]
        for part in np.array_split(np.arange(len(values)), _PARTS)
    ])  # fmt: skip
    scattered = (_PARTS - 1) / _PARTS * np.sum((without - without.mean()) ** 2)
    return float(solution[0]), float(np.sqrt(max(variance, scattered)))
