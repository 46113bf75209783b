"""Array types, and the small functions of linear algebra that numpy lacks."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]
Ints: TypeAlias = NDArray[np.int64]


def perpendicular(directions: Array) -> Array:
    """Two orthonormal vectors, the columns of (..., 3, 2), perpendicular to unit vectors (..., 3)."""
    # The coordinate axis farthest from the direction gives the best conditioned cross product.
    least = np.eye(3)[np.argmin(np.abs(directions), axis=-1)]
    first = normalised(np.cross(directions, least))
    return np.stack([first, np.cross(directions, first)], axis=-1)


def normalised(vectors: Array) -> Array:
    """Unit vectors along the given vectors (..., n); a null vector stays null."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)


def evenly_spaced(rows: Ints, most: int) -> Ints:
    """At most so many of the rows, evenly spaced, with the first and the last: those nearest to equal steps."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).round().astype(np.int64)]


def evenly_spread(rows: Ints, most: int) -> Ints:
    """As `evenly_spaced`, but the rows before equal steps."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(np.int64)]


def true_ranges(mask: Bools) -> list[tuple[int, int]]:
    """First index and one past the last index of each run of True in (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(mask, dtype=np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def finite(values: Array, axes: int | tuple[int, ...]) -> Bools:
    """Whether all numbers along these axes are finite."""
    return np.asarray(np.isfinite(values).all(axis=axes), dtype=np.bool_)


MEDIAN_TO_SIGMA = 1.4826  # sigma of a normal distribution over the median size of its values
NORMAL_MEDIAN = 0.6745  # its inverse; figures of both, to four digits, are in recorded results


def robust_sigma(values: Array, axis: int | None = None) -> Array:
    """Sigma of values about zero from the median of their sizes: up to half of them may be outliers."""
    return MEDIAN_TO_SIGMA * np.asarray(np.median(np.abs(values), axis=axis), dtype=float)


def upper_median(values: NDArray) -> float:
    """The upper median; nan without values: np.median, at a fifth of its cost on the small arrays of one frame."""
    half = values.size // 2
    return float(np.partition(values.ravel(), half)[half]) if values.size else float("nan")


def weighted_median(values: Array, weights: Array) -> float:
    """The least of the values (n,) up to which half of the weights (n,) lie; 0 without weights."""
    total = float(weights.sum())
    if total <= 0:
        return 0.0
    order = np.argsort(values)
    return float(values[order[np.searchsorted(np.cumsum(weights[order]), 0.5 * total)]])


def skew(v: Array) -> Array:
    """The matrices (..., 3, 3) with skew(v) @ w = v x w, of vectors (..., 3)."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def cross(a: Array, b: Array) -> Array:
    """a x b of vectors (..., 3), broadcast: np.cross, at a fifth of its cost on the small arrays of one frame."""
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=-1)


def symmetric(matrix: Array) -> Array:
    """The symmetric part of matrices (..., n, n): restores the symmetry that rounding takes from a covariance."""
    return 0.5 * (matrix + np.swapaxes(matrix, -1, -2))


def numeric_jacobian(f: Callable[[Array], Array], x: Array, step: float = 1e-6) -> Array:
    """Jacobian (..., n) at x of a function of (n,) to (...,), by central differences: for checks of analytic ones."""

    columns = []
    for i in range(x.size):
        e = np.zeros_like(x)
        e[i] = step
        columns.append((f(x + e) - f(x - e)) / (2 * step))
    return np.stack(columns, axis=-1)
