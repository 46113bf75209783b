"""A first centre and size of each candidate: moments under a Gaussian window that adapts to what it sees."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array
from geometry.compilation.jit import compiled
from tracking.detection import ellipse
from tracking.detection.candidates import sort
from tracking.detection.gaussian import gaussian_row
from tracking.detection.pixels import OUTSIDE, Pixels, Window, cut, window_around
from tracking.detection.table import (
    FEW,
    FLUX,
    GROUND,
    MOMENT_U,
    MOMENT_UU,
    MOMENT_UV,
    MOMENT_V,
    MOMENT_VV,
    ROW,
    SPAN,
    STATE,
    VALUES,
    WIDE,
)

# Growing windows: half the number of cells, their size, rounds, and the 1-sigma half axis (px) up to which each serves.
_WINDOWS = ((9, 1, 3, 3.5), (18, 2, 5, 9.0), (18, 4, 5, np.inf))
_START, _START_WIDE = 2.0, 16.0  # px^2: variance of the first window


@compiled
def find_moments(image: Pixels, table: Array, cells: Array) -> None:
    """Moments and flux of candidates (n, COLUMNS), starting from MOMENT_U, MOMENT_V, on the background GROUND.

    Good to a tenth of a pixel or so, which is enough to start a fit.
    Source: Bernstein & Jarvis (2002), "Shapes and shears, stars and smears", Astron. J. 123, section 3.
    """
    for i in range(table.shape[0]):
        start = _START_WIDE if table[i, WIDE] else _START
        table[i, MOMENT_UU], table[i, MOMENT_UV], table[i, MOMENT_VV] = start, 0.0, start
    largest = 0.0
    for step in range(3):
        half, cell, rounds, limit = _WINDOWS[step]
        for i in range(table.shape[0]):
            spot = table[i]
            # Who was wide enough for this window at the end of the last one.
            high = ellipse.eigenvalues(spot[MOMENT_UU], spot[MOMENT_UV], spot[MOMENT_VV])[1]
            if (step > 0 and high <= largest) or (step == 0 and spot[WIDE]):
                continue
            spot[SPAN] = cell
            window = window_around(spot[MOMENT_U], spot[MOMENT_V], half, half, cell)
            # Clipped pixels stay in: for a first width and centre a cut top is better than a hole.
            cut(image, window, np.inf, cells[VALUES], cells[STATE])
            ground = spot[GROUND]
            if cell > 1:  # the given background is a median over 40 px: too near to a wide spot
                ground = _median_of_border(window, cells[VALUES], cells[FEW])
            _take_ground(window, table, i, ground, cells[VALUES], cells[STATE])
            for _ in range(rounds):
                spot[FLUX] = cell * cell * _one_round(window, cells[VALUES], spot, cells[ROW])
        largest = limit**2


@compiled
def _median_of_border(window: Window, values: Array, few: Array) -> float:
    n, last = 0, window.rows - 1
    for i in range(window.rows):
        for j in range(window.columns):
            if i == 0 or j == 0 or i == last or j == window.columns - 1:
                few[n] = values[i * window.columns + j]
                n += 1
    sort(few, n)
    return 0.5 * (few[(n - 1) // 2] + few[n // 2])


@compiled
def _take_ground(window: Window, table: Array, i: int, ground: float, values: Array, state: Array) -> None:
    """Light over the background; none in cells outside and in those nearer to another candidate."""
    cells = window.rows * window.columns
    for k in range(cells):
        values[k] = values[k] - ground if state[k] != OUTSIDE else 0.0
    reach = 1.0 * window.cell * window.columns
    middle = 0.5 * (window.cell - 1)
    for j in range(table.shape[0]):
        du, dv = table[j, MOMENT_U] - table[i, MOMENT_U], table[j, MOMENT_V] - table[i, MOMENT_V]
        if j == i or max(abs(du), abs(dv)) >= reach:
            continue
        half = 0.5 * (du * du + dv * dv)
        for row in range(window.rows):
            y = window.top + middle + row * window.cell - table[i, MOMENT_V]
            for column in range(window.columns):
                x = window.left + middle + column * window.cell - table[i, MOMENT_U]
                if x * du + y * dv > half:
                    values[row * window.columns + column] = 0.0


@compiled
def _one_round(window: Window, light: Array, spot: Array, row: Array) -> float:
    """Under a window W a Gaussian S has covariance (1/S + 1/W)^-1; if they are equal, half its offset is seen.

    Half its flux, too. Returns the flux, DN cells.
    """
    pixel = window.cell**2 / 12.0
    W = (spot[MOMENT_UU] + pixel, spot[MOMENT_UV], spot[MOMENT_VV] + pixel)
    narrow = ellipse.inverse(*W)
    middle = 0.5 * (window.cell - 1)
    u0, v0 = window.left + middle - spot[MOMENT_U], window.top + middle - spot[MOMENT_V]
    row = row[: window.columns]
    s0 = su = sv = suu = suv = svv = 0.0
    for r in range(window.rows):
        y = v0 + r * window.cell
        gaussian_row(narrow, u0, y, float(window.cell), row)
        t0 = t1 = t2 = 0.0
        for j in range(window.columns):
            x = u0 + j * window.cell
            a = row[j] * light[r * window.columns + j]
            t0 += a
            t1 += a * x
            t2 += a * x * x
        s0, su, sv = s0 + t0, su + t1, sv + y * t0
        suu, suv, svv = suu + t2, suv + y * t1, svv + y * y * t0
    s0 = max(s0, 1e-9)
    mu, mv = su / s0, sv / s0
    seen = ellipse.kept_within((suu / s0 - mu * mu, suv / s0 - mu * mv, svv / s0 - mv * mv), W, 0.15, 0.75)
    a, b, c = ellipse.inverse(*seen)
    a, b, c = ellipse.inverse(a - narrow[0], b - narrow[1], c - narrow[2])
    short = 2.0 / max(2.0 * ellipse.length(mu, mv, *W), 1.0)
    spot[MOMENT_U] += short * mu
    spot[MOMENT_V] += short * mv
    a, b, c = ellipse.with_eigenvalues(a - pixel, b, c - pixel, 0.1, np.inf)
    spot[MOMENT_UU], spot[MOMENT_UV], spot[MOMENT_VV] = a, b, c
    return 2.0 * s0
