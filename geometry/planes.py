"""Straight lines, planes and the surfaces of screens in space."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geometry.arrays import Array, Bools, cross, normalised
from geometry.pose import Pose

# Straight lines in space: where two are closest, and the point nearest to many.


def common_perpendicular(point_a: Array, direction_a: Array, point_b: Array, direction_b: Array) -> tuple[Array, Array]:
    """The feet (..., 3), m, of the common perpendicular of lines a and b: one point on each line.

    Points (..., 3), m; directions (..., 3), of any length. nan for parallel lines.
    """
    n = cross(direction_a, direction_b)
    n2 = np.sum(n * n, axis=-1)
    size = np.sum(direction_a**2, -1) * np.sum(direction_b**2, -1)
    n2 = np.where(n2 > 1e-24 * size, n2, np.nan)
    gap = point_b - point_a
    s = np.sum(cross(gap, direction_b) * n, axis=-1) / n2
    t = np.sum(cross(gap, direction_a) * n, axis=-1) / n2
    return point_a + s[..., None] * direction_a, point_b + t[..., None] * direction_b


def nearest_point(points: Array, directions: Array, weights: Array | None = None) -> Array:
    """The point (3,), m, with the smallest weighted sum of squared distances to lines; nan if all are parallel.

    points (n, 3), m; directions (n, 3), of any length; weights (n,), 1 by default.
    """

    d = normalised(directions)
    w = np.ones(len(d)) if weights is None else weights
    across = w[:, None, None] * (np.eye(3) - d[:, :, None] * d[:, None, :])
    A = across.sum(axis=0)
    if np.linalg.eigvalsh(A)[0] < 1e-12 * w.sum():
        return np.full(3, np.nan)
    return np.linalg.solve(A, (across @ points[..., None])[..., 0].sum(axis=0))


# Intersections of rays with planes.


def intersect_plane(origin: Array, direction: Array, world_from_screen: Pose) -> Array:
    """Intersections (..., 2), m, of rays with the plane of a screen, in the screen frame.

    origin, direction: (..., 3), m and no unit, in world. nan where the ray is parallel to the plane or points away.
    """
    p, d, along, t = _to_plane(origin, direction, world_from_screen)
    hit = p[..., :2] + t[..., None] * d[..., :2]
    return np.where((along & (t > 0))[..., None], hit, np.nan)


def _to_plane(origin: Array, direction: Array, world_from_screen: Pose) -> tuple[Array, Array, Bools, Array]:
    """Rays in the screen frame: origins and directions (..., 3), which are not parallel to it, and lengths to it."""
    screen_from_world = world_from_screen.inverse()
    p = screen_from_world.apply(np.asarray(origin, dtype=float))
    d = screen_from_world.turn(np.asarray(direction, dtype=float))
    p, d = np.broadcast_arrays(p, d)
    along = np.abs(d[..., 2]) > 1e-12 * np.linalg.norm(d, axis=-1)
    t = -p[..., 2] / np.where(along, d[..., 2], 1.0)
    return p, d, np.asarray(along, dtype=np.bool_), t


def screen_to_world(points: Array, world_from_screen: Pose) -> Array:
    """World coordinates (..., 3), m, of points (..., 2), m, in the plane of a screen."""

    return np.einsum("...i,ji->...j", points, world_from_screen.rotation[:, :2]) + world_from_screen.translation


# Intersections of rays with screens that may be slightly bent.


NEWTON_STEPS = 4  # a bow of centimetres over metres converges to rounding in two or three


def intersect_surface(origin: Array, direction: Array, world_from_screen: Pose, bow: Sequence[float]) -> Array:
    """Intersections (..., 3), m, in world, of rays with a screen; nan where the ray is parallel to it or points away.

    origin, direction: (..., 3), m and no unit, in world. bow: a, b, c, 1/m, of the surface z = a x^2 + b x y + c y^2 in
    the screen frame; all 0: flat.
    """
    p, d, along, t = _to_plane(origin, direction, world_from_screen)
    a, b, c = bow
    if a or b or c:
        for _ in range(NEWTON_STEPS):
            x, y = p[..., 0] + t * d[..., 0], p[..., 1] + t * d[..., 1]
            height = p[..., 2] + t * d[..., 2] - (a * x * x + b * x * y + c * y * y)
            slope = d[..., 2] - (2 * a * x + b * y) * d[..., 0] - (b * x + 2 * c * y) * d[..., 1]
            t = t - height / np.where(np.abs(slope) > 1e-12, slope, 1.0)
    hit = world_from_screen.apply(p + t[..., None] * d)
    return np.where((along & (t > 0))[..., None], hit, np.nan)
