"""Quality of a finished fit: peak, chi-square, explained share, and the covariance's correction for model errors."""

from __future__ import annotations

from math import erf, sqrt

import numpy as np

from geometry.arrays import Array
from geometry.compilation.jit import compiled
from tracking.detection import ellipse
from tracking.detection.normal_equations import PolynomialFrame
from tracking.detection.pixels import OUTSIDE, Noise, Pixels, Window, pixel, variance
from tracking.detection.table import (
    CHI2,
    COV_UV,
    EXPLAINED,
    EXPLAINED_HERE,
    FLUX,
    GAIN,
    LEVEL,
    LIGHT,
    MISFIT,
    NEIGHBOUR_LIGHT,
    PEAK,
    RESIDUAL,
    SCRATCH,
    SIGMA_FLUX,
    SLOPE_U,
    SLOPE_V,
    STATE,
    VALUES,
    VAR_U,
    VAR_V,
    WEIGHT,
    U,
    V,
)

_CORE = 0.2  # share of the brightest cell's light that limits the core: the peak is searched in the core, with clipped
# cells but without hot pixels in the wings
# Sum of the squared shares of the cells above which they are too few for a test of their own: of one narrow spot it
# would show the grain in some pictures and not in others.
_CROWDED = 1 / 40
_BESIDE, _FEWEST_BESIDE = 0.02, 30  # share of the brightest cell's light below which a cell is beside the spot; cells
_LAGS = 2  # cells: largest lag of the autocorrelation of the residuals


@compiled
def assess_fit(window: Window, frame: PolynomialFrame, chi2: float, noise: Noise, cells: Array, spot: Array) -> None:
    """Fill PEAK, CHI2, MISFIT and both EXPLAINED of a spot (COLUMNS,), which has its covariances and GAIN.

    chi2: after the last step. The covariance is the Cramer-Rao bound of the model on entry; it and the variance of the
    flux are scaled by `_covariance_factor`, the covariance at least by `_compression_factor`.
    """
    count = window.columns * window.rows
    used, most = 0, 0.0
    for k in range(count):
        used += 1 if cells[WEIGHT, k] > 0 else 0
        most = max(most, cells[LIGHT, k])
    free = max(used - 9, 1)
    peak = 0.0
    for k in range(count):
        if cells[STATE, k] != OUTSIDE and cells[LIGHT, k] > _CORE * most:
            peak = max(peak, cells[RESIDUAL, k] + cells[LIGHT, k])
    spot[PEAK], spot[CHI2] = peak, chi2 / free
    # Chi-square scatters by sqrt(2 free): twice that is not counted as misfit, for the sake of faint spots.
    by_noise = free + 2.0 * sqrt(2.0 * free)
    spot[EXPLAINED] = spot[GAIN] / (max(chi2 - by_noise, 0.0) + max(spot[GAIN], 1e-9))
    by_structure = by_noise * max(_chi2_beside(count, most, cells), 1.0)
    spot[EXPLAINED_HERE] = spot[GAIN] / (max(chi2 - by_structure, 0.0) + max(spot[GAIN], 1e-9))
    factor = _covariance_factor(window, frame, cells, used)
    spot[SIGMA_FLUX] *= sqrt(factor)
    known = _compression_factor(window, noise.compression, cells)
    factor = max(factor, known)
    spot[MISFIT] = 1.0 - known / factor
    spot[VAR_U], spot[COV_UV], spot[VAR_V] = spot[VAR_U] * factor, spot[COV_UV] * factor, spot[VAR_V] * factor


@compiled
def _chi2_beside(count: int, most: float, cells: Array) -> float:
    """Mean square of the residuals, in sigmas, of the cells with hardly any light of the spot; 0 with few of them."""
    squares, n = 0.0, 0
    for k in range(count):
        if cells[WEIGHT, k] > 0 and cells[LIGHT, k] < _BESIDE * most:
            squares += cells[RESIDUAL, k] * cells[RESIDUAL, k] * cells[WEIGHT, k]
            n += 1
    return squares / n if n >= _FEWEST_BESIDE else 0.0


