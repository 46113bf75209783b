"""Intersections of rays with screens that may be slightly bent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geometry.arrays import Array
from geometry.pose import Pose

NEWTON_STEPS = 4  # a bow of centimetres over metres converges to rounding in two or three


def intersect_surface(origin: Array, direction: Array, world_from_screen: Pose, bow: Sequence[float]) -> Array:
    """Intersections (..., 3), m, in world, of rays with a screen; nan where the ray is parallel to it or points away.

    origin, direction: (..., 3), m and no unit, in world. bow: a, b, c, 1/m, of the surface z = a x^2 + b x y + c y^2 in
    the screen frame; all 0: flat.
    """
    screen_from_world = world_from_screen.inverse()
    p = screen_from_world.apply(np.asarray(origin, dtype=float))
    d = screen_from_world.turn(np.asarray(direction, dtype=float))
    p, d = np.broadcast_arrays(p, d)
    along = np.abs(d[..., 2]) > 1e-12 * np.linalg.norm(d, axis=-1)
    t = -p[..., 2] / np.where(along, d[..., 2], 1.0)
    a, b, c = bow
    if a or b or c:
        for _ in range(NEWTON_STEPS):
            x, y = p[..., 0] + t * d[..., 0], p[..., 1] + t * d[..., 1]
            height = p[..., 2] + t * d[..., 2] - (a * x * x + b * x * y + c * y * y)
            slope = d[..., 2] - (2 * a * x + b * y) * d[..., 0] - (b * x + 2 * c * y) * d[..., 1]
            t = t - height / np.where(np.abs(slope) > 1e-12, slope, 1.0)
    hit = world_from_screen.apply(p + t[..., None] * d)
    return np.where((along & (t > 0))[..., None], hit, np.nan)
