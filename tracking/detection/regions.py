"""Boxes of a picture that are searched, and the spots that are returned.

In a region only what lies in it, or near it, is measured: the cost follows the region, not what is bright elsewhere.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compilation.jit import compiled
from tracking.detection import ellipse
from tracking.detection.search import RADIUS
from tracking.detection.table import (
    ACCEPTED,
    ACTIVE,
    CHI2,
    COV_UV,
    FLUX,
    MISFIT,
    PEAK,
    UU,
    UV,
    VAR_U,
    VAR_V,
    VV,
    U,
    V,
)  # fmt: skip
from tracking.noise import BLOCK

NARROWER = 0.5  # a spot narrower than this share of another spot is not a duplicate of it
_SAME_SPOT = 1.5  # sigmas of a brighter spot: a second spot nearer to its centre is a duplicate
MARGIN = 16  # px: largest distance of a peak from its spot's centre
EVERYWHERE = np.array([[0.0, 0.0, 1e9]])


def margin_of(regions: Array) -> Array:
    """(n,) px: how far around regions (n, 3) peaks are measured: those of their spots, and of others beside those."""
    return np.asarray(np.maximum(regions[:, 2], MARGIN))


@compiled
def boxes_of(regions: Array, width: int, height: int, boxes: Ints) -> int:
    """The blocks (n, 4: first row, last, first column, last) of regions (n, 3: u, v, half size, px) and around them.

    A peak is compared with brighter ones up to RADIUS from it.
    """
    count = 0
    for k in range(regions.shape[0]):
        u, v, half = regions[k, 0], regions[k, 1], regions[k, 2]
        if half >= 0.0 and half < np.inf and abs(u) < np.inf and abs(v) < np.inf:  # false for nan
            count = _add_box(u, v, half + max(half, MARGIN) + RADIUS, width, height, boxes, count)
    return count


@compiled
def _add_box(u: float, v: float, half: float, width: int, height: int, boxes: Ints, count: int) -> int:
    left, right = max(u - half, 0.0), min(u + half, width - 1.0)
    top, bottom = max(v - half, 0.0), min(v + half, height - 1.0)
    if left <= right and top <= bottom:
        boxes[count, 0], boxes[count, 1] = int(top) // BLOCK, int(bottom) // BLOCK
        boxes[count, 2], boxes[count, 3] = int(left) // BLOCK, int(right) // BLOCK
        count += 1
    return count


@compiled
def in_a_region(regions: Array, u: float, v: float, more: float) -> bool:
    """Whether a point lies in a region (n, 3), grown by `more` px."""
    for k in range(regions.shape[0]):
        half = regions[k, 2] + more
        if abs(u - regions[k, 0]) <= half and abs(v - regions[k, 1]) <= half:
            return True
    return False


@compiled
def brightest(table: Array) -> int:
    """The row with the largest flux among the ACTIVE ones; -1 if there is none."""
    best = -1
    for k in range(table.shape[0]):
        if table[k, ACTIVE] and (best < 0 or table[k, FLUX] > table[best, FLUX]):
            best = k
    return best


@compiled
def drop_duplicates(table: Array) -> None:
    """Drop spots near the centre of a brighter spot of about the same width: one light detected twice.

    A much narrower spot is kept: a laser spot on a wide diffuse reflection has less flux, but is not part of it.
    """
    for k in range(table.shape[0]):
        table[k, ACTIVE] = table[k, ACCEPTED]
    i = brightest(table)
    while i >= 0:
        spot = table[i]
        spot[ACTIVE] = 0.0
        uu, uv, vv = spot[UU] + 1 / 12, spot[UV], spot[VV] + 1 / 12
        area = uu * vv - uv * uv  # sigma^4, px^4
        for k in range(table.shape[0]):
            other = table[k]
            if other[ACTIVE]:
                du, dv = other[U] - spot[U], other[V] - spot[V]
                inside = vv * du * du - 2 * uv * du * dv + uu * dv * dv < _SAME_SPOT**2 * area
                own = (other[UU] + 1 / 12) * (other[VV] + 1 / 12) - other[UV] ** 2
                if inside and own > NARROWER**4 * area:
                    other[ACCEPTED] = other[ACTIVE] = 0.0
        i = brightest(table)


@compiled
def write_detections(table: Array, regions: Array, out: Array) -> int:
    """Write the spots that lie in a region (n, 3) into `out`, largest flux first; returns their number.

    Columns of out (most, 12): u, v; cov uu, uv, vv; flux, peak, major, minor, angle; share of the covariance by misfit;
    chi-square.
    """
    for k in range(table.shape[0]):
        found = table[k, ACCEPTED] and in_a_region(regions, table[k, U], table[k, V], 0.0)
        table[k, ACTIVE] = 1.0 if found else 0.0
    count = 0
    i = brightest(table)
    while i >= 0:
        spot, row = table[i], out[count]
        spot[ACTIVE] = 0.0
        row[0], row[1], row[2], row[3] = spot[U], spot[V], spot[VAR_U], spot[COV_UV]
        row[4], row[5], row[6] = spot[VAR_V], spot[FLUX], spot[PEAK]
        row[7], row[8], row[9] = ellipse.axes(spot[UU], spot[UV], spot[VV])
        row[10], row[11] = spot[MISFIT], spot[CHI2]
        count += 1
        i = brightest(table)
    return count
