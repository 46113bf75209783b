"""Intersections of rays with planes."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array
from geometry.pose import Pose


def intersect_plane(origin: Array, direction: Array, world_from_screen: Pose) -> Array:
    """Intersections (..., 2), m, of rays with the plane of a screen, in the screen frame.

    origin, direction: (..., 3), m and no unit, in world. nan where the ray is parallel to the plane or points away.
    """
    screen_from_world = world_from_screen.inverse()
    p = screen_from_world.apply(np.asarray(origin, dtype=float))
    d = screen_from_world.turn(np.asarray(direction, dtype=float))
    p, d = np.broadcast_arrays(p, d)
    along = np.abs(d[..., 2]) > 1e-12 * np.linalg.norm(d, axis=-1)
    t = -p[..., 2] / np.where(along, d[..., 2], 1.0)
    hit = p[..., :2] + t[..., None] * d[..., :2]
    return np.where((along & (t > 0))[..., None], hit, np.nan)


def screen_to_world(points: Array, world_from_screen: Pose) -> Array:
    """World coordinates (..., 3), m, of points (..., 2), m, in the plane of a screen."""

    return np.einsum("...i,ji->...j", points, world_from_screen.rotation[:, :2]) + world_from_screen.translation
