"""The Gaussian fit of all candidates of a picture, each with the light of its neighbours subtracted."""

from __future__ import annotations

from math import ceil, pi, sqrt

import numpy as np

from geometry.arrays import Array
from geometry.compilation.jit import compiled
from tracking.detection import ellipse
from tracking.detection.ellipse import gaussian_window
from tracking.detection.narrow_light import PolynomialFrame, frame_of, variance_of_wings
from tracking.detection.normal_equations import accumulate, solve_normal
from tracking.detection.pixels import VALID, Noise, Pixels, Window, insert_nearest, read_window, window_around
from tracking.detection.quality import assess_fit, exclude_isolated_cells, gain_over_plane
from tracking.detection.table import (
    FACTOR,
    GAPS,
    NEAR,
    NEIGHBOUR_LIGHT,
    NORMAL,
    RIGHT_SIDE,
    ROW,
    SOLUTION,
    STATE,
    USE,
    VALUES,
    VECTORS,
    Candidate,
    Candidates,
)

_STEPS = 12  # Gauss-Newton converges in three or four; a clipped spot, whose top is extrapolated, needs up to ten
_CONVERGED, _CONVERGED_MOST = 0.1, 0.4  # of the centre's own sigma: a smaller step is the last one
_SETTLED = 0.02  # largest last step of the coefficients of the shape, half the relative change of the variance
_CURVED = 0.02  # the next step is about step^2 / (2 width); it may be a hundredth of the sigma
_WINDOW = 3.7  # sigmas from centre to side of the window: with 3.2 (2.5) the plane costs 3 % (8 %) of the accuracy
_WINDOW_WIDE, _WIDE_PX = 3.2, 4.5  # ... of spots wider than this, whose background is not a plane over more
_LEAST_HALF = 7  # cells from the centre to the side of the window
REACHES = (150.0, 40.0, 80.0, 150.0, 150.0)  # px, see `reach_of`
_MOST_NEIGHBOURS = 6  # neighbours whose light is subtracted
_LEAST_VARIANCE = 0.02  # px^2: narrower spots cannot be distinguished from a point


@compiled
def fit_all(
    image: Pixels, table: Candidates, noise: Noise, saturation: float, max_sigma: float, min_gain: float, again: bool,
    together: bool, cells: Array, algebra: Array,
) -> None:  # fmt: skip
    """Fit all candidates of a picture (n,) together, in place, starting from their moments.

    Gauss-Newton steps until the centres converge; clipped pixels, pixels outside and hot pixels are excluded, and the
    light of the neighbours is subtracted. A candidate that grows beyond `max_sigma`, px, diverges, or lowers chi-square
    by less than `min_gain` is rejected: its flux becomes 0. again: only the active ones start from their moments; the
    others have been fitted. together: these are fitted further where the light of a neighbour has changed; otherwise
    they stay as they are.
    """
    n = table.shape[0]
    for i in range(n):
        spot = table[i]
        if again and not spot["active"]:
            continue
        spot["u"], spot["v"], spot["uu"], spot["uv"] = (
            spot["moment_u"],
            spot["moment_v"],
            spot["moment_uu"],
            spot["moment_uv"],
        )
        spot["vv"], spot["level"], spot["active"] = spot["moment_vv"], spot["background"], 1.0
        spot["slope_u"] = spot["slope_v"] = 0.0
        spot["flux"] = max(spot["flux"], 1.0)
        if _has_diverged(spot, max_sigma):  # moments overestimate rather than underestimate the width
            spot["flux"], spot["active"] = 0.0, 0.0
    for step in range(_STEPS):
        changed = False
        for i in range(n):
            spot = table[i]
            if not spot["active"]:
                continue
            spot["active"], spot["cell_size"] = 0.0, max(spot["cell_size"], 1.0 * window_of(spot).cell)
            moved = _step(image, table, i, noise, saturation, step == _STEPS - 1, cells, algebra)
            # Further steps do not turn noise into a spot.
            if _has_diverged(spot, max_sigma) or (step >= 1 and spot["gain"] < min_gain):
                spot["flux"] = 0.0
            if spot["flux"] <= 0.0:
                moved = True
            elif moved:
                spot["active"] = 1.0
            changed = changed or moved
            if moved and together:
                _reactivate_neighbours(table, i)
        if not changed:
            break


