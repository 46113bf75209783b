"""Measuring candidates: all of a picture are fitted together, each with its neighbours' light taken off."""

from __future__ import annotations

from math import ceil, sqrt
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compiled import compiled
from tracking.detection import ellipse
from tracking.detection.candidates import Noise
from tracking.detection.normal_equations import (
    FLUX,
    LEVEL,
    SLOPE_U,
    SLOPE_V,
    UU,
    UV,
    VV,
    Cells,
    Frame,
    U,
    V,
    accumulate,
    add_light,
    frame_of,
    solve_normal,
)
from tracking.detection.pixels import Pixels, Window, cut, window_around
from tracking.detection.quality import COV_UV, SIGMA_FLUX, VAR_U, VAR_V, judge

_STEPS = 12  # Gauss-Newton converges in three or four; a clipped spot, whose top must be guessed, takes up to ten
_CONVERGED = 0.1  # of the centre's own sigma. The next step would be some hundredths of this one
_WINDOW = 3.2  # sigmas from centre to the window's side
_LEAST_HALF = 7  # cells from the centre to the side
_MOST_NEIGHBOURS = 6
_OUTLIER = 6.0  # sigmas by which a hot or dead pixel sticks out of the fit
_LONELY = 2.5  # times its neighbours does it
_LEAST_VARIANCE = 0.02  # px^2: narrower is a point to any sensor
MOST_CELLS, MOST_COLUMNS = 73 * 73, 73


class Work(NamedTuple):
    """Room to work in."""

    cells: Cells
    N: Array  # (9, 9)
    b: Array  # (9,)
    X: Array  # (9, 4)
    L: Array  # (9, 10)
    near: Ints  # (_MOST_NEIGHBOURS,)
    gaps: Array  # (_MOST_NEIGHBOURS,)

    @staticmethod
    def new() -> Work:
        """All of it."""
        return Work(
            Cells.of(MOST_CELLS, MOST_COLUMNS), np.zeros((9, 9)), np.zeros(9), np.zeros((9, 4)), np.zeros((9, 10)),
            np.zeros(_MOST_NEIGHBOURS, np.int64), np.zeros(_MOST_NEIGHBOURS),
        )  # fmt: skip


@compiled
def fit_all(
    image: Pixels, spots: Array, noise: Noise, saturation: float, widest: float, work: Work, active: Ints,
    start: Array, span: Ints, quality: Array,
) -> None:  # fmt: skip
    """Fit all candidates of a picture together, in place: spots (n, 9), see normal_equations.U to SLOPE_V.

    Gauss-Newton as long as the centres move; clipped pixels, pixels outside and hot pixels are left out; the light of
    the neighbours is taken off. A candidate that grows beyond `widest`, px, or walks away is given up: its flux is 0.
    active (n,) and start (n, 3) are room to work in; span (n,) is raised to the size of the cells used, px; quality
    (n, COLUMNS) is filled as quality.judge says.
    """
    n = spots.shape[0]
    for i in range(n):
        major = ellipse.axes(spots[i, UU], spots[i, UV], spots[i, VV])[0]
        start[i, 0], start[i, 1], start[i, 2] = spots[i, U], spots[i, V], 3.0 + 2.0 * major
        active[i] = 1
        if major > 1.5 * widest:  # moments see a spot too wide rather than too narrow
            spots[i, FLUX], active[i] = 0.0, 0
    for step in range(_STEPS):
        busy = False
        for i in range(n):
            if not active[i]:
                continue
            active[i] = 0
            span[i] = max(span[i], window_of(spots[i]).cell)
            moved = _step(image, spots, i, noise, saturation, work, step == _STEPS - 1, quality)
            away = sqrt((spots[i, U] - start[i, 0]) ** 2 + (spots[i, V] - start[i, 1]) ** 2)
            major = ellipse.axes(spots[i, UU], spots[i, UV], spots[i, VV])[0]
            if major > 1.5 * widest or away > start[i, 2]:
                spots[i, FLUX], moved = 0.0, True
            else:
                active[i] = moved
            if moved:
                busy = True
                _wake_neighbours(spots, i, active)
        if not busy:
            break


