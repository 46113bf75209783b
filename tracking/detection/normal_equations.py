"""The weighted least-squares problem of one spot: an elliptical Gaussian on a background plane, in a window.

The linearised model is a Gaussian times a polynomial of second degree in the position (which spans the derivatives with
respect to centre, shape and flux) plus a plane. The normal matrix therefore consists of moments of weight, weight times
light and weight times squared light, up to the fourth degree. They are summed row by row, because v is constant within
a row. This takes 18 products per cell; nine columns of derivatives would take 54. Source: ours.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array
from geometry.compilation.jit import compiled
from tracking.detection import ellipse
from tracking.detection.ellipse import gaussian_row
from tracking.detection.pixels import Noise, Window
from tracking.detection.table import (
    FLUX,
    LEVEL,
    LIGHT,
    LINE,
    NEIGHBOUR_LIGHT,
    NODES,
    NORMAL,
    RESIDUAL,
    RIGHT_SIDE,
    ROW,
    SLOPE_U,
    SLOPE_V,
    USE,
    UU,
    UV,
    VALUES,
    VECTORS,
    VV,
    WEIGHT,
    U,
    V,
)

EXACT_PX2 = 0.9**2  # px^2: narrower spots are integrated over the pixels numerically
_POWERS_U, _POWERS_V = (0, 1, 0, 2, 1, 0), (0, 0, 1, 0, 1, 2)
_FOUR_NODES_PX2 = 0.5**2  # px^2: narrower spots need eight instead of four nodes in each direction
_NEGLIGIBLE = 8.5  # sigmas from the centre at which the light is 2e-16 of its peak
_EDGEWORTH = 0.4  # cell^2 / variance above which the pixels' fourth cumulant is significant

# Gauss-Legendre nodes and weights on [-1/2, 1/2] for 4 and 8 points: accurate to 1e-4 of the peak for sigmas of at
# least 0.5 and 0.2 px.
_FOUR = np.polynomial.legendre.leggauss(4)
_EIGHT = np.polynomial.legendre.leggauss(8)
_NODES4, _WEIGHTS4, _NODES8, _WEIGHTS8 = _FOUR[0] / 2, _FOUR[1] / 2, _EIGHT[0] / 2, _EIGHT[1] / 2


class PolynomialFrame(NamedTuple):
    """The coordinates of the polynomial: relative to the spot's centre, in units of its widths."""

    u0: float  # px, centre of the first cell relative to the spot's centre
    v0: float
    su: float  # px, the spot's sigma in u and v
    sv: float
    S: tuple[float, float, float]  # px^2: covariance of the light after integration over the cells
    exact: bool  # the light is integrated over each pixel numerically


@compiled
def frame_of(window: Window, spot: Array) -> PolynomialFrame:
    """The frame of a spot (9,) in a window."""
    middle, pixel = 0.5 * (window.cell - 1), window.cell**2 / 12.0
    exact = window.cell == 1 and ellipse.eigenvalues(spot[UU], spot[UV], spot[VV])[0] < EXACT_PX2
    if exact:
        pixel = 0.0
    S = (spot[UU] + pixel, spot[UV], spot[VV] + pixel)
    return PolynomialFrame(
        window.left + middle - spot[U], window.top + middle - spot[V], sqrt(S[0]), sqrt(S[2]), S, exact
    )


