"""Boxes of a picture that are searched, and the spots that are returned.

In a region only what lies in it, or near it, is measured: the cost follows the region, not what is bright elsewhere.
"""

from __future__ import annotations

from math import pi, sqrt

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compilation.jit import compiled
from tracking.detection import ellipse
from tracking.detection.search import RADIUS
from tracking.detection.table import Candidates
from tracking.noise import BLOCK

NARROWER = 0.5  # a spot narrower than this share of another spot is not a duplicate of it
_SAME_SPOT = 1.5  # sigmas of a brighter spot: a second spot nearer to its centre is a duplicate
MARGIN = 16  # px: largest distance of a peak from its spot's centre
EVERYWHERE = np.array([[0.0, 0.0, 1e9]])  # a region (u, v, radius), px


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
def brightest(table: Candidates) -> int:
    """The row with the largest flux among the active ones; -1 if there is none."""
    best = -1
    for k in range(table.shape[0]):
        if table[k]["active"] and (best < 0 or table[k]["flux"] > table[best]["flux"]):
            best = k
    return best


@compiled
def drop_duplicates(table: Candidates) -> None:
    """Drop spots near the centre of a brighter spot of about the same width: one light detected twice.

    A much narrower spot is kept: a laser spot on a wide diffuse reflection has less flux, but is not part of it.
    """
    for k in range(table.shape[0]):
        table[k]["active"] = table[k]["accepted"]
    i = brightest(table)
    while i >= 0:
        spot = table[i]
        spot["active"] = 0.0
        uu, uv, vv = spot["uu"] + 1 / 12, spot["uv"], spot["vv"] + 1 / 12
        area = uu * vv - uv * uv  # sigma^4, px^4
        for k in range(table.shape[0]):
            other = table[k]
            if other["active"]:
                du, dv = other["u"] - spot["u"], other["v"] - spot["v"]
                inside = vv * du * du - 2 * uv * du * dv + uu * dv * dv < _SAME_SPOT**2 * area
                own = (other["uu"] + 1 / 12) * (other["vv"] + 1 / 12) - other["uv"] ** 2
                if inside and own > NARROWER**4 * area:
                    other["accepted"] = other["active"] = 0.0
        i = brightest(table)


@compiled
def write_detections(table: Candidates, regions: Array, out: Array) -> int:
    """Write the spots that lie in a region (n, 3) into `out`, largest flux first; returns their number.

    Columns of out (most, 13): u, v; cov uu, uv, vv; flux, peak, major, minor, angle; share of the covariance by misfit;
    chi-square; rms of the residuals over the height of the Gaussian.
    """
    for k in range(table.shape[0]):
        found = table[k]["accepted"] and in_a_region(regions, table[k]["u"], table[k]["v"], 0.0)
        table[k]["active"] = 1.0 if found else 0.0
    count = 0
    i = brightest(table)
    while i >= 0:
        spot, row = table[i], out[count]
        spot["active"] = 0.0
        row[0], row[1], row[2], row[3] = spot["u"], spot["v"], spot["var_u"], spot["cov_uv"]
        row[4], row[5], row[6] = spot["var_v"], spot["flux"], spot["peak"]
        row[7], row[8], row[9] = ellipse.axes(spot["uu"], spot["uv"], spot["vv"])
        row[10], row[11] = spot["misfit"], spot["chi2"]
        # The gain is the sum of the squared light over that of a pixel's noise, which the height follows from.
        row[12] = sqrt(spot["chi2"] * pi * row[7] * row[8] / max(spot["gain"], 1e-9))
        count += 1
        i = brightest(table)
    return count
