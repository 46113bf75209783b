"""An elliptical Gaussian on a row of equally spaced points, without an exponential for each."""

from __future__ import annotations

from math import exp

from geometry.arrays import Array
from geometry.compilation.jit import compiled


@compiled
def gaussian_row(a: tuple[float, float, float], u0: float, v: float, step: float, out: Array) -> None:
    """exp(-d^T A d / 2) at d = (u0 + j step, v), into out (n,); a is A (uu, uv, vv), 1/px^2.

    The ratio of neighbours is a geometric sequence in j, so each value costs two products. The sequence begins where
    the row is brightest: both ways it falls, and no error grows.
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
