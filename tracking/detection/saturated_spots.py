"""Bright compact things that no Gaussian fits: burnt-out cores with rings, spots beside an edge of the screen."""

from __future__ import annotations

from math import cos, pi, sin, sqrt

import numpy as np

from geometry.arrays import Array
from geometry.compilation.jit import compiled
from tracking.detection import ellipse
from tracking.detection.candidates import Noise, sort, variance
from tracking.detection.pixels import Pixels, pixel

_RADII = (0.4, 0.8, 2.4, 2.8, 3.2)  # sigmas of the moments' ellipse: two in the core, three in the ring
CENTRE_SHARE = 0.15  # of the ellipse's sigma: how far such a thing's moments may lie from the beam's centre. On the
# three burnt-out laser spots of the real pictures the moments and the middle of the core differ by 0.05 to 0.15
_STANDS_OUT = 1.5  # times the detection threshold: the second opinion of a fit is missing


@compiled
def height_of_compact(
    image: Pixels, u: float, v: float, shape: tuple[float, float, float], noise: Noise, threshold_sigma: float,
    few: Array,
) -> float:  # fmt: skip
    """Height, DN, of the core over the ring, of an ellipse (px^2) that holds light that falls off on all sides; else 0.

    The core must stand out of the ring around it, and in each of eight directions by at least half as much as in
    the median one: edges, corners and ridges do not. few (32,) is room to work in. Ours.
    """
    uu, uv, vv = ellipse.with_eigenvalues(shape[0], shape[1], shape[2], 0.1, np.inf)
    l11 = sqrt(uu)
    l21 = uv / l11
    l22 = sqrt(vv - l21 * l21)
    highest = -np.inf
    for octant in range(8):
        p, q = cos(octant * pi / 4), sin(octant * pi / 4)
        ring = few[21:24]
        for k in range(5):
            column = int(np.rint(u + _RADII[k] * l11 * p))
            row = int(np.rint(v + _RADII[k] * (l21 * p + l22 * q)))
            if column < 0 or row < 0 or column >= image.width or row >= image.height:
                return 0.0
            if k < 2:
                few[2 * octant + k] = pixel(image, column, row)
            else:
                ring[k - 2] = pixel(image, column, row)
        sort(ring, 3)
        few[24 + octant] = ring[1]
        highest = max(highest, ring[1])
    sort(few[:16], 16)
    sort(few[24:32], 8)
    core, ground = 0.5 * (few[7] + few[8]), 0.5 * (few[27] + few[28])
    above = core - ground
    if core - highest < 0.5 * above or above <= _STANDS_OUT * threshold_sigma * sqrt(variance(noise, ground)):
        return 0.0
    return above