@compiled
def _step(
    image: Pixels, spots: Array, i: int, noise: Noise, saturation: float, work: Work, last: bool, quality: Array
) -> bool:
    """One step of one spot; whether it moved by so much that there must be another."""
    spot, cells = spots[i], work.cells
    window = window_of(spot)
    cut(image, window, saturation, cells.values, cells.state)
    count = window.columns * window.rows
    for k in range(count):
        cells.others[k], cells.use[k] = 0.0, 1
    for k in range(_neighbours(spots, i, window, work.near, work.gaps)):
        add_light(window, spots[work.near[k]], cells.row, cells.others)
    chi2 = accumulate(window, spot, noise, cells, work.N, work.b)
    if _leave_out_lonely(window, spot, cells):
        chi2 = accumulate(window, spot, noise, cells, work.N, work.b)
    frame = frame_of(window, spot)
    if not _solve(frame, spot, work):
        spot[FLUX] = 0.0
        return True
    before_u, before_v = spot[U], spot[V]
    var_u, var_v, cov_uv = _centre_covariance(frame, work.X)
    var_flux = _flux_variance(frame, spot, work)
    gain = 0.0
    for p in range(9):
        gain += work.X[p, 0] * work.b[p]
    _advance(frame, spot, work.X)
    du, dv = spot[U] - before_u, spot[V] - before_v
    moved = abs(du) > _CONVERGED * sqrt(var_u) or abs(dv) > _CONVERGED * sqrt(var_v)
    if not moved or last:
        out = quality[i]
        out[VAR_U], out[COV_UV], out[VAR_V], out[SIGMA_FLUX] = var_u, cov_uv, var_v, sqrt(var_flux)
        judge(window, frame, cells, work.N, work.b, chi2, chi2 - gain, out)
        if moved:  # a centre that still moves is known no better than by that
            out[VAR_U], out[COV_UV], out[VAR_V] = out[VAR_U] + du * du, out[COV_UV] + du * dv, out[VAR_V] + dv * dv
    return moved and not last


@compiled
def _half_width(variance: float) -> float:
    """Half width, px, of the window for a spot: its wings and a ring of background."""
    return _WINDOW * sqrt(variance + 1 / 12.0) + 1.0


@compiled
def window_of(spot: Array) -> Window:
    """The window that a spot (9,) needs. One long in u or v only gets a rectangle."""
    half_u, half_v = _half_width(spot[UU]), _half_width(spot[VV])
    half = max(half_u, half_v)
    cell, most = 1, 18
    if half > 18:
        # A long streak too has cells of two: four would blur its narrow side.
        slim = ellipse.eigenvalues(spot[UU], spot[UV], spot[VV])[0] < 9.0
        cell, most = (2, 36) if half <= 36 or slim else (4, 24)
    columns = int(ceil(min(max(half_u / cell, _LEAST_HALF), most)))
    rows = int(ceil(min(max(half_v / cell, _LEAST_HALF), most)))
    return window_around(spot[U], spot[V], columns, rows, cell)


@compiled
def reach_of(cell: int) -> float:
    """Pixels from a spot whose windows have such cells at which another one may lie that changes its measurement."""
    return 40.0 if cell == 1 else (80.0 if cell == 2 else 150.0)


@compiled
def _gap(spot: Array, other: Array, window: Window) -> float:
    """Pixels between the window of a spot and the light of another one; negative where that shines in."""
    du, dv = abs(spot[U] - other[U]), abs(spot[V] - other[V])
    if max(du, dv) >= reach_of(window.cell):
        return np.inf
    gap_u = du - 0.5 * window.cell * window.columns - 1.25 * _half_width(other[UU])
    gap_v = dv - 0.5 * window.cell * window.rows - 1.25 * _half_width(other[VV])
    return max(gap_u, gap_v)


@compiled
def _neighbours(spots: Array, i: int, window: Window, near: Ints, gaps: Array) -> int:
    """The spots whose light reaches into a window most, into `near`; their number."""
    filled = 0
    for j in range(spots.shape[0]):
        if j == i or spots[j, FLUX] <= 0.0:
            continue
        gap = _gap(spots[i], spots[j], window)
        if gap >= 0 or (filled == _MOST_NEIGHBOURS and gap >= gaps[_MOST_NEIGHBOURS - 1]):
            continue
        k = min(filled, _MOST_NEIGHBOURS - 1)
        while k > 0 and gaps[k - 1] > gap:
            gaps[k], near[k] = gaps[k - 1], near[k - 1]
            k -= 1
        gaps[k], near[k] = gap, j
        filled = min(filled + 1, _MOST_NEIGHBOURS)
    return filled


@compiled
def _wake_neighbours(spots: Array, i: int, active: Ints) -> None:
    """A spot has moved: those into whose windows it shines must be fitted again."""
    for j in range(spots.shape[0]):
        if j != i and not active[j] and spots[j, FLUX] > 0.0 and _gap(spots[j], spots[i], window_of(spots[j])) < 0:
            active[j] = 1