@compiled
def gain_over_plane(N: Array, b: Array, before: float, chi2: float) -> float:
    """The decrease of chi-square by the Gaussian and a plane, compared with a plane alone.

    N, b: the normal equations (normal_equations.accumulate); before, chi2: chi-square before and after their step.
    """
    y0, y1, y2 = b[6] + N[0, 6], b[7] + N[0, 7], b[8] + N[0, 8]
    d0 = max(N[6, 6], 1e-300)
    l1, l2 = N[7, 6] / d0, N[8, 6] / d0
    d1 = max(N[7, 7] - l1 * N[7, 6], 1e-9 * N[7, 7] + 1e-300)
    l3 = (N[8, 7] - l2 * N[7, 6]) / d1
    d2 = max(N[8, 8] - l2 * N[8, 6] - l3 * l3 * d1, 1e-9 * N[8, 8] + 1e-300)
    y1 -= l1 * y0
    y2 -= l2 * y0 + l3 * y1
    plane = y0 * y0 / d0 + y1 * y1 / d1 + y2 * y2 / d2
    return max(before + 2 * b[0] + N[0, 0] - plane - chi2, 0.0)


@compiled
def light_beside(image: Pixels, spot: Array, noise: Noise, width: float) -> float:
    """The light of a fitted narrow spot of sigma `width`, px, outside its two brightest pixels, in its own sigmas.

    A matched filter over 5x5 pixels. Hot pixels, which occur in pairs, have no light beside them.
    """
    column, row = int(np.rint(spot[U])), int(np.rint(spot[V]))
    product, power, first, second = 0.0, 0.0, (-1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)
    for i in range(max(row - 2, 0), min(row + 3, image.height)):
        for j in range(max(column - 2, 0), min(column + 3, image.width)):
            light = spot[FLUX] * _within_pixel(j - spot[U], width) * _within_pixel(i - spot[V], width)
            plane = spot[LEVEL] + spot[SLOPE_U] * (j - spot[U]) + spot[SLOPE_V] * (i - spot[V])
            value = pixel(image, j, i)
            weight = light / variance(noise, plane + light)
            here = (value, weight * (value - plane), weight * light)
            product, power = product + here[1], power + here[2]
            if value > first[0]:
                first, second = here, first
            elif value > second[0]:
                second = here
    product, power = product - first[1] - second[1], power - first[2] - second[2]
    return product / sqrt(max(power, 1e-12))


@compiled
def _within_pixel(offset: float, width: float) -> float:
    """The share of the light of a line spread of sigma `width`, px, that falls on a pixel at this offset, px."""
    scale = 1.0 / (width * sqrt(2.0))
    return 0.5 * (erf((offset + 0.5) * scale) - erf((offset - 0.5) * scale))


@compiled
def _covariance_factor(window: Window, frame: PolynomialFrame, cells: Array, used: int) -> float:
    """Factor >= 1 on the covariance of the centre, for errors of the Gaussian model.

    Only the part of the residuals that is odd about the centre can shift it: a spot with a flat top, a ring or a streak
    is not Gaussian, but its centre is correct. If the odd part is significantly larger than noise, the factor is its
    mean square, weighted by the sensitivity of the centre (the slopes), times the number of correlated cells. Spots at
    the border, with few cells in mirrored pairs, use all residuals. Source: ours, after the sandwich covariance of
    misspecified models; measured in bench/detection.py (sets streak, speckle).
    """
    count = window.columns * window.rows
    both = 0
    for k in range(count):
        both += 1 if cells[WEIGHT, k] > 0 and cells[WEIGHT, count - 1 - k] > 0 else 0
    whole = 0.5 * both < 0.3 * used
    free = max(used - 9.0, 1.0) if whole else max(0.5 * both - 4.0, 1.0)  # u, v and two slopes are odd
    squares = 0.0
    z, odd = cells[VALUES], cells[SCRATCH]  # no longer needed
    for k in range(count):
        z[k] = cells[RESIDUAL, k] * sqrt(cells[WEIGHT, k])
    # Mirrored cells are at w + d and -w + d from the centre: an even residual differs there by 2 d times its slope.
    du = frame.u0 / window.cell + 0.5 * (window.columns - 1)
    dv = frame.v0 / window.cell + 0.5 * (window.rows - 1)
    share = 1.0 / sqrt(2.0 + du * du + dv * dv)
    for k in range(count):
        mirror = count - 1 - k
        if whole:
            odd[k] = z[k] * sqrt(2.0)
        elif cells[WEIGHT, k] > 0 and cells[WEIGHT, mirror] > 0:
            slope = _slope_along(window, cells, z, k, du, dv) - _slope_along(window, cells, z, mirror, du, dv)
            odd[k] = (z[k] - z[mirror] - slope) * share
        else:
            odd[k] = 0.0
        squares += odd[k] * odd[k]
    anywhere = 0.5 * squares / free > 1.0 + 3.0 * sqrt(2.0 / free)
    return _odd_misfit_factor(window, frame, cells, odd, 2.0 if whole else 1.0, anywhere)