@compiled
def accumulate(window: Window, spot: Array, noise: Noise, cells: Array, algebra: Array) -> float:
    """Fill the normal matrix and right side at a spot, and the cells' light, weight and residual; returns chi-square.

    Columns: 1, x, y, x^2, x y, y^2 times the light, then 1, x, y, in the coordinates of `frame_of`. The weights follow
    from the noise at the fitted level, because weights from the noisy values would bias the fit towards zero.
    """
    frame = frame_of(window, spot)
    if frame.exact:
        return _accumulate_exact(window, frame, spot, noise, cells, algebra[NORMAL], algebra[VECTORS, RIGHT_SIDE])
    A = np.zeros((3, 5, 5))  # moments of weight light^0, ^1 and ^2, by powers of x and y
    R = np.zeros((2, 3, 3))  # of weight residual light^0 and ^1
    sums = np.zeros(18)
    inverse = ellipse.inverse(frame.S[0], frame.S[1], frame.S[2])
    cell = float(window.cell)
    scale = spot[FLUX] / (2 * np.pi * sqrt(frame.S[0] * frame.S[2] - frame.S[1] ** 2))
    narrow = max(inverse[0], inverse[2]) * cell * cell > _EDGEWORTH
    row = cells[ROW, : window.columns]
    for r in range(window.rows):
        dv = frame.v0 + r * cell
        gaussian_row(inverse, frame.u0, dv, cell, row)
        if narrow:
            _integrate_row(inverse, frame.u0, dv, cell, row)
        for j in range(row.shape[0]):
            row[j] *= scale
        _weigh(window, r, frame, spot, noise, row, cells)
        _sum_row(window, r, frame, cells, sums)
        y = dv / frame.sv
        power = 1.0
        for q in range(5):
            for p in range(5):
                A[2, p, q] += power * sums[p]
            for p in range(4):
                A[1, p, q] += power * sums[5 + p]
            if q < 3:
                for p in range(3):
                    A[0, p, q] += power * sums[9 + p]
                    R[1, p, q] += power * sums[12 + p]
                R[0, 0, q] += power * sums[15]
                R[0, 1, q] += power * sums[16]
            power *= y
    _fill(A, R, algebra[NORMAL], algebra[VECTORS, RIGHT_SIDE])
    return _chi_square(window, cells)


@compiled
def _weigh(window: Window, r: int, frame: PolynomialFrame, spot: Array, noise: Noise, row: Array, cells: Array) -> None:
    """Light (given in `row`), residual and weight of a row of cells. Without branches, so that it is vectorised."""
    first, last = r * window.columns, (r + 1) * window.columns
    cell = float(window.cell)
    floor, slope, black = noise.floor, noise.slope, noise.black
    base = spot[LEVEL] + spot[SLOPE_V] * (frame.v0 + r * cell) + spot[SLOPE_U] * frame.u0
    tilt = spot[SLOPE_U] * cell
    others, values, use = cells[NEIGHBOUR_LIGHT, first:last], cells[VALUES, first:last], cells[USE, first:last]
    light, residual, weight = cells[LIGHT, first:last], cells[RESIDUAL, first:last], cells[WEIGHT, first:last]
    for j in range(row.shape[0]):
        level = row[j] + base + tilt * j + others[j]
        above_black = level - black
        light[j] = row[j]
        residual[j] = values[j] - level
        weight[j] = use[j] * (cell * cell) / (floor + slope * (above_black if above_black > 0.0 else 0.0))


@compiled
def _sum_row(window: Window, r: int, frame: PolynomialFrame, cells: Array, sums: Array) -> None:
    """Moments in x along a row: w l^2 (5), w l (4), w (3), w l r (3), w r (2); w weight, l light, r residual."""
    first, last = r * window.columns, (r + 1) * window.columns
    light, residual, weight = cells[LIGHT, first:last], cells[RESIDUAL, first:last], cells[WEIGHT, first:last]
    x0, dx = frame.u0 / frame.su, window.cell / frame.su
    a0 = a1 = a2 = a3 = a4 = b0 = b1 = b2 = b3 = c0 = c1 = c2 = d0 = d1 = d2 = e0 = e1 = 0.0
    for j in range(light.shape[0]):
        x = x0 + j * dx
        w, l = weight[j], light[j]
        wr, wl = w * residual[j], w * l
        wll, wlr = wl * l, wr * l
        a0 += wll
        b0 += wl
        c0 += w
        d0 += wlr
        e0 += wr
        wll, wl, w, wlr = wll * x, wl * x, w * x, wlr * x
        a1 += wll
        b1 += wl
        c1 += w
        d1 += wlr
        e1 += wr * x
        wll, wl = wll * x, wl * x
        a2 += wll
        b2 += wl
        c2 += w * x
        d2 += wlr * x
        wll = wll * x
        a3 += wll
        b3 += wl * x
        a4 += wll * x
    sums[0], sums[1], sums[2], sums[3], sums[4] = a0, a1, a2, a3, a4
    sums[5], sums[6], sums[7], sums[8] = b0, b1, b2, b3
    sums[9], sums[10], sums[11] = c0, c1, c2
    sums[12], sums[13], sums[14], sums[15], sums[16] = d0, d1, d2, e0, e1


