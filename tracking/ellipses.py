"""Many symmetric 2x2 matrices at once, each as its three entries uu, uv, vv: the shapes of spots.

Closed forms, since numpy's own linear algebra costs more than the fit of a few spots can afford.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array


def axes(shape: Array) -> tuple[Array, Array, Array]:
    """1-sigma half axes major and minor (n,), and the major one's angle (n,), degrees in (-90, 90] from +u towards +v.

    shape (n, 3): covariances; an axis of negative variance has length 0.
    """
    low, high = eigenvalues(shape)
    angle = np.degrees(0.5 * np.arctan2(2 * shape[:, 1], shape[:, 0] - shape[:, 2]))
    angle = np.where(angle <= -90, angle + 180, angle)
    return np.sqrt(np.maximum(high, 0.0)), np.sqrt(np.maximum(low, 0.0)), angle


def eigenvalues(shape: Array) -> tuple[Array, Array]:
    """The smaller and the larger eigenvalue (n,) of matrices (n, 3)."""
    middle, gap = 0.5 * (shape[:, 0] + shape[:, 2]), np.hypot(0.5 * (shape[:, 0] - shape[:, 2]), shape[:, 1])
    return middle - gap, middle + gap


def determinant(shape: Array) -> Array:
    return shape[:, 0] * shape[:, 2] - shape[:, 1] ** 2


def inverse(shape: Array) -> Array:
    """Inverses (n, 3) of matrices (n, 3)."""
    return shape[:, ::-1] * np.array([1.0, -1.0, 1.0]) / determinant(shape)[:, None]


def length(step: Array, shape: Array) -> Array:
    """Mahalanobis length (n,) of steps (n, 2) under covariances (n, 3)."""
    a = inverse(shape)
    squared = a[:, 0] * step[:, 0] ** 2 + 2 * a[:, 1] * step[:, 0] * step[:, 1] + a[:, 2] * step[:, 1] ** 2
    return np.sqrt(np.maximum(squared, 0.0))


def at_least(shape: Array, least: float) -> Array:
    """Matrices (n, 3) with eigenvalues raised to `least`."""
    poor = eigenvalues(shape)[0] < least
    if not poor.any():
        return shape
    values, vectors = np.linalg.eigh(matrices(shape[poor]))
    out = shape.copy()
    out[poor] = entries((vectors * np.maximum(values, least)[:, None, :]) @ vectors.transpose(0, 2, 1))
    return out


def kept_within(shape: Array, base: Array, low: float, high: float) -> Array:
    """Matrices (n, 3) whose eigenvalues in the metric of `base` (n, 3) are clipped to [low, high]."""
    half_trace = 0.5 * (shape[:, 0] * base[:, 2] - 2 * shape[:, 1] * base[:, 1] + shape[:, 2] * base[:, 0])
    half_trace = half_trace / determinant(base)
    gap = np.sqrt(np.maximum(half_trace**2 - determinant(shape) / determinant(base), 0.0))
    out_of_range = ~((half_trace - gap >= low) & (half_trace + gap <= high))
    if not out_of_range.any():
        return shape
    root = np.linalg.cholesky(matrices(base[out_of_range]))
    undo = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(undo @ matrices(shape[out_of_range]) @ undo.transpose(0, 2, 1))
    mixed = root @ vectors
    out = shape.copy()
    out[out_of_range] = entries((mixed * np.clip(values, low, high)[:, None, :]) @ mixed.transpose(0, 2, 1))
    return out


def matrices(shape: Array) -> Array:
    """(n, 2, 2) of (n, 3)."""
    return shape[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


def entries(full: Array) -> Array:
    """(n, 3) of symmetric (n, 2, 2)."""
    return full.reshape(-1, 4)[:, [0, 1, 3]]
