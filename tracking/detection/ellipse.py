"""The elliptical shapes of spots: symmetric 2x2 matrices (uu, uv, vv) and elliptical Gaussians, compiled."""

from __future__ import annotations

from math import atan2, degrees, hypot, sqrt

import numpy as np

from geometry.arrays import Array
from geometry.compilation.jit import compiled

Entries = tuple[float, float, float]

_LOG2_E, _LOG_2, _LOG_2_REST = 1.4426950408889634, 0.693147180369123816, 1.90821492927058770e-10  # log(2) in two parts
_SHIFT = 1.5 * 2.0**52  # a number added to it is rounded to an integer, in the lowest bits
_EXPONENT_OF_1 = 1023  # in the bits of a floating-point number


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
def between(outer: Entries, inner: Entries) -> Entries:
    """The product outer inner outer."""
    a, b = outer[0] * inner[0] + outer[1] * inner[1], outer[0] * inner[1] + outer[1] * inner[2]
    c, d = outer[1] * inner[0] + outer[2] * inner[1], outer[1] * inner[1] + outer[2] * inner[2]
    return a * outer[0] + b * outer[1], a * outer[1] + b * outer[2], c * outer[1] + d * outer[2]


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
def exponential(x: float) -> float:
    """exp(x), x clipped to [-700, 700], to 5e-16 of its value. Loops over it are vectorised, unlike those of math.exp.

    2^n exp(r) with |r| <= log(2) / 2: the Taylor series of exp(r), and n in the bits of the floating-point number. The
    terms are summed in pairs (Estrin's scheme), since a chain of twelve steps takes twice the time.
    """
    x = x if x > -700.0 else -700.0
    x = x if x < 700.0 else 700.0
    shifted = x * _LOG2_E + _SHIFT
    n = shifted - _SHIFT
    r = (x - n * _LOG_2) - n * _LOG_2_REST
    r2 = r * r
    r4 = r2 * r2
    low = (1.0 + r) + (0.5 + r * (1.0 / 6.0)) * r2
    middle = (1.0 / 24.0 + r * (1.0 / 120.0)) + (1.0 / 720.0 + r * (1.0 / 5040.0)) * r2
    high = (
        (1.0 / 40320.0 + r * (1.0 / 362880.0))
        + (1.0 / 3628800.0 + r * (1.0 / 39916800.0)) * r2
        + r4 * (1.0 / 479001600.0)
    )
    series = low + (middle + high * r4) * r4
    return series * np.int64((np.float64(shifted).view(np.int64) + _EXPONENT_OF_1) << 52).view(np.float64)


@compiled
def gaussian_window(a: Entries, u0: float, v0: float, step: float, columns: int, out: Array) -> None:
    """exp(-d^T A d / 2) at d = (u0 + j step, v0 + i step), into out (rows columns,); a is A (uu, uv, vv), 1/px^2."""
    for i in range(out.shape[0] // columns):
        v = v0 + i * step
        line = out[i * columns : (i + 1) * columns]
        for j in range(line.shape[0]):
            u = u0 + j * step
            line[j] = -0.5 * (a[0] * u * u + 2.0 * a[1] * u * v + a[2] * v * v)
    for k in range(out.shape[0]):
        out[k] = exponential(out[k])
