"""Projection of the spots from the rig parameters, independent of the tested code.

Source: section 1 of the file formats (frames, units) and the lens model of OpenCV with k1, k2, p1, p2, k3.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.rig import Rig


def spot_pixels(rig: Rig, world_from_body: Pose) -> Array:
    """Distorted pixels (T, n, 2) of all views, in the order of Rig.views(), for a stack of poses (T,).

    nan where the beam misses its screen, or the point lies behind the camera or beyond the fold of the lens model.
    """
    views = rig.views()
    out = np.full((len(world_from_body.translation), len(views), 2), np.nan)
    for i, (camera_name, spot_name) in enumerate(views):
        spot = rig.spots[spot_name]
        beam, screen = rig.beams[spot.beam], rig.screens[spot.screen]
        start = world_from_body.rotation @ beam.point + world_from_body.translation  # (T, 3) m, world
        along = world_from_body.rotation @ (spot.sign * beam.direction)  # (T, 3)
        x_axis, y_axis, normal = screen.world_from_screen.rotation.T
        origin = screen.world_from_screen.translation
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = ((origin - start) @ normal) / (along @ normal)  # m
            hit = start + reach[:, None] * along
            good = reach > 0
            if screen.size_m is not None:
                good &= np.abs((hit - origin) @ x_axis) <= screen.size_m[0] / 2
                good &= np.abs((hit - origin) @ y_axis) <= screen.size_m[1] / 2
            uv, in_front = camera_pixels(rig.cameras[camera_name], hit)
        out[:, i] = np.where((good & in_front)[:, None], uv, np.nan)
    return out


def camera_pixels(camera: Camera, points_world: Array) -> tuple[Array, Bools]:
    """Distorted pixels (T, 2) of world points (T, 3), m, and which lie in front of the camera and before the fold."""
    in_camera = points_world @ camera.camera_from_world.rotation.T + camera.camera_from_world.translation
    x, y = in_camera[:, 0] / in_camera[:, 2], in_camera[:, 1] / in_camera[:, 2]
    k1, k2, p1, p2, k3 = np.pad(np.asarray(camera.distortion, dtype=float), (0, 5 - len(camera.distortion)))
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    x_d = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    y_d = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    u = camera.matrix[0, 0] * x_d + camera.matrix[0, 2]
    v = camera.matrix[1, 1] * y_d + camera.matrix[1, 2]
    return np.stack([u, v], axis=-1), (in_camera[:, 2] > 0) & (r2 < fold_radius((k1, k2, k3)) ** 2)


def fold_radius(radial: tuple[float, float, float]) -> float:
    """The normalised radius of the maximum of r (1 + k1 r^2 + k2 r^4 + k3 r^6); inf if it always increases."""
    k1, k2, k3 = radial
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])  # in r^2; np.roots drops leading zeros
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(np.sqrt(real.min())) if real.size else np.inf


def in_picture(uv_px: Array, size_px: Array) -> Bools:
    """Pixels (..., 2) that lie in pictures of size (..., 2): -0.5 <= u < width - 0.5; False for nan."""
    return np.all((uv_px >= -0.5) & (uv_px < size_px - 0.5), axis=-1)