@compiled
def _slope_along(window: Window, cells: Array, z: Array, k: int, du: float, dv: float) -> float:
    """The change of values (cells,) over a distance in cells, from a cell's neighbours; 0 where one is missing."""
    n = window.columns
    row, column = k // n, k % n
    total = 0.0
    if 0 < column < n - 1 and cells[WEIGHT, k - 1] > 0 and cells[WEIGHT, k + 1] > 0:
        total += 0.5 * du * (z[k + 1] - z[k - 1])
    if 0 < row < window.rows - 1 and cells[WEIGHT, k - n] > 0 and cells[WEIGHT, k + n] > 0:
        total += 0.5 * dv * (z[k + n] - z[k - n])
    return total


@compiled
def _odd_misfit_factor(
    window: Window, frame: PolynomialFrame, cells: Array, odd: Array, doubled: float, anywhere: bool
) -> float:
    """The factor; 1 without a misfit. odd (cells,): residuals in sigmas, overwritten. Fills NEIGHBOUR_LIGHT.

    anywhere: whether there is one in the mean of all cells. Grain of the light is in the core only: there the mean
    weighted with the sensitivity shows it. Its variance, with noise alone, is 2 sum(share^2), or 4 of mirrored pairs.
    """
    count = window.columns * window.rows
    share = cells[NEIGHBOUR_LIGHT]  # no longer needed: the sensitivity of the centre to each cell
    a, b, c = ellipse.inverse(frame.S[0], frame.S[1], frame.S[2])
    total = 0.0
    for row in range(window.rows):
        dv = frame.v0 + row * window.cell
        for column in range(window.columns):
            du, k = frame.u0 + column * window.cell, row * window.columns + column
            wu, wv = a * du + b * dv, b * du + c * dv
            share[k] = cells[WEIGHT, k] * cells[LIGHT, k] ** 2 * (wu * wu + wv * wv)
            total += share[k]
    total = max(total, 1e-300)
    square, crowd = 0.0, 0.0
    for k in range(count):
        part = share[k] / total if odd[k] != 0.0 else 0.0
        square += odd[k] * odd[k] * part / doubled
        crowd += part * part
        odd[k] *= sqrt(part)
    if not anywhere and (crowd > _CROWDED or square <= 1.0 + 3.0 * sqrt(4.0 / doubled * crowd)):
        return 1.0
    grain = _correlated_cells(window, odd)
    grains = 1.0 / max(crowd * grain, 1e-12)  # number of independent samples in the slopes
    # Four fitted parameters are odd, so the residuals contain less of the odd part than the light.
    return max(square * grain * min(grains / max(grains - 4.0, 1e-9), 3.0), 1.0)


@compiled
def _compression_factor(window: Window, compression: float, cells: Array) -> float:
    """Factor >= 1 on the covariance of the centre for the variance, DN^2 per pixel, that compression adds to the light.

    Weighted with the sensitivity in NEIGHBOUR_LIGHT.
    """
    added, total = 0.0, 0.0
    for k in range(window.columns * window.rows):
        share = cells[NEIGHBOUR_LIGHT, k]
        added, total = added + share * cells[WEIGHT, k], total + share
    return 1.0 + compression / window.cell**2 * added / max(total, 1e-300)


@compiled
def _correlated_cells(window: Window, z: Array) -> float:
    """Number of cells over which residuals (cells,) are correlated: the fit has fewer independent cells by this factor.

    Speckle is smooth, so chi2 alone underestimates its effect on the centre. The number is the sum of the residuals'
    autocorrelation over lags of up to two cells.
    """
    power, other = 0.0, 0.0
    for r in range(window.rows):
        for c in range(window.columns):
            here = z[r * window.columns + c]
            power += here * here
            for i in range(min(_LAGS + 1, window.rows - r)):
                for j in range(-_LAGS if i > 0 else 1, _LAGS + 1):
                    if c + j >= 0 and c + j < window.columns:
                        other += here * z[(r + i) * window.columns + c + j]
    return max(1.0 + 2.0 * other / max(power, 1e-12), 1.0)