@compiled
def _has_diverged(spot: Candidate, max_sigma: float) -> bool:
    """Whether a spot has become too wide, or too far from its moments for their width and its own."""
    major = ellipse.axes(spot["uu"], spot["uv"], spot["vv"])[0]
    if major > 1.5 * max_sigma:
        return True
    away = sqrt((spot["u"] - spot["moment_u"]) ** 2 + (spot["v"] - spot["moment_v"]) ** 2)
    return away > 3.0 + max(2.0 * ellipse.axes(spot["moment_uu"], spot["moment_uv"], spot["moment_vv"])[0], major)


@compiled
def _step(
    image: Pixels, table: Candidates, i: int, noise: Noise, saturation: float, last: bool, cells: Array, algebra: Array
) -> bool:
    """One Gauss-Newton step of one spot; whether it needs another one."""
    spot, X, b = table[i], algebra[SOLUTION], algebra[VECTORS, RIGHT_SIDE]
    window = window_of(spot)
    read_window(image, window, saturation, cells[VALUES], cells[STATE])
    for k in range(window.columns * window.rows):
        cells[NEIGHBOUR_LIGHT, k] = 0.0
        cells[USE, k] = 1.0 if cells[STATE, k] == VALID else 0.0
    near, gaps = algebra[VECTORS, NEAR], algebra[VECTORS, GAPS]
    for k in range(_neighbours(table, i, window, near, gaps)):
        _add_light(window, table[int(near[k])], cells[ROW], cells[NEIGHBOUR_LIGHT])
    chi2 = accumulate(window, spot, noise, cells, algebra)
    if exclude_isolated_cells(window, spot, cells):
        chi2 = accumulate(window, spot, noise, cells, algebra)
    frame = frame_of(window, spot)
    if not _solve(frame, spot["held"] > 0.0, algebra):
        spot["flux"] = 0.0
        return True
    before_u, before_v = spot["u"], spot["v"]
    var_u, var_v, cov_uv = _centre_covariance(frame, X)
    sigma_flux = spot["flux"] * sqrt(_flux_variance(frame, X))
    after = chi2
    for p in range(9):
        after -= X[p, 0] * b[p]
    spot["gain"] = gain_over_plane(algebra[NORMAL], b, chi2, after)
    _advance(frame, spot, X)
    du, dv = spot["u"] - before_u, spot["v"] - before_v
    moved = _needs_another_step(du, var_u, spot["uu"]) or _needs_another_step(dv, var_v, spot["vv"])
    if variance_of_wings(spot) > 0.0:  # their start is far from the shape
        moved = moved or max(abs(X[3, 0]), abs(X[4, 0]), abs(X[5, 0])) > _SETTLED
    if not moved or last:
        spot["var_u"], spot["cov_uv"], spot["var_v"], spot["sigma_flux"] = var_u, cov_uv, var_v, sigma_flux
        assess_fit(window, frame, after, noise, cells, spot)
        if moved:  # the last step is added to the uncertainty of a centre that has not converged
            spot["var_u"], spot["cov_uv"] = spot["var_u"] + du * du, spot["cov_uv"] + du * dv
            spot["var_v"] += dv * dv
    return moved and not last


