"""The weighted least-squares problem of one spot: an elliptical Gaussian on a background plane, in a window.

Linearised, the model is a Gaussian times a polynomial of second degree in the place (which spans the derivatives by
centre, shape and flux) and a plane. So the normal matrix consists of moments of weight, weight times light and weight
times squared light, up to the fourth degree; those are summed row by row, where the row's v is a constant. That takes 18
products per cell, where nine columns would take 54.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array
from geometry.compiled import compiled
from tracking.detection import ellipse
from tracking.detection.candidates import Noise
from tracking.detection.gaussian import gaussian_row
from tracking.detection.pixels import VALID, Window

EXACT_PX2 = 0.9**2  # narrower spots are integrated over the pixels numerically
U, V, UU, UV, VV, FLUX, LEVEL, SLOPE_U, SLOPE_V = range(9)  # a spot's parameters: px, px^2, DN, DN at the centre, DN/px
_POWERS_U, _POWERS_V = (0, 1, 0, 2, 1, 0), (0, 0, 1, 0, 1, 2)
_EDGEWORTH = 0.4  # 1/variance times cell^2 from which the pixels' fourth cumulant shows

# Gauss-Legendre nodes and weights on [-1/2, 1/2] for 4 and 8 points: exact to 1e-5 of the peak at sigma 0.5 and 0.2 px.
_FOUR = np.polynomial.legendre.leggauss(4)
_EIGHT = np.polynomial.legendre.leggauss(8)
_NODES4, _WEIGHTS4, _NODES8, _WEIGHTS8 = _FOUR[0] / 2, _FOUR[1] / 2, _EIGHT[0] / 2, _EIGHT[1] / 2


class Cells(NamedTuple):
    """One window's cells, (cells,) each; room for the largest."""

    values: Array  # DN
    state: NDArray[np.int8]
    others: Array  # DN, light of the neighbours
    light: Array  # DN, of the spot
    weight: Array  # 1/DN^2, 0 where a cell does not count
    residual: Array  # DN
    use: NDArray[np.int8]  # 0: left out as a hot or dead pixel
    nodes: Array  # (6, columns): the exact integral's moments along a row
    row: Array  # (columns,)

    @staticmethod
    def of(most: int, columns: int) -> Cells:
        """Room for so many cells, so many in a row."""

        def room() -> Array:
            return np.zeros(most)

        flags = np.zeros(most, np.int8)
        return Cells(
            room(), flags, room(), room(), room(), room(), flags.copy(), np.zeros((6, columns)), np.zeros(columns)
        )


class Frame(NamedTuple):
    """What coordinates the polynomial is written in: from the spot's centre, in units of its widths."""

    u0: float  # px, the first cell's centre from the spot's
    v0: float
    su: float  # px
    sv: float
    S: tuple[float, float, float]  # px^2: covariance of what the cells show
    exact: bool


@compiled
def frame_of(window: Window, spot: Array) -> Frame:
    """The frame of a spot (9,) in a window."""
    middle, pixel = 0.5 * (window.cell - 1), window.cell**2 / 12.0
    exact = window.cell == 1 and ellipse.eigenvalues(spot[UU], spot[UV], spot[VV])[0] < EXACT_PX2
    if exact:
        pixel = 0.0
    S = (spot[UU] + pixel, spot[UV], spot[VV] + pixel)
    return Frame(window.left + middle - spot[U], window.top + middle - spot[V], sqrt(S[0]), sqrt(S[2]), S, exact)


