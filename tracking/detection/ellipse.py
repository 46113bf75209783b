"""Symmetric 2x2 matrices (uu, uv, vv), one at a time, compiled: the shapes of spots."""

from __future__ import annotations

from math import atan2, degrees, hypot, sqrt

from geometry.compilation.jit import compiled

Entries = tuple[float, float, float]


@compiled
def eigenvalues(uu: float, uv: float, vv: float) -> tuple[float, float]:
    """The smaller and the larger one."""
    middle, gap = 0.5 * (uu + vv), hypot(0.5 * (uu - vv), uv)
    return middle - gap, middle + gap


@compiled
def axes(uu: float, uv: float, vv: float) -> Entries:
    """1-sigma half axes major and minor, and the major one's angle, degrees in (-90, 90] from +u towards +v.

    The matrix is a covariance; an axis of negative variance has length 0.
    """
    low, high = eigenvalues(uu, uv, vv)
    angle = degrees(0.5 * atan2(2 * uv, uu - vv))
    return sqrt(max(high, 0.0)), sqrt(max(low, 0.0)), angle if angle > -90 else angle + 180


@compiled
def inverse(uu: float, uv: float, vv: float) -> Entries:
    """The inverse matrix."""
    determinant = uu * vv - uv * uv
    return vv / determinant, -uv / determinant, uu / determinant


@compiled
def length(du: float, dv: float, uu: float, uv: float, vv: float) -> float:
    """Mahalanobis length of a step under a covariance."""
    return sqrt(max((vv * du * du - 2 * uv * du * dv + uu * dv * dv) / (uu * vv - uv * uv), 0.0))


@compiled
def with_eigenvalues(uu: float, uv: float, vv: float, low: float, high: float) -> Entries:
    """The matrix with its eigenvalues raised to `low` and lowered to `high`."""
    middle, gap = 0.5 * (uu + vv), hypot(0.5 * (uu - vv), uv)
    smaller, larger = middle - gap, middle + gap
    if smaller >= low and larger <= high:
        return uu, uv, vv
    smaller, larger = min(max(smaller, low), high), min(max(larger, low), high)
    middle = 0.5 * (smaller + larger)
    share = 0.5 * (larger - smaller) / gap if gap > 0 else 0.0
    half = 0.5 * (uu - vv) * share
    return middle + half, uv * share, middle - half


@compiled
def kept_within(shape: Entries, base: Entries, low: float, high: float) -> Entries:
    """The matrix `shape` with its eigenvalues in the metric of `base`, positive definite, clipped to [low, high]."""
    # With base = L L^T: the eigenvalues of L^-1 shape L^-T are meant.
    uu, uv, vv = shape
    l11 = sqrt(base[0])
    l21 = base[1] / l11
    l22 = sqrt(base[2] - l21 * l21)
    p, q = -l21 / (l11 * l22), 1.0 / l22
    a, b, c = with_eigenvalues(
        uu / (l11 * l11), (uu * p + uv * q) / l11, p * p * uu + 2 * p * q * uv + q * q * vv, low, high
    )
    return l11 * l11 * a, l11 * (l21 * a + l22 * b), l21 * l21 * a + 2 * l21 * l22 * b + l22 * l22 * c
