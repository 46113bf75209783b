"""Definition of a screen's frame: its origin and axes.

It is defined by named dots. Without them the origin is the centre of the dots' extent, z points to the side of the
cameras that observe the screen, y as close to the world's z as the plane allows (to its y if the screen is
horizontal), and x = y x z.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, cross, normalised
from geometry.pose import Pose


def plane_through(points: Array) -> tuple[Array, Array, Array]:
    """Middle (3,), unit normal (3,) and RMS extents (3,) along the three axes, largest first, m, of points (n, 3)."""
    middle = points.mean(axis=0)
    _, s, axes = np.linalg.svd(points - middle, full_matrices=False)
    extents = np.zeros(3)
    extents[: len(s)] = s / np.sqrt(len(points))
    normal = axes[2] if len(axes) > 2 else cross(axes[0], axes[1])
    return middle, normal, extents


def frame_of_extent(points: Array, seen_from: Array | None = None, up: Array | None = None) -> Pose:
    """world_from_screen from points (n, 3), m, of the screen; z towards `seen_from` (3,) if given.

    up (3,): direction of y, projected into the plane; None: the world's z.
    """
    middle, normal, _ = plane_through(points)
    if seen_from is not None:
        normal = normal if normal @ (seen_from - middle) >= 0 else -normal
    elif normal[np.argmax(np.abs(normal))] < 0:
        normal = -normal
    upward = np.array([0.0, 0.0, 1.0]) if up is None else up
    if abs(normal @ upward) > 0.9:  # within 26 deg of horizontal the world's z hardly defines a direction
        upward = np.array([0.0, 1.0, 0.0])
    y = normalised(upward - (upward @ normal) * normal)
    R = np.stack([cross(y, normal), y, normal], axis=1)
    flat = (points - middle) @ R[:, :2]
    centre = (flat.min(axis=0) + flat.max(axis=0)) / 2
    return Pose(R, middle + R[:, :2] @ centre)


def frame_of_dots(points: Array, origin: Array, along_x: Array, on_y_side: Array, origin_at: Array) -> Pose:
    """world_from_screen from three named dots (3,) each, m: `origin` has the coordinates `origin_at` (2,), m.

    x points from it towards `along_x`; y is positive on the side of `on_y_side`.

    Raises:
        ValueError: the three dots are collinear.
    """
    _, normal, _ = plane_through(points)
    x = along_x - origin
    x = x - (x @ normal) * normal
    side = on_y_side - origin
    across = side - (side @ normal) * normal - (side @ normalised(x)) * normalised(x)
    if np.linalg.norm(across) < 0.02 * np.linalg.norm(x) or np.linalg.norm(x) < 1e-6:
        raise ValueError("the three dots of the frame lie on one line")
    x, y = normalised(x), normalised(across)
    R = np.stack([x, y, cross(x, y)], axis=1)
    return Pose(R, origin - R[:, :2] @ origin_at)