@compiled
def _chi_square(window: Window, cells: Array) -> float:
    total = 0.0
    for k in range(window.columns * window.rows):
        total += cells[WEIGHT, k] * cells[RESIDUAL, k] * cells[RESIDUAL, k]
    return total


@compiled
def _fill(A: Array, R: Array, N: Array, b: Array) -> None:
    for p in range(9):
        light_p = 1 if p < 6 else 0
        i, j = _POWERS_U[p if p < 6 else p - 6], _POWERS_V[p if p < 6 else p - 6]
        b[p] = R[light_p, i, j]
        for q in range(9):
            light_q = 1 if q < 6 else 0
            m, n = _POWERS_U[q if q < 6 else q - 6], _POWERS_V[q if q < 6 else q - 6]
            N[p, q] = A[light_p + light_q, i + m, j + n]


@compiled
def _integrate_row(a: tuple[float, float, float], u0: float, v: float, cell: float, row: Array) -> None:
    """Convert the point values of a Gaussian, whose covariance includes the pixels' variance, into pixel means.

    The fourth cumulant of a square pixel, -cell^4/120, enters as an Edgeworth term. Against the exact integral the
    error is below 0.05 % of the peak for sigmas of at least 0.8 px (tested).
    """
    share = cell**4 / 2880.0
    for j in range(row.shape[0]):
        du = u0 + j * cell
        wu, wv = a[0] * du + a[1] * v, a[1] * du + a[2] * v
        fourth = wu**4 - 6 * a[0] * wu * wu + 3 * a[0] * a[0] + wv**4 - 6 * a[2] * wv * wv + 3 * a[2] * a[2]
        row[j] *= max(1.0 - share * fourth, 0.0)


@compiled
def _accumulate_exact(
    window: Window, frame: PolynomialFrame, spot: Array, noise: Noise, cells: Array, N: Array, b: Array
) -> float:
    """`accumulate` for a narrow spot, with light and derivatives integrated over each pixel by quadrature."""
    low = ellipse.eigenvalues(spot[UU], spot[UV], spot[VV])[0]
    nodes, weights = (_NODES4, _WEIGHTS4) if low > _FOUR_NODES_PX2 else (_NODES8, _WEIGHTS8)
    inverse = ellipse.inverse(frame.S[0], frame.S[1], frame.S[2])
    scale = spot[FLUX] / (2 * np.pi * sqrt(frame.S[0] * frame.S[2] - frame.S[1] ** 2))
    J = np.ones(9)
    for p in range(9):
        b[p] = 0.0
        for q in range(9):
            N[p, q] = 0.0
    for r in range(window.rows):
        dv = frame.v0 + r
        _moments_of_row(frame, inverse, dv, nodes, weights, scale, window.columns, cells)
        _weigh(window, r, frame, spot, noise, cells[NODES, : window.columns], cells)
        J[8] = dv / frame.sv
        for j in range(window.columns):
            for p in range(6):
                J[p] = cells[NODES + p, j]
            J[7] = (frame.u0 + j) / frame.su
            w, residual = cells[WEIGHT, r * window.columns + j], cells[RESIDUAL, r * window.columns + j]
            for p in range(9):
                wp = w * J[p]
                b[p] += wp * residual
                for q in range(p + 1):
                    N[p, q] += wp * J[q]
    for p in range(9):
        for q in range(p):
            N[q, p] = N[p, q]
    return _chi_square(window, cells)


