"""Offset of the fitted centre of a spot's light from the image of the beam's axis.

A beam leaves a symmetric ellipse of light on its screen, centred on the axis. Perspective and distortion map the two
sides of the ellipse unequally, so that a symmetric profile fitted in the picture has another centre: 0.01 to 0.05 px
off for spots of 3 to 5 px on an oblique screen, growing with the square of the width. The effect is that of the image
of a circle's centre (Heikkila & Silven, CVPR 1997, section 3.1), here for a Gaussian and a weighted fit. Source: ours.
"""

from __future__ import annotations

from functools import lru_cache
from math import sqrt

import numpy as np

from geometry.arrays import Array, Bools
from geometry.camera import Camera
from geometry.compilation.jit import compiled
from geometry.planes import intersect_plane
from geometry.rig import Screen

_WINDOW = 3.7  # half width of a fit's window in sigmas: 3.2 along the major axis, more across it
_STEP_PX = 4.0  # step of the differences that give the curvature of the map
_NODES = 33  # points along each side of the picture at which the curvature is computed; it varies slowly
_CLIP_STEPS = 6  # per octave, of the height at which the top of a spot is clipped
_MAX_SHARE = 0.25  # largest offset in sigmas of the spot: a larger one means that the second order does not suffice

# In steps: the centre, the two neighbours along each axis, and the four diagonal ones.
_STENCIL = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1], [1, -1], [-1, 1]], dtype=float)


class CentroidOffsets:
    """Offsets in the pictures that one camera takes of one screen.

    The screen is assumed to be flat over a spot, and matt: equally bright from all directions.
    """

    def __init__(self, camera: Camera, screen: Screen) -> None:
        width, height = camera.image_size_px
        self._size = np.array([width - 1.0, height - 1.0])
        u, v = (np.linspace(0.0, end, _NODES) for end in self._size)
        nodes = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)
        self._curvature = map_curvature(camera, screen, nodes)  # (_NODES, _NODES, 2, 3)

    def at(self, uv_px: Array, shape_px2: Array, brightness: Array, clip: Array) -> Array:
        """Fitted centres minus the images of the beams' axes (n, 2), px; 0 where the ray misses the screen.

        uv_px (n, 2): centres of the light, distorted pixels. shape_px2 (n, 3): uu, uv, vv of the Gaussians in the
        picture. brightness (n,): variance of the shot noise at the peak over that of the background noise; the brighter
        a spot, the more weight its wings have in the fit. clip (n,): height at which the sensor clips over that of the
        Gaussian, 1 and more for whole spots; the fit leaves out what is clipped, and the wings are shifted farther.
        """
        shifts = _centre_shifts(np.asarray(brightness, float), np.asarray(clip, float))
        return _offsets(self._curvature, self._size, np.ascontiguousarray(uv_px), shape_px2, shifts)


@compiled
def _offsets(curvature: Array, size: Array, uv_px: Array, shape_px2: Array, shifts: Array) -> Array:
    """`CentroidOffsets.at`; curvature (_NODES, _NODES, 2, 3), size (2,), shifts (n, 2) from `_centre_shifts`."""
    out = np.zeros((uv_px.shape[0], 2))
    T = np.empty((2, 3))
    for k in range(uv_px.shape[0]):
        _interpolate(curvature, size, uv_px[k], T)
        # L is the Cholesky factor of a shape, g = L^-1 x are coordinates in sigmas of the spot.
        l11 = sqrt(max(shape_px2[k, 0], 1e-9))
        l21 = shape_px2[k, 1] / l11
        l22 = sqrt(max(shape_px2[k, 2] - l21 * l21, 1e-9))
        first, second = np.empty(3), np.empty(3)
        for c in range(2):
            t11 = T[c, 0] * (l11 * l11) + 2 * T[c, 1] * (l11 * l21) + T[c, 2] * (l21 * l21)
            t12, t22 = T[c, 1] * (l11 * l22) + T[c, 2] * (l21 * l22), T[c, 2] * (l22 * l22)
            row = first if c == 0 else second
            row[0], row[1], row[2] = t11, t12, t22
        for q in range(3):
            first[q] /= l11
            second[q] = (second[q] - l21 * first[q]) / l22
        # The exponent is -|g + P(g, g)|^2 / 2 = -|g|^2 / 2 - g . (P_11 g1^2 + 2 P_12 g1 g2 + P_22 g2^2) + ...
        cube1, cube2 = -first[0], -second[2]
        mixed1 = -(first[2] + 2 * second[1])  # of g1 g2^2
        mixed2 = -(second[0] + 2 * first[1])  # of g1^2 g2
        g1, g2 = shifts[k, 0] * cube1 + shifts[k, 1] * mixed1, shifts[k, 0] * cube2 + shifts[k, 1] * mixed2
        kept = min(1.0, _MAX_SHARE / max(np.hypot(g1, g2), 1e-12))
        out[k, 0], out[k, 1] = l11 * g1 * kept, (l21 * g1 + l22 * g2) * kept
    return out