@compiled
def accumulate(window: Window, spot: Array, noise: Noise, cells: Cells, N: Array, b: Array) -> float:
    """Fill the normal matrix N (9, 9) and right side b (9,) at a spot (9,), and the cells' light, weight and residual.

    Columns: 1, x, y, x^2, x y, y^2 times the light, then 1, x, y, in the coordinates of `frame_of`. Cells are weighted by
    the noise at the fitted level: weights from the noisy values would pull the fit down. Returns chi-square.
    """
    frame = frame_of(window, spot)
    if frame.exact:
        return _accumulate_exact(window, frame, spot, noise, cells, N, b)
    A = np.zeros((3, 5, 5))  # moments of weight light^0, ^1 and ^2, by powers of x and y
    R = np.zeros((2, 3, 3))  # of weight residual light^0 and ^1
    inverse = ellipse.inverse(*frame.S)
    cell = float(window.cell)
    scale = spot[FLUX] / (2 * np.pi * sqrt(frame.S[0] * frame.S[2] - frame.S[1] ** 2))
    narrow = max(inverse[0], inverse[2]) * cell * cell > _EDGEWORTH
    row = cells.row[: window.columns]
    chi2 = 0.0
    for r in range(window.rows):
        dv = frame.v0 + r * cell
        first = r * window.columns
        gaussian_row(inverse, frame.u0, dv, cell, row)
        if narrow:
            _integrate_row(inverse, frame.u0, dv, cell, row)
        a0 = a1 = a2 = a3 = a4 = b0 = b1 = b2 = b3 = c0 = c1 = c2 = d0 = d1 = d2 = e0 = e1 = 0.0
        for j in range(window.columns):
            k = first + j
            du = frame.u0 + j * cell
            light = scale * row[j]
            w, rest = _weigh(cells, k, light, spot[LEVEL] + spot[SLOPE_U] * du + spot[SLOPE_V] * dv, noise, cell)
            x = du / frame.su
            x2 = x * x
            wl = w * light
            wll, wr, wlr = wl * light, w * rest, wl * rest
            chi2 += wr * rest
            a0 += wll
            a1 += wll * x
            a2 += wll * x2
            a3 += wll * x2 * x
            a4 += wll * x2 * x2
            b0 += wl
            b1 += wl * x
            b2 += wl * x2
            b3 += wl * x2 * x
            c0 += w
            c1 += w * x
            c2 += w * x2
            d0 += wlr
            d1 += wlr * x
            d2 += wlr * x2
            e0 += wr
            e1 += wr * x
        y = dv / frame.sv
        power = 1.0
        for q in range(5):
            A[2, 0, q] += power * a0
            A[2, 1, q] += power * a1
            A[2, 2, q] += power * a2
            A[2, 3, q] += power * a3
            A[2, 4, q] += power * a4
            A[1, 0, q] += power * b0
            A[1, 1, q] += power * b1
            A[1, 2, q] += power * b2
            A[1, 3, q] += power * b3
            if q < 3:
                A[0, 0, q] += power * c0
                A[0, 1, q] += power * c1
                A[0, 2, q] += power * c2
                R[1, 0, q] += power * d0
                R[1, 1, q] += power * d1
                R[1, 2, q] += power * d2
                R[0, 0, q] += power * e0
                R[0, 1, q] += power * e1
            power *= y
    _fill(A, R, N, b)
    return chi2


@compiled
def _weigh(cells: Cells, k: int, light: float, plane: float, noise: Noise, cell: float) -> tuple[float, float]:
    """Weight and residual of a cell, which are kept."""
    level = light + plane + cells.others[k]
    rest = cells.values[k] - level
    w = 0.0
    if cells.state[k] == VALID and cells.use[k]:
        w = cell * cell / (noise.floor + noise.slope * max(level - noise.black, 0.0))
    cells.light[k], cells.weight[k], cells.residual[k] = light, w, rest
    return w, rest


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
    """Take point values, of a Gaussian that has the pixels' variance already, to the pixels' means.

    The square's fourth cumulant, -cell^4/120, enters as an Edgeworth term. Against the exact integral the error is below
    0.05 % of the peak from sigma 0.8 px on (a test says so).
    """
    share = cell**4 / 2880.0
    for j in range(row.shape[0]):
        du = u0 + j * cell
        wu, wv = a[0] * du + a[1] * v, a[1] * du + a[2] * v
        fourth = wu**4 - 6 * a[0] * wu * wu + 3 * a[0] * a[0] + wv**4 - 6 * a[2] * wv * wv + 3 * a[2] * a[2]
        row[j] *= max(1.0 - share * fourth, 0.0)


