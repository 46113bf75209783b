"""The elliptical shapes of spots: symmetric 2x2 matrices (uu, uv, vv) and rows of elliptical Gaussians, compiled."""

from __future__ import annotations

from math import atan2, degrees, exp, hypot, sqrt

from geometry.arrays import Array
from geometry.compilation.jit import compiled

Entries = tuple[float, float, float]


@compiled
def eigenvalues(uu: float, uv: float, vv: float) -> tuple[float, float]:
    """The smaller and the larger eigenvalue."""
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
def mahalanobis(du: float, dv: float, uu: float, uv: float, vv: float) -> float:
    """Mahalanobis length of a step under a covariance."""
    return sqrt(max((vv * du * du - 2 * uv * du * dv + uu * dv * dv) / (uu * vv - uv * uv), 0.0))


@compiled
def clip_eigenvalues(uu: float, uv: float, vv: float, low: float, high: float) -> Entries:
    """The matrix with its eigenvalues clipped to [low, high]."""
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
def clip_in_metric(shape: Entries, base: Entries, low: float, high: float) -> Entries:
    """The matrix `shape` with its eigenvalues in the metric of `base`, positive definite, clipped to [low, high]."""
    # With base = L L^T these are the eigenvalues of L^-1 shape L^-T.
    uu, uv, vv = shape
    l11 = sqrt(base[0])
    l21 = base[1] / l11
    l22 = sqrt(base[2] - l21 * l21)
    p, q = -l21 / (l11 * l22), 1.0 / l22
    a, b, c = clip_eigenvalues(
        uu / (l11 * l11), (uu * p + uv * q) / l11, p * p * uu + 2 * p * q * uv + q * q * vv, low, high
    )
    return l11 * l11 * a, l11 * (l21 * a + l22 * b), l21 * l21 * a + 2 * l21 * l22 * b + l22 * l22 * c


@compiled
def gaussian_row(a: tuple[float, float, float], u0: float, v: float, step: float, out: Array) -> None:
    """exp(-d^T A d / 2) at d = (u0 + j step, v), into out (n,); a is A (uu, uv, vv), 1/px^2.

    The ratio of neighbouring values is a geometric sequence in j, so each value costs two products instead of an
    exponential. The sequence starts at the maximum of the row and decreases in both directions, so errors do not grow.
    """
    n = out.shape[0]
    top = -a[1] * v / a[0]
    j = int(min(max((top - u0) / step + 0.5, 0.0), n - 1.0))
    u = u0 + j * step
    first = exp(-0.5 * (a[0] * u * u + 2.0 * a[1] * u * v + a[2] * v * v))
    bend = exp(-a[0] * step * step)
    right = exp(-a[0] * u * step - 0.5 * a[0] * step * step - a[1] * step * v)
    left = bend / right
    out[j] = first
    value = first
    for i in range(j + 1, n):
        value *= right
        right *= bend
        out[i] = value
    value = first
    for i in range(j - 1, -1, -1):
        value *= left
        left *= bend
        out[i] = value