@compiled
def _interpolate(curvature: Array, size: Array, uv: Array, out: Array) -> None:
    """The curvature (2, 3) at a pixel (2,), bilinear between the nodes, into `out`."""
    at_u = min(max(uv[0] / size[0], 0.0), 1.0) * (_NODES - 1)
    at_v = min(max(uv[1] / size[1], 0.0), 1.0) * (_NODES - 1)
    i = min(int(at_u), _NODES - 2) if at_u >= 0.0 else 0  # for nan the result is nan
    j = min(int(at_v), _NODES - 2) if at_v >= 0.0 else 0
    x, y = at_u - i, at_v - j
    for a in range(2):
        for b in range(3):
            low = (1 - y) * curvature[i, j, a, b] + y * curvature[i, j + 1, a, b]
            high = (1 - y) * curvature[i + 1, j, a, b] + y * curvature[i + 1, j + 1, a, b]
            out[a, b] = (1 - x) * low + x * high


def map_curvature(camera: Camera, screen: Screen, uv_px: Array) -> Array:
    """The quadratic terms T (..., 2, 3: uu, uv, vv), 1/px, of the map from the picture to the screen.

    s(u + x) = s(u) + J (x + T(x, x)): half of the second derivatives, in pixels. 0 where a ray misses the screen.
    """
    origin, direction = camera.rays(uv_px[..., None, :] + _STEP_PX * _STENCIL)
    s = intersect_plane(origin, direction, screen.world_from_screen)  # (..., 9, 2), m
    at = np.moveaxis(s, -2, 0)
    J = np.stack([at[1] - at[2], at[3] - at[4]], axis=-1) / (2 * _STEP_PX)
    uu = (at[1] - 2 * at[0] + at[2]) / _STEP_PX**2
    vv = (at[3] - 2 * at[0] + at[4]) / _STEP_PX**2
    uv = (at[5] + at[6] - at[7] - at[8]) / (4 * _STEP_PX**2)
    good: Bools = np.asarray(np.isfinite(s).all(axis=(-1, -2)))[..., None, None]
    curvature: Array = np.where(good, 0.5 * np.stack([uu, uv, vv], axis=-1), 0.0)
    return np.asarray(np.linalg.solve(np.where(good, J, np.eye(2)).astype(float), curvature))


def _centre_shifts(brightness: Array, clip: Array) -> Array:
    """Shifts (n, 2), in sigmas, of the fitted centre of a unit Gaussian G to which g1^3 G, or g1 g2^2 G, is added."""
    bright = np.where(np.isfinite(brightness), np.maximum(brightness, 0.0), 0.0)
    steps = np.minimum(np.rint(2 * np.log2(1 + bright)), 24)
    whole = np.where((clip > 0) & (clip < 1), clip, 1.0)
    clipped = np.minimum(np.rint(-_CLIP_STEPS * np.log2(whole)), 4 * _CLIP_STEPS)
    shifts = [_fitted_shifts(int(s), int(c)) for s, c in zip(steps.tolist(), clipped.tolist(), strict=True)]
    return np.array(shifts).reshape(-1, 2)


@lru_cache(maxsize=512)
def _fitted_shifts(half_octaves: int, clip_steps: int) -> tuple[float, float]:
    """As `_centre_shifts`, for the brightness 2^(half_octaves / 2) - 1; the slope of the background is fitted too.

    The Gaussian is clipped at 2^(-clip_steps / _CLIP_STEPS) of its height.
    """
    g = np.linspace(-_WINDOW, _WINDOW, 81)
    g1, g2 = (x.ravel() for x in np.meshgrid(g, g))
    light = np.exp(-0.5 * (g1**2 + g2**2))
    weight = 1 / (1 + (2.0 ** (half_octaves / 2) - 1) * light)
    if clip_steps:
        weight *= light < 2.0 ** (-clip_steps / _CLIP_STEPS)
    A = np.stack([g1 * light, g1])  # the derivatives with respect to the centre and to the background's slope
    normal = (A * weight) @ A.T
    shifts = np.linalg.solve(normal, (A * weight) @ np.stack([g1**3 * light, g1 * g2**2 * light], axis=-1))[0]
    return float(shifts[0]), float(shifts[1])
