"""Offset of the fitted centre of a spot's light from the image of the beam's axis.

A beam leaves a symmetric ellipse of light on its screen, centred on the axis. Perspective and distortion map the two
sides of the ellipse unequally, so that a symmetric profile fitted in the picture has another centre: 0.01 to 0.05 px
off for spots of 3 to 5 px on an oblique screen, growing with the square of the width. The effect is that of the image
of a circle's centre (Heikkila & Silven, CVPR 1997, section 3.1), here for a Gaussian and a weighted fit. Source: ours.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from geometry.arrays import Array, Bools
from geometry.camera import Camera
from geometry.planes import intersect_plane
from geometry.rig import Screen

_WINDOW = 3.7  # half width of a fit's window in sigmas: 3.2 along the major axis, more across it
_STEP_PX = 4.0  # step of the differences that give the curvature of the map
_NODES = 33  # points along each side of the picture at which the curvature is computed; it varies slowly
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
        self._curvature = _curvature(camera, screen, nodes)  # (_NODES, _NODES, 2, 3)

    def at(self, uv_px: Array, shape_px2: Array, brightness: Array) -> Array:
        """Fitted centres minus the images of the beams' axes (n, 2), px; 0 where the ray misses the screen.

        uv_px (n, 2): centres of the light, distorted pixels. shape_px2 (n, 3): uu, uv, vv of the Gaussians in the
        picture. brightness (n,): variance of the shot noise at the peak over that of the background noise; the brighter
        a spot, the more weight its wings have in the fit.
        """
        n = len(uv_px)
        if n == 0:
            return np.zeros((0, 2))
        T = self._interpolated(uv_px)
        # L is the Cholesky factor of a shape, g = L^-1 x are coordinates in sigmas of the spot.
        l11 = np.sqrt(np.maximum(shape_px2[:, 0], 1e-9))
        l21 = shape_px2[:, 1] / l11
        l22 = np.sqrt(np.maximum(shape_px2[:, 2] - l21**2, 1e-9))
        t11 = T[..., 0] * (l11**2)[:, None] + 2 * T[..., 1] * (l11 * l21)[:, None] + T[..., 2] * (l21**2)[:, None]
        t12 = T[..., 1] * (l11 * l22)[:, None] + T[..., 2] * (l21 * l22)[:, None]
        t22 = T[..., 2] * (l22**2)[:, None]
        P1 = np.stack([t11[:, 0], t12[:, 0], t22[:, 0]]) / l11
        P2 = (np.stack([t11[:, 1], t12[:, 1], t22[:, 1]]) - l21 * P1) / l22
        # The exponent is -|g + P(g, g)|^2 / 2 = -|g|^2 / 2 - g . (P_11 g1^2 + 2 P_12 g1 g2 + P_22 g2^2) + ...
        cube1, cube2 = -P1[0], -P2[2]
        mixed1, mixed2 = -(P1[2] + 2 * P2[1]), -(P2[0] + 2 * P1[1])  # of g1 g2^2 and g1^2 g2
        a, b = np.array([_centre_shifts(float(r)) for r in brightness]).T
        g1, g2 = a * cube1 + b * mixed1, a * cube2 + b * mixed2
        kept = np.minimum(1.0, _MAX_SHARE / np.maximum(np.hypot(g1, g2), 1e-12))
        return np.asarray(np.stack([l11 * g1, l21 * g1 + l22 * g2], axis=-1) * kept[:, None])

    def _interpolated(self, uv_px: Array) -> Array:
        """The curvature (n, 2, 3) at pixels (n, 2), bilinear between the nodes."""
        place = np.clip(uv_px / self._size, 0.0, 1.0) * (_NODES - 1)
        first = np.minimum(place.astype(np.int64), _NODES - 2)
        i, j = first.T
        x, y = (place - first).T[:, :, None, None]
        C = self._curvature
        return (1 - x) * ((1 - y) * C[i, j] + y * C[i, j + 1]) + x * ((1 - y) * C[i + 1, j] + y * C[i + 1, j + 1])


def _curvature(camera: Camera, screen: Screen, uv_px: Array) -> Array:
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


def _centre_shifts(brightness: float) -> tuple[float, float]:
    """Shifts, in sigmas, of the fitted centre of a unit Gaussian G to which g1^3 G, or g1 g2^2 G, is added."""
    steps = 0 if not np.isfinite(brightness) or brightness <= 0 else round(2 * np.log2(1 + brightness))
    return _fitted_shifts(min(max(steps, 0), 24))


@lru_cache(maxsize=32)
def _fitted_shifts(half_octaves: int) -> tuple[float, float]:
    """As `_centre_shifts`, for the brightness 2^(half_octaves / 2) - 1; the slope of the background is fitted too."""

    g = np.linspace(-_WINDOW, _WINDOW, 81)
    g1, g2 = (x.ravel() for x in np.meshgrid(g, g))
    light = np.exp(-0.5 * (g1**2 + g2**2))
    weight = 1 / (1 + (2.0 ** (half_octaves / 2) - 1) * light)
    A = np.stack([g1 * light, g1])  # the derivatives with respect to the centre and to the background's slope
    normal = (A * weight) @ A.T
    shifts = np.linalg.solve(normal, (A * weight) @ np.stack([g1**3 * light, g1 * g2**2 * light], axis=-1))[0]
    return float(shifts[0]), float(shifts[1])