@compiled
def _accumulate_exact(
    window: Window, frame: Frame, spot: Array, noise: Noise, cells: Cells, N: Array, b: Array
) -> float:
    """The same for a spot so narrow that its light and the derivatives are integrated over each pixel by nodes."""
    low = ellipse.eigenvalues(spot[UU], spot[UV], spot[VV])[0]
    nodes, weights = (_NODES4, _WEIGHTS4) if low > 0.4**2 else (_NODES8, _WEIGHTS8)
    inverse = ellipse.inverse(*frame.S)
    scale = spot[FLUX] / (2 * np.pi * sqrt(frame.S[0] * frame.S[2] - frame.S[1] ** 2))
    J = np.empty(9)
    J[6] = 1.0
    for p in range(9):
        b[p] = 0.0
        for q in range(9):
            N[p, q] = 0.0
    chi2 = 0.0
    for r in range(window.rows):
        dv = frame.v0 + r
        _moments_of_row(frame, inverse, dv, nodes, weights, window.columns, cells)
        for j in range(window.columns):
            for p in range(6):
                J[p] = scale * cells.nodes[p, j]
            du = frame.u0 + j
            plane = spot[LEVEL] + spot[SLOPE_U] * du + spot[SLOPE_V] * dv
            w, rest = _weigh(cells, r * window.columns + j, J[0], plane, noise, 1.0)
            J[7], J[8] = du / frame.su, dv / frame.sv
            chi2 += w * rest * rest
            for p in range(9):
                wp = w * J[p]
                b[p] += wp * rest
                for q in range(p + 1):
                    N[p, q] += wp * J[q]
    for p in range(9):
        for q in range(p):
            N[q, p] = N[p, q]
    return chi2


@compiled
def _moments_of_row(
    frame: Frame, inverse: tuple[float, float, float], dv: float, nodes: Array, weights: Array, columns: int,
    cells: Cells,
) -> None:  # fmt: skip
    """Pixel means of the Gaussian times 1, x, y, x^2, x y, y^2 along a row of pixels, into cells.nodes."""
    row = cells.row[:columns]
    for p in range(6):
        for j in range(columns):
            cells.nodes[p, j] = 0.0
    for k in range(nodes.shape[0]):
        v = dv + nodes[k]
        y = v / frame.sv
        for m in range(nodes.shape[0]):
            u = frame.u0 + nodes[m]
            gaussian_row(inverse, u, v, 1.0, row)
            share = weights[k] * weights[m]
            for j in range(columns):
                x = (u + j) / frame.su
                g = share * row[j]
                cells.nodes[0, j] += g
                cells.nodes[1, j] += g * x
                cells.nodes[2, j] += g * y
                cells.nodes[3, j] += g * x * x
                cells.nodes[4, j] += g * x * y
                cells.nodes[5, j] += g * y * y


@compiled
def add_light(window: Window, spot: Array, row: Array, out: Array) -> None:
    """Add the light of another spot (9,), DN, to the cells (cells,) of a window."""
    pixel = window.cell**2 / 12.0
    S = (spot[UU] + pixel, spot[UV], spot[VV] + pixel)
    inverse = ellipse.inverse(*S)
    scale = spot[FLUX] / (2 * np.pi * sqrt(S[0] * S[2] - S[1] ** 2))
    middle = 0.5 * (window.cell - 1)
    u0, v0 = window.left + middle - spot[U], window.top + middle - spot[V]
    line = row[: window.columns]
    for r in range(window.rows):
        gaussian_row(inverse, u0, v0 + r * window.cell, float(window.cell), line)
        for j in range(window.columns):
            out[r * window.columns + j] += scale * line[j]


@compiled
def solve_normal(N: Array, X: Array, L: Array) -> bool:
    """Solve N X = B for the columns of X (9, k), in place; X holds the right sides. L (9, 10) is room to work in.

    N is scaled to a unit diagonal, with 1e-9 added to it, which only keeps hopeless cases finite. False if it is not
    positive definite.
    """
    n, k = X.shape
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
    for c in range(k):
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
