"""By how much the centre of a spot's light lies beside the image of the beam's axis.

A beam leaves a symmetric ellipse of light on its screen, with the axis in the middle. Perspective and distortion map
the two sides of the ellipse unequally, so that a symmetric profile fitted in the picture has another centre: .01 to .05
px for spots of 3 to 5 px on an oblique screen, growing with the square of the width. The same effect as with the image
of a circle's centre (Heikkila & Silven, CVPR 1997, 3.1), here for a Gaussian and a weighted fit. Ours.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from geometry.arrays import Array, Bools
from geometry.camera import Camera
from geometry.planes import meet_plane
from geometry.rig import Screen

_WINDOW = 3.7  # sigmas from centre to side of the window of a fit: 3.2 along the major axis, more across it
_STEP = 0.5  # sigmas of the spot: of the differences that give the map's curvature
_LARGEST_SHARE = 0.25  # of the spot's sigma: a larger offset means that the second order is not enough

# In spot sigmas: the centre, one step along each axis, and the four diagonal ones.
_STENCIL = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1], [1, -1], [-1, 1]], dtype=float)


def centre_offsets(camera: Camera, screen: Screen, uv_px: Array, shape_px2: Array, brightness: Array) -> Array:
    """Fitted centres less the images of the beams' axes (n, 2), px; 0 where the screen is not met.

    uv_px (n, 2): centres of the light, distorted pixels. shape_px2 (n, 3): uu, uv, vv of the Gaussians in the picture.
    brightness (n,): shot noise over background noise, in variance, at the peak, which says how much the wings weigh.
    The screen is taken to be flat over a spot, and matt: it looks equally bright from everywhere.
    """
    n = len(uv_px)
    if n == 0:
        return np.zeros((0, 2))
    covariance = shape_px2[:, [0, 1, 1, 2]].reshape(n, 2, 2)
    L = np.linalg.cholesky(covariance + 1e-9 * np.eye(2))
    pixels = uv_px[:, None] + _STEP * np.einsum("nij,sj->nsi", L, _STENCIL)
    origin, direction = camera.rays(pixels)
    s = meet_plane(origin, direction, screen.world_from_screen)  # (n, 9, 2), m
    # s(g) = s0 + M g + N_11 g1^2 / 2 + N_12 g1 g2 + N_22 g2^2 / 2, g in sigmas of the spot in the picture.
    M = np.stack([s[:, 1] - s[:, 2], s[:, 3] - s[:, 4]], axis=-1) / (2 * _STEP)
    N11 = (s[:, 1] - 2 * s[:, 0] + s[:, 2]) / _STEP**2
    N22 = (s[:, 3] - 2 * s[:, 0] + s[:, 4]) / _STEP**2
    N12 = (s[:, 5] + s[:, 6] - s[:, 7] - s[:, 8]) / (4 * _STEP**2)
    good: Bools = np.asarray(np.isfinite(s).all(axis=(1, 2)))
    curvature: Array = np.where(good[:, None, None], 0.5 * np.stack([N11, N12, N22], axis=-1), 0.0)
    P: Array = np.linalg.solve(np.where(good[:, None, None], M, np.eye(2)).astype(float), curvature)
    # The exponent is -|M^-1 (s - s0)|^2 / 2 = -|g|^2 / 2 - g . (P_11 g1^2 + 2 P_12 g1 g2 + P_22 g2^2).
    cube1, cube2 = -P[:, 0, 0], -P[:, 1, 2]
    mixed1, mixed2 = -(P[:, 0, 2] + 2 * P[:, 1, 1]), -(P[:, 1, 0] + 2 * P[:, 0, 1])  # of g1 g2^2 and g1^2 g2
    a, b = np.array([_moved_by(float(r)) for r in brightness]).T
    g = np.stack([a * cube1 + b * mixed1, a * cube2 + b * mixed2], axis=-1)
    length = np.linalg.norm(g, axis=-1, keepdims=True)
    g = g * np.minimum(1.0, _LARGEST_SHARE / np.maximum(length, 1e-12))
    return np.asarray(np.einsum("nij,nj->ni", L, g))


def _moved_by(brightness: float) -> tuple[float, float]:
    """Centre's shift, sigmas, of a unit Gaussian that is fitted with g1^3 and with g1 g2^2 times itself added to it."""
    steps = 0 if not np.isfinite(brightness) or brightness <= 0 else round(2 * np.log2(1 + brightness))
    return _fitted(min(max(steps, 0), 24))


@lru_cache(maxsize=32)
def _fitted(half_octaves: int) -> tuple[float, float]:
    """As `_moved_by`, for brightness 2^(half_octaves / 2) - 1; the background's slopes are fitted along."""
    g = np.linspace(-_WINDOW, _WINDOW, 81)
    g1, g2 = (x.ravel() for x in np.meshgrid(g, g))
    light = np.exp(-0.5 * (g1**2 + g2**2))
    weight = 1 / (1 + (2.0 ** (half_octaves / 2) - 1) * light)
    A = np.stack([g1 * light, g1])  # the derivatives with respect to the centre and to the background's slope
    normal = (A * weight) @ A.T
    shifts = np.linalg.solve(normal, (A * weight) @ np.stack([g1**3 * light, g1 * g2**2 * light], axis=-1))[0]
    return float(shifts[0]), float(shifts[1])