@compiled
def _add_light(window: Window, spot: Candidate, lights: Array, out: Array) -> None:
    """Add the light of another spot (9,), DN, to the cells (cells,) of a window. lights (cells,) is workspace."""
    pixel = window.cell**2 / 12.0
    S = (spot["uu"] + pixel, spot["uv"], spot["vv"] + pixel)
    inverse = ellipse.inverse(S[0], S[1], S[2])
    scale = spot["flux"] / (2 * pi * sqrt(S[0] * S[2] - S[1] ** 2))
    middle = 0.5 * (window.cell - 1)
    u0, v0 = window.left + middle - spot["u"], window.top + middle - spot["v"]
    light = lights[: window.rows * window.columns]
    gaussian_window(inverse, u0, v0, float(window.cell), window.columns, light)
    for k in range(light.shape[0]):
        out[k] += scale * light[k]


@compiled
def least_variance(spot: Candidate) -> float:
    """The least variance, px^2, of a spot in any direction: that of its wings is part of it."""
    return _LEAST_VARIANCE + variance_of_wings(spot)


@compiled
def _needs_another_step(step: float, variance: float, width2: float) -> bool:
    """Whether another Gauss-Newton step is needed after this one; the error falls with the square of the step."""
    sigma = sqrt(variance)
    return abs(step) > max(_CONVERGED * sigma, min(_CONVERGED_MOST * sigma, sqrt(_CURVED * sigma * sqrt(width2))))


@compiled
def _half_width(variance: float) -> float:
    """Half width, px, of the window for a spot of this variance, px^2: its wings and a ring of background."""
    sigma = sqrt(variance + 1 / 12.0)
    return max(min(_WINDOW * sigma, _WINDOW * _WIDE_PX), _WINDOW_WIDE * sigma) + 1.0


@compiled
def window_of(spot: Candidate) -> Window:
    """The window of a spot: a rectangle, with larger cells for wide spots."""
    half_u, half_v = _half_width(spot["uu"]), _half_width(spot["vv"])
    half = max(half_u, half_v)
    cell, most = 1, 18
    if half > 18:
        # A long streak has cells of two pixels as well, because four would blur its narrow side.
        slim = ellipse.eigenvalues(spot["uu"], spot["uv"], spot["vv"])[0] < 9.0
        cell, most = (2, 36) if half <= 36 or slim else (4, 24)
    columns = ceil(min(max(half_u / cell, _LEAST_HALF), most))
    rows = ceil(min(max(half_v / cell, _LEAST_HALF), most))
    return window_around(spot["u"], spot["v"], columns, rows, cell)


@compiled
def reach_of(cell: int) -> float:
    """The largest distance, px, of another spot that affects the measurement of a spot with this cell size."""
    return REACHES[cell]


@compiled
def _gap(spot: Candidate, other: Candidate, window: Window) -> float:
    """Pixels between the window of a spot and the light of another one; negative if the light reaches the window."""
    du, dv = abs(spot["u"] - other["u"]), abs(spot["v"] - other["v"])
    if max(du, dv) >= reach_of(window.cell):
        return np.inf
    gap_u = du - 0.5 * window.cell * window.columns - 1.25 * _half_width(other["uu"])
    gap_v = dv - 0.5 * window.cell * window.rows - 1.25 * _half_width(other["vv"])
    return max(gap_u, gap_v)


@compiled
def _neighbours(table: Candidates, i: int, window: Window, near: Array, gaps: Array) -> int:
    """The spots whose light reaches farthest into a window, into `near`; returns their number."""
    filled = 0
    for j in range(table.shape[0]):
        far = max(abs(table[j]["u"] - table[i]["u"]), abs(table[j]["v"] - table[i]["v"])) >= reach_of(window.cell)
        if j == i or far or table[j]["flux"] <= 0.0:
            continue
        gap = _gap(table[i], table[j], window)
        if gap < 0:
            filled = insert_nearest(near, gaps, filled, _MOST_NEIGHBOURS, gap, j)
    return filled


@compiled
def _reactivate_neighbours(table: Candidates, i: int) -> None:
    """Mark the spots into whose windows spot i shines to be fitted again, because it has moved."""
    for j in range(table.shape[0]):
        far = max(abs(table[j]["u"] - table[i]["u"]), abs(table[j]["v"] - table[i]["v"])) >= reach_of(4)
        if j == i or far or table[j]["active"] or table[j]["flux"] <= 0.0:
            continue
        if _gap(table[j], table[i], window_of(table[j])) < 0:
            table[j]["active"] = 1.0