@compiled
def _moments_of_row(
    frame: PolynomialFrame, inverse: tuple[float, float, float], dv: float, nodes: Array, weights: Array, scale: float,
    columns: int, cells: Array,
) -> None:  # fmt: skip
    """Pixel means of the light times 1, x, y, x^2, x y, y^2 along a row of pixels, into cells[NODES:].

    Beyond _NEGLIGIBLE sigmas from the centre they are below the rounding of the sums, and 0.
    """
    row, line = cells[ROW, :columns], cells[LINE : LINE + 3, :columns]
    for p in range(NODES, NODES + 6):
        for j in range(columns):
            cells[p, j] = 0.0
    if abs(dv) - 0.5 > _NEGLIGIBLE * frame.sv:
        return
    narrow = 1.0 / frame.su
    for k in range(nodes.shape[0]):
        v = dv + nodes[k]
        y = v / frame.sv
        for j in range(columns):
            line[0, j] = line[1, j] = line[2, j] = 0.0
        for m in range(nodes.shape[0]):
            u = frame.u0 + nodes[m]
            gaussian_row(inverse, u, v, 1.0, row)
            share = scale * weights[k] * weights[m]
            for j in range(columns):
                x, g = (u + j) * narrow, share * row[j]
                line[0, j] += g
                line[1, j] += g * x
                line[2, j] += g * x * x
        for j in range(columns):
            cells[NODES, j] += line[0, j]
            cells[NODES + 1, j] += line[1, j]
            cells[NODES + 2, j] += line[0, j] * y
            cells[NODES + 3, j] += line[2, j]
            cells[NODES + 4, j] += line[1, j] * y
            cells[NODES + 5, j] += line[0, j] * y * y


@compiled
def add_light(window: Window, spot: Array, row: Array, out: Array) -> None:
    """Add the light of another spot (9,), DN, to the cells (cells,) of a window."""
    pixel = window.cell**2 / 12.0
    S = (spot[UU] + pixel, spot[UV], spot[VV] + pixel)
    inverse = ellipse.inverse(S[0], S[1], S[2])
    scale = spot[FLUX] / (2 * np.pi * sqrt(S[0] * S[2] - S[1] ** 2))
    middle = 0.5 * (window.cell - 1)
    u0, v0 = window.left + middle - spot[U], window.top + middle - spot[V]
    line = row[: window.columns]
    for r in range(window.rows):
        gaussian_row(inverse, u0, v0 + r * window.cell, float(window.cell), line)
        for j in range(window.columns):
            out[r * window.columns + j] += scale * line[j]


@compiled
def solve_normal(N: Array, X: Array, right_sides: int, L: Array) -> bool:
    """Solve N X = B for the first columns of X, in place; X contains the right sides. L (9, 10) is workspace.

    N is scaled to a unit diagonal and 1e-9 is added to it, which matters only in degenerate cases. Returns False if N
    is not positive definite.
    """
    n = 9
    scale = L[:, n]
    for i in range(n):
        scale[i] = 1.0 / (sqrt(max(N[i, i], 0.0)) + 1e-150)
    for i in range(n):
        for j in range(i + 1):
            total = N[i, j] * scale[i] * scale[j] + (1e-9 if i == j else 0.0)
            for m in range(j):
                total -= L[i, m] * L[j, m]
            if i == j:
                if not total > 0.0:
                    return False
                L[i, i] = sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    for c in range(right_sides):
        for i in range(n):
            total = X[i, c] * scale[i]
            for m in range(i):
                total -= L[i, m] * X[m, c]
            X[i, c] = total / L[i, i]
        for i in range(n - 1, -1, -1):
            total = X[i, c]
            for m in range(i + 1, n):
                total -= L[m, i] * X[m, c]
            X[i, c] = total / L[i, i]
        for i in range(n):
            X[i, c] *= scale[i]
    return True
