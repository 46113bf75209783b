"""The light of one beam in the picture of a camera: intersection with the screen, lens, integration over pixels.

The irradiance is evaluated on the screen from the geometry of the beam, so that a divergent beam on an oblique screen
gives an asymmetric spot with its centroid beside the axis. The true position is the image of the axis (projection.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from bench.random_pictures.sensors import Light
from bench.random_scenes.projection import camera_pixels
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.rig import Screen

REACH = 5.0  # sigmas, beyond which the light of a spot is neglected: 4e-6 of its peak
_ORDER = 5  # of the polynomial from pixels to the screen, over one patch
_NODES = 9  # points per side for its fit
MOST_SAMPLES = 32  # per pixel and axis: beams down to a sigma of 0.022 px
HALO_WIDTH = 4.0  # of the halo's sigma over the beam's


@dataclass(frozen=True, slots=True)
class BeamShape:
    """Cross-section of a beam: along it the size grows as that of a Gaussian beam."""

    sigma_m: float  # at the waist, of the major axis
    divergence: float  # sigma per m, far away
    ratio: float = 1.0  # minor axis over major axis
    turn_rad: float = 0.0  # of the major axis about the beam
    flat: int = 1  # exponent: 1 Gaussian, 2 and 3 flat top
    halo: float = 0.0  # share of the peak

    def sigma_at(self, along_m: Array) -> Array:
        """Major sigma, m, at a distance from the waist."""
        return np.asarray(np.hypot(self.sigma_m, self.divergence * along_m))

    def irradiance(self, across_1: Array, across_2: Array, along_m: Array) -> Array:
        """Relative to the axis at the waist; across, along in m, any shape. Power is independent of distance."""
        sigma = self.sigma_at(along_m)
        c, s = np.cos(self.turn_rad), np.sin(self.turn_rad)
        p = (c * across_1 + s * across_2) / sigma
        q = (c * across_2 - s * across_1) / (sigma * self.ratio)
        half = (p**2 + q**2) / 2
        profile = np.exp(-half if self.flat == 1 else -(half**self.flat))
        if self.halo:
            profile = profile + self.halo * np.exp(-half / HALO_WIDTH**2)
        return np.asarray(profile * (self.sigma_m / sigma) ** 2)


@dataclass(frozen=True, slots=True)
class Patch:
    """Light on some pixels: rows v0 to v1, columns u0 to u1 of the picture."""

    u0: int
    v0: int
    light: Light  # (v1 - v0, u1 - u0)

    @property
    def where(self) -> tuple[slice, slice]:
        """Rows and columns of the picture."""
        h, w = self.light.shape
        return slice(self.v0, self.v0 + h), slice(self.u0, self.u0 + w)


@lru_cache(maxsize=8)
def _powers(order: int) -> tuple[tuple[int, int], ...]:
    return tuple((i, j) for i in range(order + 1) for j in range(order + 1 - i))


def _terms(a: Array, b: Array) -> Array:
    """(..., k) monomials up to _ORDER."""
    pa, pb = [np.ones_like(a)], [np.ones_like(b)]
    for _ in range(_ORDER):
        pa.append(pa[-1] * a)
        pb.append(pb[-1] * b)
    return np.stack([pa[i] * pb[j] for i, j in _powers(_ORDER)], axis=-1)


def screen_jacobian(camera: Camera, screen: Screen, at_m: Array) -> Array:
    """(2, 2) px per m: picture over the screen's x and y, at a point (2,) of the screen."""
    h = 1e-5
    steps = np.array([[h, 0], [0, h], [-h, 0], [0, -h]])
    uv, _ = camera_pixels(camera, _in_world(screen, at_m + steps))
    return np.stack([uv[0] - uv[2], uv[1] - uv[3]], axis=-1) / (2 * h)