@compiled
def _leave_out_lonely(window: Window, spot: Array, cells: Cells) -> bool:
    """Take out cells that stick out of the fit and of all eight neighbours: hot or dead pixels, never a spot's body."""
    found = False
    narrow = min(spot[UU], spot[VV]) < 0.8**2
    middle = 0.5 * (window.cell - 1)
    for r in range(window.rows):
        for c in range(window.columns):
            k = r * window.columns + c
            size = cells.residual[k] ** 2 * cells.weight[k]
            if size <= _OUTLIER**2:
                continue
            if narrow:  # the middle of a spot about one pixel wide is lonely by nature
                u = window.left + middle + c * window.cell - spot[U]
                v = window.top + middle + r * window.cell - spot[V]
                if u * u + v * v < 1.8**2:
                    continue
            around = 0.0
            for i in range(max(r - 1, 0), min(r + 2, window.rows)):
                for j in range(max(c - 1, 0), min(c + 2, window.columns)):
                    if i != r or j != c:
                        other = i * window.columns + j
                        around = max(around, cells.residual[other] ** 2 * cells.weight[other])
            if size > _LONELY**2 * around:
                cells.use[k], found = 0, True
    return found


@compiled
def _solve(frame: Frame, spot: Array, work: Work) -> bool:
    """Into the columns of X: the step, and N^-1 times the directions of the centre's u' and v' and of the flux."""
    X = work.X
    for p in range(9):
        X[p, 0] = work.b[p]
        X[p, 1] = X[p, 2] = X[p, 3] = 0.0
    X[1, 1], X[2, 2] = 1.0, 1.0
    _flux_direction(frame, X, 3)
    return solve_normal(work.N, X, work.L)


@compiled
def _flux_direction(frame: Frame, X: Array, column: int) -> None:
    """How the relative flux depends on the coefficients."""
    X[0, column] = 1.0
    X[3, column] = frame.S[0] / frame.su**2
    X[4, column] = frame.S[1] / (frame.su * frame.sv)
    X[5, column] = frame.S[2] / frame.sv**2


@compiled
def _centre_covariance(frame: Frame, X: Array) -> tuple[float, float, float]:
    """var(u), var(v), cov(u, v), px^2: the Cramer-Rao bound of the model."""
    a, b, c = X[1, 1] / frame.su**2, X[1, 2] / (frame.su * frame.sv), X[2, 2] / frame.sv**2
    p, q, r = frame.S
    return (
        p * p * a + 2 * p * q * b + q * q * c,
        q * q * a + 2 * q * r * b + r * r * c,
        p * q * a + (p * r + q * q) * b + q * r * c,
    )


@compiled
def _flux_variance(frame: Frame, spot: Array, work: Work) -> float:
    X = work.X
    relative = (
        X[0, 3]
        + X[3, 3] * frame.S[0] / frame.su**2
        + X[4, 3] * frame.S[1] / (frame.su * frame.sv)
        + X[5, 3] * frame.S[2] / frame.sv**2
    )
    return max(relative, 0.0) * spot[FLUX] ** 2


@compiled
def _advance(frame: Frame, spot: Array, X: Array) -> None:
    """Step, held to one sigma of the spot in length, to a factor 2.5 in its variances and to 5 in its flux.

    With light F (1 + f) and a step d the coefficient of the derivative is (1 + f) d, not d.
    """
    su, sv, S = frame.su, frame.sv, frame.S
    q3, q4, q5 = X[3, 0] / su**2, 0.5 * X[4, 0] / (su * sv), X[5, 0] / sv**2
    f = X[0, 0] + q3 * S[0] + 2.0 * q4 * S[1] + q5 * S[2]
    f = min(max(f, -0.8), 4.0)
    more = 1.0 / (1.0 + f)
    x, y = more * X[1, 0] / su, more * X[2, 0] / sv
    du, dv = S[0] * x + S[1] * y, S[1] * x + S[2] * y
    # dS = 2 S Q S, with Q the polynomial's quadratic form
    a, b = S[0] * q3 + S[1] * q4, S[0] * q4 + S[1] * q5
    c, d = S[1] * q3 + S[2] * q4, S[1] * q4 + S[2] * q5
    duu, duv, dvv = 2 * (a * S[0] + b * S[1]), 2 * (a * S[1] + b * S[2]), 2 * (c * S[1] + d * S[2])
    pixel = 1 / 12.0
    base = (spot[UU] + pixel, spot[UV], spot[VV] + pixel)
    uu, uv, vv = ellipse.kept_within(
        (base[0] + more * duu, base[1] + more * duv, base[2] + more * dvv), base, 0.4, 2.5
    )
    short = 1.0 / max(ellipse.length(du, dv, base[0], base[1], base[2]), 1.0)
    du, dv = short * du, short * dv
    spot[UU], spot[UV], spot[VV] = ellipse.with_eigenvalues(uu - pixel, uv, vv - pixel, _LEAST_VARIANCE, np.inf)
    spot[SLOPE_U] += X[7, 0] / su
    spot[SLOPE_V] += X[8, 0] / sv
    spot[LEVEL] += X[6, 0] + spot[SLOPE_U] * du + spot[SLOPE_V] * dv
    spot[U] += du
    spot[V] += dv
    spot[FLUX] *= 1.0 + f
