"""Real roots of polynomials of degree 8, compiled. Coefficients are given with the lowest power first. Source: ours."""

from __future__ import annotations

from geometry.arrays import Array
from geometry.compilation.jit import compiled


@compiled
def add_product(out: Array, a: Array, deg_a: int, b: Array, deg_b: int, factor: float) -> None:
    """out += factor a b, of polynomials a and b of the given degrees."""
    for i in range(deg_a + 1):
        x = factor * a[i]
        if x != 0.0:
            for j in range(deg_b + 1):
                out[i + j] += x * b[j]


@compiled
def roots_within(p: Array, d: Array, before: Array, roots: Array) -> int:
    """Writes the real roots in [-1, 1] of a polynomial p (9,) to roots (9,), ascending; returns their number.

    d, before (9,) are scratch. Between two neighbouring zeros of its derivative a polynomial has at most one root, so
    the roots of the derivatives are found from the linear one upwards. A minimum that misses zero by less than the
    rounding of the coefficients counts as a root: a double one.
    """
    size = 0.0
    for r in range(9):
        size = max(size, abs(p[r]))
    if not size > 0.0:
        return 0
    count = 0
    for degree in range(1, 9):
        # The derivative of this degree, of order 8 - degree.
        for r in range(degree + 1):
            factor = 1.0
            for s in range(8 - degree):
                factor *= (r + 8 - degree - s) / (8 - s)
            d[r] = p[r + 8 - degree] * factor
        for r in range(count):
            before[r] = roots[r]
        extremes, count = count, 0
        left, at_left = -1.0, _value(d, degree, -1.0)
        for r in range(extremes + 1):
            right = before[r] if r < extremes else 1.0
            at_right = _value(d, degree, right)
            if at_left == 0.0:
                roots[count] = left
                count += 1
            elif (at_left < 0.0) != (at_right < 0.0) and at_right != 0.0:
                roots[count] = _root_between(d, degree, left, right, at_left)
                count += 1
            elif degree == 8 and r < extremes and abs(at_right) < 1e-12 * size:
                roots[count] = right
                count += 1
            left, at_left = right, at_right
        if at_left == 0.0:
            roots[count] = left
            count += 1
        if count > degree:
            count = degree
    return count


@compiled
def _value(p: Array, degree: int, x: float) -> float:
    """The value at x of a polynomial of this degree."""
    y = p[degree]
    for r in range(degree - 1, -1, -1):
        y = y * x + p[r]
    return y


@compiled
def _root_between(p: Array, degree: int, left: float, right: float, at_left: float) -> float:
    """The root in an interval with a change of sign: Newton's method, and bisection where that leaves the interval."""
    x = 0.5 * (left + right)
    for _ in range(60):
        y, slope = p[degree], 0.0
        for r in range(degree - 1, -1, -1):
            slope = slope * x + y
            y = y * x + p[r]
        if (y < 0.0) == (at_left < 0.0):
            left = x
        else:
            right = x
        step = y / slope
        x_new = x - step
        if not (left < x_new < right):
            x_new = 0.5 * (left + right)
        if abs(x_new - x) < 1e-14:
            return x_new
        x = x_new
    return x
