"""Circle detectors: parameters, coarse circles and their window, the improved Hough gradient method of Zhou (2014).

A detector gets a picture and a window, and returns coarse circles: where another detector is added. Lengths are pixels,
times are frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Ints
from tracking.noise import Picture


class Edge(StrEnum):
    """Which edge of a target with several ones about the same centre is tracked."""

    SUPPORTED = "supported"  # the outermost of those that are supported about equally well
    OUTER = "outer"  # of the rim
    INNER = "inner"  # of a thin rim: the other side of its line
    OPENING = "opening"  # of the basket: clearly inside the rim


@dataclass(frozen=True, slots=True)
class CircleParameters:
    """Each field with its unit and, where it is from Zhou (2014), the symbol there."""

    min_radius_px: float = 7.0  # of circles searched in the whole picture (the paper: 10)
    max_radius_px: float | None = None  # None: half of the picture's smaller side (the paper: 30)
    edge: Edge = Edge.SUPPORTED
    blur_px: float = 1.0  # 1 sigma of the Gaussian filter before gradients
    window_radii: float = 4.0  # side of the search window in radii (section 2.3)
    gate_px: float = 8.0  # sigma: largest distance of a centre from the prediction, at least 3 standard deviations
    radius_gate: float = 0.25  # largest relative difference of a radius from the prediction
    candidates: int = 3  # coarse circles of a window that are fitted to the rim
    min_coverage: float = 0.4  # share of the rim with edge points for a measurement
    acquire_coverage: float = 0.6  # the same for a circle without a prediction
    ambiguous_share: float = 0.8  # a second circle with this share of the best one's score makes the choice ambiguous
    occluded: float = 0.5  # beta: with an occlusion coefficient from here on the state is only predicted
    accelerations_px: tuple[float, ...] = (0.02, 0.08, 0.3, 1.2)  # px/frame^2, 1 sigma, of the filters of the bank
    jerks_px: tuple[float, ...] = (0.003, 0.012, 0.05)  # px/frame^3, of the filters with a steady acceleration
    radius_share: float = 0.15  # acceleration of the radius as a share of that of the centre
    forgetting: float = 0.95  # of the likelihoods of the bank, per frame
    gate_chi2: float = 21.1  # innovation gate, 3 degrees of freedom, p = 1e-4
    search_after: int = 3  # frames without a measurement after which the whole picture is searched, too
    most_predicted: int = 50  # frames without a measurement after which the circle is lost
    lost_sigma_radii: float = 1.0  # standard deviation of the centre, in radii, above which the circle is lost

    def __post_init__(self) -> None:
        if not self.min_radius_px >= 4:
            raise ValueError(f"min_radius_px: expected 4 px or more, got {self.min_radius_px:g}")
        if self.max_radius_px is not None and not self.max_radius_px > self.min_radius_px:
            raise ValueError(
                f"max_radius_px: expected more than min_radius_px ({self.min_radius_px:g}), got {self.max_radius_px:g}"
            )
        if not self.accelerations_px or min(self.accelerations_px) <= 0:
            raise ValueError(f"accelerations_px: expected positive numbers, got {self.accelerations_px}")


@dataclass(frozen=True, slots=True)
class Window:
    """A square of the picture around a predicted circle. The square may reach beyond the picture."""

    u_px: float  # centre of the square: the predicted centre
    v_px: float
    half_px: float  # half of its side
    gate_px: float  # largest distance of a centre from the predicted one
    min_radius_px: float
    max_radius_px: float


@dataclass(frozen=True, slots=True)
class CircleCandidate:
    """A coarse circle, accurate to a few pixels. Candidates are fitted to the rim afterwards."""

    u_px: float
    v_px: float
    radius_px: float
    score: float  # the larger the better, comparable within one call of a detector
    polarity: int = 0  # +1: brighter outside the rim, -1: brighter inside, 0: unknown


# A detector gets the picture and a window around the prediction, or None to search the whole picture. It returns its
# candidates, the best first; an empty sequence where it finds none.
CircleDetector: TypeAlias = Callable[[Picture, Window | None], Sequence[CircleCandidate]]


def crop_bounds(shape: tuple[int, ...], window: Window) -> tuple[int, int, int, int]:
    """Rows and columns (top, bottom, left, right) of a window inside a picture; empty where they do not meet."""
    height, width = shape[:2]
    top, left = int(np.floor(window.v_px - window.half_px)), int(np.floor(window.u_px - window.half_px))
    bottom, right = int(np.ceil(window.v_px + window.half_px)) + 1, int(np.ceil(window.u_px + window.half_px)) + 1
    top, left = min(max(top, 0), height), min(max(left, 0), width)
    return top, max(min(bottom, height), top), left, max(min(right, width), left)


# The improved Hough gradient method of Zhou (2014), section 2.3: edges vote for centres, then for radii.
#
# Departures from the print: the window and the 8 px gate are around the prediction, not around the last position, and
# the votes of a radius are divided by the circumference. Otherwise large circles win with the votes of clutter.

_STRONG_PERCENTILE, _STRONG_SHARE, _WEAK_SHARE = 98.0, 0.35, 0.4  # of Canny's thresholds, from the gradients themselves
_LEAST_GRADIENT = 24.0  # Sobel sum of a step of 6 DN in a picture stretched to 8 bits
_ALIGNED = 0.9  # least cosine between gradient and radius
_LEAST_SUPPORT = 0.15  # edge pixels per pixel of circumference
_VOTES_AT_ONCE = 300_000  # arrays that fit the processor's cache: all at once take eight times as long
_MOST_EDGES = 60_000  # pixels that vote; more are thinned evenly, since votes cost time and a rim has hundreds


@dataclass(frozen=True, slots=True)
class EdgePixels:
    """Edge pixels of a picture, n of them."""

    x: Array  # (n,) px
    y: Array  # (n,) px
    along_x: Array  # (n,) unit gradient, towards the brighter side
    along_y: Array

    def __len__(self) -> int:
        return len(self.x)


def edge_pixels(picture: Picture, blur_px: float) -> EdgePixels:
    """Edges by Gaussian filter, Sobel gradients and Canny's non-maximum suppression with hysteresis.

    The grey values are stretched to 8 bits and the thresholds follow from the gradients, so that neither the contrast
    nor the bit depth matters.
    """
    low, high = float(picture.min()), float(picture.max())
    scale = 255.0 / max(high - low, 32.0 if picture.dtype == np.uint8 else 512.0)
    stretched = cv2.convertScaleAbs(picture, alpha=scale, beta=-low * scale)
    smooth = cv2.GaussianBlur(stretched, (0, 0), blur_px)
    gx, gy = cv2.Sobel(smooth, cv2.CV_16S, 1, 0), cv2.Sobel(smooth, cv2.CV_16S, 0, 1)
    steps = max(1, picture.size // 40_000)  # a sample determines the percentile
    sample = np.hypot(gx.ravel()[::steps].astype(np.float32), gy.ravel()[::steps].astype(np.float32))
    strong = max(_LEAST_GRADIENT, _STRONG_SHARE * float(np.percentile(sample, _STRONG_PERCENTILE)))
    edges = cv2.Canny(gx, gy, _WEAK_SHARE * strong, strong, L2gradient=True)
    places = np.flatnonzero(edges)
    if len(places) > _MOST_EDGES:
        places = places[:: -(-len(places) // _MOST_EDGES)]
    dx, dy = gx.ravel()[places].astype(float), gy.ravel()[places].astype(float)
    length = np.maximum(np.hypot(dx, dy), 1e-9)
    rows, columns = np.divmod(places, picture.shape[1])
    return EdgePixels(columns.astype(float), rows.astype(float), dx / length, dy / length)


def centre_votes(
    edges: EdgePixels, radii_px: tuple[float, float], area: tuple[int, int, int, int], smooth: bool = True
) -> NDArray[np.float32]:
    """Votes (height, width) for centres along the gradients, in both directions.

    radii_px: smallest and largest distance of a centre from its edge. area: top, bottom, left, right of the cells, px.
    smooth: sums over 3 x 3 cells, since rounding distributes the votes for one centre over neighbours.
    """
    top, bottom, left, right = area
    height, width = bottom - top, right - left
    radii = np.arange(np.floor(radii_px[0]), np.ceil(radii_px[1]) + 1)
    radii = np.concatenate([radii, -radii]).astype(np.float32)[:, None]
    u, v, along_u, along_v = (a.astype(np.float32) for a in (edges.x, edges.y, edges.along_x, edges.along_y))
    votes = np.zeros(height * width, dtype=np.int64)
    for some in np.array_split(radii, len(radii) * len(edges) // _VOTES_AT_ONCE + 1):
        x, y = np.rint(u + some * along_u).astype(np.int32) - left, np.rint(v + some * along_v).astype(np.int32) - top
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        votes += np.bincount(y[inside] * width + x[inside], minlength=height * width)
    cells = votes.reshape(height, width).astype(np.float32)
    if not smooth:
        return cells
    return np.asarray(cv2.boxFilter(cells, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT), np.float32)


def centres(votes: NDArray[np.float32], most: int) -> tuple[Ints, Ints]:
    """Rows and columns of the best local maxima among eight neighbours, eq. (5), at most `most`, best first."""
    peaks = np.flatnonzero((votes >= cv2.dilate(votes, np.ones((3, 3), np.uint8))) & (votes > 0))
    values = votes.ravel()[peaks]
    if len(peaks) > 4 * most:
        keep = np.argpartition(-values, 4 * most)[: 4 * most]
        peaks, values = peaks[keep], values[keep]
    rows, columns = np.divmod(peaks[np.argsort(-values, kind="stable")][:most], votes.shape[1])
    return rows, columns


def radii_of(
    edges: EdgePixels, u_px: float, v_px: float, radii_px: tuple[float, float], most: int
) -> list[CircleCandidate]:
    """The best-supported radii about one centre, each with its polarity; votes per pixel of circumference."""
    dx, dy = edges.x - u_px, edges.y - v_px
    distance = np.hypot(dx, dy)
    radial = dx * edges.along_x + dy * edges.along_y
    near = (distance >= radii_px[0] - 1.5) & (distance <= radii_px[1] + 1.5) & (np.abs(radial) > _ALIGNED * distance)
    first = int(np.floor(radii_px[0])) - 1
    bins = int(np.ceil(radii_px[1])) - first + 2
    out = []
    for polarity in (1, -1):
        own = distance[near & (polarity * radial > 0)]
        counts = np.bincount(np.clip(np.rint(own).astype(int) - first, 0, bins - 1), minlength=bins).astype(float)
        support = np.convolve(counts, np.ones(3), "same") / (2 * np.pi * np.maximum(first + np.arange(bins), 1))
        peaks = np.flatnonzero((support[1:-1] >= support[:-2]) & (support[1:-1] > support[2:])) + 1
        for i in peaks[support[peaks] > _LEAST_SUPPORT].tolist():
            members = own[np.abs(own - (first + i)) <= 1.5]
            out.append(CircleCandidate(u_px, v_px, float(members.mean()), float(support[i]), polarity))
    return sorted(out, key=lambda c: -c.score)[:most]


# The classical detector: gradient votes in the window around a prediction, or in a pyramid of the whole picture.


_CENTRES_OF_WINDOW, _CENTRES_OF_LEVEL = 3, 12  # with the most votes, whose radii are sought
_RADII_OF_CENTRE = 3  # with the most support, of each: a drogue has an outer rim, an inner one and an opening
_LEAST_SIDE = 32  # px: smaller levels of the pyramid are not searched


def classical_detector(p: CircleParameters) -> CircleDetector:
    """The detector of Zhou (2014) in its corrected form; see `gradient_votes`."""

    def detect(picture: Picture, window: Window | None) -> list[CircleCandidate]:
        return whole_picture(picture, p) if window is None else in_window(picture, window, p)

    return detect


def in_window(picture: Picture, window: Window, p: CircleParameters) -> list[CircleCandidate]:
    """Candidates with a centre within the gate of the predicted one, best supported first."""
    top, bottom, left, right = crop_bounds(picture.shape, window)
    if min(bottom - top, right - left) < 8:
        return []
    edges = edge_pixels(picture[top:bottom, left:right], p.blur_px)
    if not len(edges):
        return []
    u, v, gate = window.u_px - left, window.v_px - top, window.gate_px
    low, high = np.floor([v - gate, u - gate]).astype(int) - 1, np.ceil([v + gate, u + gate]).astype(int) + 2
    area = (int(low[0]), int(high[0]), int(low[1]), int(high[1]))
    radii = (window.min_radius_px, window.max_radius_px)
    rows, columns = centres(centre_votes(edges, radii, area), 4 * _CENTRES_OF_WINDOW)
    places = zip((columns + area[2]).tolist(), (rows + area[0]).tolist(), strict=True)
    near = [(x, y) for x, y in places if np.hypot(x - u, y - v) < gate][:_CENTRES_OF_WINDOW]
    found = [c for x, y in near for c in radii_of(edges, x, y, radii, _RADII_OF_CENTRE)]
    moved = [replace(c, u_px=c.u_px + left, v_px=c.v_px + top) for c in found]
    return sorted(moved, key=lambda c: -c.score)


def whole_picture(picture: Picture, p: CircleParameters) -> list[CircleCandidate]:
    """Candidates anywhere in the picture, best supported first.

    Every level of the pyramid is searched for circles of the same radii in its own pixels, an octave each: the cost is
    4/3 of that of the first level. Centres outside the picture are not searched.
    """
    largest = p.max_radius_px or 0.5 * min(picture.shape[:2])
    scale = 1
    level: Picture = picture
    out: list[CircleCandidate] = []
    band = p.min_radius_px
    while band * scale <= largest and min(level.shape[:2]) >= _LEAST_SIDE:
        top = min(2 * band, largest / scale)
        edges = edge_pixels(level, p.blur_px)
        if len(edges):
            area = (0, level.shape[0], 0, level.shape[1])
            for row, column in zip(*centres(centre_votes(edges, (band, top), area), _CENTRES_OF_LEVEL), strict=True):
                for c in radii_of(edges, float(column), float(row), (band, top), _RADII_OF_CENTRE):
                    away = 0.5 * (scale - 1)  # the centre of the first pixel of a level, in pixels of the picture
                    u, v = c.u_px * scale + away, c.v_px * scale + away
                    out.append(replace(c, u_px=u, v_px=v, radius_px=c.radius_px * scale))
        scale *= 2
        level = _reduced(picture, scale)
    return sorted(out, key=lambda c: -c.score)


def _reduced(picture: Picture, scale: int) -> Picture:
    """The picture with a side of 1 / scale, means of blocks."""
    smaller = np.asarray(cv2.resize(picture, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA))
    return smaller.astype(np.uint8) if picture.dtype == np.uint8 else smaller.astype(np.uint16)