def _in_world(screen: Screen, xy_m: Array) -> Array:
    """(n, 3) m in world of points (n, 2) on the screen."""
    R = screen.world_from_screen.rotation
    return np.asarray(xy_m @ R[:, :2].T + screen.world_from_screen.translation)


def screen_points(
    camera: Camera, screen: Screen, middle_m: Array, u_px: Array, v_px: Array
) -> tuple[Array, Array] | None:
    """Screen x and y (m), each (len(v), len(u)), at a grid of pixels around the image of `middle_m`.

    The projection is inverted by a polynomial over the grid, fitted to projected screen points. None beyond the lens.
    """
    J = screen_jacobian(camera, screen, middle_m)
    if not np.isfinite(J).all() or abs(np.linalg.det(J)) < 1e-6:
        return None
    uv0, _ = camera_pixels(camera, _in_world(screen, middle_m[None]))
    centre = np.array([(u_px[0] + u_px[-1]) / 2, (v_px[0] + v_px[-1]) / 2])
    half = np.array([np.ptp(u_px), np.ptp(v_px)]) / 2 + 1.0
    node = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES) * 1.15
    gu, gv = np.meshgrid(centre[0] + node * half[0], centre[1] + node * half[1])
    wanted = np.stack([gu.reshape(-1), gv.reshape(-1)], axis=-1)
    xy = middle_m + (wanted - uv0[0]) @ np.linalg.inv(J).T
    uv, good = camera_pixels(camera, _in_world(screen, xy))
    if not good.all() or not np.isfinite(uv).all():
        return None
    a, b = ((uv - centre) / half).T
    coefficients, *_ = np.linalg.lstsq(_terms(a, b), xy - middle_m, rcond=None)
    us, vs = (u_px - centre[0]) / half[0], (v_px - centre[1]) / half[1]
    pu = np.stack([us**i for i in range(_ORDER + 1)])
    pv = np.stack([vs**i for i in range(_ORDER + 1)])
    table = np.zeros((_ORDER + 1, _ORDER + 1, 2))
    for (i, j), c in zip(_powers(_ORDER), coefficients, strict=True):
        table[i, j] = c
    x = pv.T @ (table[..., 0].T @ pu) + middle_m[0]
    y = pv.T @ (table[..., 1].T @ pu) + middle_m[1]
    return x, y


def fine_pixels(first: int, count: int, parts: int) -> Array:
    """Positions of `parts` samples in each of `count` pixels; pixel centres are integers."""
    return first - 0.5 + (np.arange(count * parts) + 0.5) / parts


def blurred(fine: Light, blur_px: float, parts: int) -> Light:
    """The patch convolved with the Gaussian point spread function of the lens; no light outside the patch."""
    sigma = blur_px * parts
    if sigma < 0.2:
        return fine
    size = 2 * int(np.ceil(5 * sigma)) + 1
    return np.asarray(cv2.GaussianBlur(fine, (size, size), sigma, borderType=cv2.BORDER_CONSTANT), dtype=np.float32)


def pixel_means(fine: Light, parts: int) -> Light:
    """Means over blocks of parts x parts samples."""
    if parts == 1:
        return fine
    h, w = fine.shape
    return np.asarray(
        fine.reshape(h // parts, parts, w // parts, parts).mean(axis=(1, 3), dtype=np.float32), dtype=np.float32
    )


def samples_per_pixel(light_px: float, beam_px: float) -> int:
    """Samples per pixel and axis for light of a smallest sigma `light_px`, with the lens, from a beam of `beam_px`.

    The second moment of the mean of samples is 1 / (12 parts^2) px^2 below that of a pixel; the sum over samples of a
    Gaussian 1.4 sigma apart equals its integral within 1e-4.
    """
    enough = next((parts for below, parts in ((0.7, 6), (1.5, 4), (3.0, 3), (6.0, 2)) if light_px < below), 1)
    return int(np.clip(np.ceil(1 / (1.4 * max(beam_px, 1e-3))), enough, MOST_SAMPLES))