@compiled
def _solve(frame: PolynomialFrame, held: bool, algebra: Array) -> bool:
    """Fill the columns of X: the step, and N^-1 times the gradients of the centre's u' and v' and of the flux."""
    X = algebra[SOLUTION]
    if held:
        _hold_shape(algebra)
    for p in range(9):
        X[p, 0] = algebra[VECTORS, RIGHT_SIDE, p]
        X[p, 1] = X[p, 2] = X[p, 3] = 0.0
    X[1, 1], X[2, 2] = 1.0, 1.0
    _flux_direction(frame, X, 3)
    if held:
        X[3, 3] = X[4, 3] = X[5, 3] = 0.0
    return solve_normal(algebra[NORMAL], X, 4, algebra[FACTOR])


@compiled
def _hold_shape(algebra: Array) -> None:
    """Take the coefficients of the shape out of the normal equations."""
    N, b = algebra[NORMAL], algebra[VECTORS, RIGHT_SIDE]
    for p in range(3, 6):
        b[p] = 0.0
        for q in range(9):
            N[p, q] = N[q, p] = 0.0
        N[p, p] = 1.0


@compiled
def _flux_direction(frame: PolynomialFrame, X: Array, column: int) -> None:
    """The gradient of the relative flux with respect to the coefficients."""
    X[0, column] = 1.0
    X[3, column] = frame.S[0] / frame.su**2
    X[4, column] = frame.S[1] / (frame.su * frame.sv)
    X[5, column] = frame.S[2] / frame.sv**2


@compiled
def _centre_covariance(frame: PolynomialFrame, X: Array) -> tuple[float, float, float]:
    """var(u), var(v), cov(u, v), px^2: the Cramer-Rao bound of the model."""
    a, b, c = X[1, 1] / frame.su**2, X[1, 2] / (frame.su * frame.sv), X[2, 2] / frame.sv**2
    p, q, r = frame.S
    return (
        p * p * a + 2 * p * q * b + q * q * c,
        q * q * a + 2 * q * r * b + r * r * c,
        p * q * a + (p * r + q * q) * b + q * r * c,
    )


@compiled
def _flux_variance(frame: PolynomialFrame, X: Array) -> float:
    """Relative variance of the flux."""
    relative = (
        X[0, 3]
        + X[3, 3] * frame.S[0] / frame.su**2
        + X[4, 3] * frame.S[1] / (frame.su * frame.sv)
        + X[5, 3] * frame.S[2] / frame.sv**2
    )
    return max(relative, 0.0)


@compiled
def _advance(frame: PolynomialFrame, spot: Candidate, X: Array) -> None:
    """Apply the step, limited to one sigma of the spot in length, a factor 2.5 in its variances and 5 in its flux.

    With light F (1 + f) and a step d of the centre, the coefficient of the derivative is (1 + f) d, not d.
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
    base = (spot["uu"] + pixel, spot["uv"], spot["vv"] + pixel)
    uu, uv, vv = ellipse.clip_in_metric(
        (base[0] + more * duu, base[1] + more * duv, base[2] + more * dvv), base, 0.4, 2.5
    )
    short = 1.0 / max(ellipse.mahalanobis(du, dv, base[0], base[1], base[2]), 1.0)
    du, dv = short * du, short * dv
    spot["uu"], spot["uv"], spot["vv"] = ellipse.clip_eigenvalues(
        uu - pixel, uv, vv - pixel, least_variance(spot), np.inf
    )
    spot["slope_u"] += X[7, 0] / su
    spot["slope_v"] += X[8, 0] / sv
    spot["level"] += X[6, 0] + spot["slope_u"] * du + spot["slope_v"] * dv
    spot["u"] += du
    spot["v"] += dv
    spot["flux"] *= 1.0 + f
