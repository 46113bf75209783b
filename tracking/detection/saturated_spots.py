"""Bright compact spots that are not Gaussian: saturated cores with rings, spots beside an edge of the screen."""

from __future__ import annotations

from math import cos, pi, sin, sqrt

import numpy as np

from geometry.arrays import Array
from geometry.compilation.jit import compiled
from tracking.detection import ellipse
from tracking.detection.pixels import Noise, Pixels, insertion_sort, pixel, texture_variance, variance

_RADII = (0.4, 0.8, 2.4, 2.8, 3.2)  # sigmas of the moments' ellipse: two in the core, three in the ring
# Error of the centre relative to the ellipse's sigma. On the three saturated laser spots of the real pictures the
# moments and the middle of the core differ by 0.05 to 0.15.
CENTRE_SHARE = 0.15
_THRESHOLD_FACTOR = 1.5  # factor on the noise in the detection threshold, because no fit confirms the spot

# Share of the texture's sigma in it: the light falls off in all directions, which most grains of texture do not.
_OF_TEXTURE = 0.7


@compiled
def compact_height(
    image: Pixels, u: float, v: float, shape: tuple[float, float, float], noise: Noise, threshold_sigma: float,
    scratch: Array,
) -> float:  # fmt: skip
    """Height, DN, of a compact core above the ring around it; 0 if the light does not fall off in all directions.

    shape: the ellipse, px^2. The core must exceed the ring around it in each of eight directions by at least half the
    median excess, which excludes edges, corners and ridges. scratch (32,) is workspace. Source: ours.
    """
    uu, uv, vv = ellipse.clip_eigenvalues(shape[0], shape[1], shape[2], 0.1, np.inf)
    l11 = sqrt(uu)
    l21 = uv / l11
    l22 = sqrt(vv - l21 * l21)
    highest = -np.inf
    for octant in range(8):
        p, q = cos(octant * pi / 4), sin(octant * pi / 4)
        ring = scratch[21:24]
        for k in range(5):
            column = int(np.rint(u + _RADII[k] * l11 * p))
            row = int(np.rint(v + _RADII[k] * (l21 * p + l22 * q)))
            if column < 0 or row < 0 or column >= image.width or row >= image.height:
                return 0.0
            if k < 2:
                scratch[2 * octant + k] = pixel(image, column, row)
            else:
                ring[k - 2] = pixel(image, column, row)
        insertion_sort(ring, 3)
        scratch[24 + octant] = ring[1]
        highest = max(highest, ring[1])
    insertion_sort(scratch[:16], 16)
    insertion_sort(scratch[24:32], 8)
    core, background = 0.5 * (scratch[7] + scratch[8]), 0.5 * (scratch[27] + scratch[28])
    above = core - background
    sigma2 = _THRESHOLD_FACTOR**2 * variance(noise, background) + _OF_TEXTURE**2 * texture_variance(noise, background)
    if core - highest < 0.5 * above or above <= threshold_sigma * sqrt(sigma2):
        return 0.0
    return above
