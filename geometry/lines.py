"""Straight lines in space: where two are closest, and the point nearest to many."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, cross, normalised


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
