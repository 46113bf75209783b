"""A first centre and size of each candidate: moments under a Gaussian window that adapts to what it sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Ints
from geometry.compiled import compiled
from tracking.detection import ellipse
from tracking.detection.candidates import sort
from tracking.detection.gaussian import gaussian_row
from tracking.detection.pixels import OUTSIDE, Pixels, Window, cut, window_around

# Growing windows: half the number of cells, their size, rounds, and the 1-sigma half axis (px) up to which each serves.
_WINDOWS = ((9, 1, 3, 3.5), (18, 2, 5, 9.0), (18, 4, 5, np.inf))
MOST_CELLS = 37 * 37
_START, _START_WIDE = 2.0, 16.0  # px^2: variance of the first window


@compiled
def find_moments(
    image: Pixels, uv: Array, level: Array, wide: Ints, shape: Array, flux: Array, span: Ints,
    values: Array, state: NDArray[np.int8], few: Array,
) -> None:  # fmt: skip
    """Centres, in place of candidates uv (n, 2), px, shape (n, 3: uu, uv, vv), px^2, and flux (n,), DN; level (n,), DN.

    wide (n,) is 1 for those that only a mean of 8x8 pixels shows. span (n,) becomes the size of the cells used, px.
    Good to a tenth of a pixel or so, which is enough to start a fit. `values`, `state` (cells,), `few` (cells of a
    border,) are room to work in.
    Source: Bernstein & Jarvis (2002), "Shapes and shears, stars and smears", Astron. J. 123, section 3.
    """
    n = uv.shape[0]
    for i in range(n):
        start = _START_WIDE if wide[i] else _START
        shape[i, 0], shape[i, 1], shape[i, 2] = start, 0.0, start
    for step in range(3):
        half, cell, rounds, limit = _WINDOWS[step]
        for i in range(n):
            # Who was wide enough for this window at the end of the last one.
            if step == 0 and wide[i]:
                continue
            if step > 0 and ellipse.eigenvalues(shape[i, 0], shape[i, 1], shape[i, 2])[1] <= _WINDOWS[step - 1][3] ** 2:
                continue
            span[i] = cell
            window = window_around(uv[i, 0], uv[i, 1], half, half, cell)
            # Clipped pixels stay in: for a first width and centre a cut top is better than a hole.
            cut(image, window, np.inf, values, state)
            ground = level[i]
            if cell > 1:  # the given background is a median over 40 px: too near to a wide spot
                ground = _median_of_border(window, values, few)
            _take_ground(window, uv, i, ground, values, state)
            for _ in range(rounds):
                flux[i] = cell * cell * _one_round(window, values, uv, shape, i, few)


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
def _take_ground(window: Window, uv: Array, i: int, ground: float, values: Array, state: NDArray[np.int8]) -> None:
    """Light over the background; none in cells outside and in those nearer to another candidate."""
    cells = window.rows * window.columns
    for k in range(cells):
        values[k] = values[k] - ground if state[k] != OUTSIDE else 0.0
    reach = 1.0 * window.cell * window.columns
    middle = 0.5 * (window.cell - 1)
    for j in range(uv.shape[0]):
        du, dv = uv[j, 0] - uv[i, 0], uv[j, 1] - uv[i, 1]
        if j == i or max(abs(du), abs(dv)) >= reach:
            continue
        half = 0.5 * (du * du + dv * dv)
        for row in range(window.rows):
            y = window.top + middle + row * window.cell - uv[i, 1]
            for column in range(window.columns):
                x = window.left + middle + column * window.cell - uv[i, 0]
                if x * du + y * dv > half:
                    values[row * window.columns + column] = 0.0


@compiled
def _one_round(window: Window, light: Array, uv: Array, shape: Array, i: int, row: Array) -> float:
    """Under a window W a Gaussian S has covariance (1/S + 1/W)^-1; if they are equal, half its offset and flux are seen.

    Returns the flux, DN cells.
    """
    pixel = window.cell**2 / 12.0
    W = (shape[i, 0] + pixel, shape[i, 1], shape[i, 2] + pixel)
    narrow = ellipse.inverse(*W)
    middle = 0.5 * (window.cell - 1)
    u0, v0 = window.left + middle - uv[i, 0], window.top + middle - uv[i, 1]
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
    uv[i, 0] += short * mu
    uv[i, 1] += short * mv
    shape[i, 0], shape[i, 1], shape[i, 2] = ellipse.with_eigenvalues(a - pixel, b, c - pixel, 0.1, np.inf)
    return 2.0 * s0
