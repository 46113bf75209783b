"""Quality of a fit: hot pixels, peak, chi-square, explained share, the covariance's correction for model errors."""

from __future__ import annotations

from math import cos, erf, exp, log, pi, sin, sqrt

import numpy as np

from geometry.arrays import Array
from geometry.compilation.jit import compiled
from tracking.detection import ellipse
from tracking.detection.narrow_light import PolynomialFrame
from tracking.detection.pixels import (
    OUTSIDE,
    Noise,
    Pixels,
    Window,
    maximum_of,
    pixel,
    total_of,
    total_of_products,
    variance,
)
from tracking.detection.table import LIGHT, NEIGHBOUR_LIGHT, RESIDUAL, SCRATCH, STATE, USE, VALUES, WEIGHT, Candidate

_OUTLIER = 6.0  # sigmas: least residual of a hot or dead pixel ...
_ISOLATED = 2.5  # ... and its least ratio to the residuals of the neighbouring pixels
_CORE = 0.2  # share of the brightest cell's light that limits the core: the peak is searched in the core, with clipped
# cells but without hot pixels in the wings
# Sum of the squared shares of the cells above which they are too few for a test of their own: of one narrow spot it
# would show the grain in some pictures and not in others.
_CROWDED = 1 / 40
_BESIDE, _FEWEST_BESIDE = 0.02, 30  # share of the brightest cell's light below which a cell is beside the spot; cells
# The grain of the light, of speckle or texture, moves the centre by its coarse part, which the fit follows and the
# residuals do not contain. If its correlation, exp(-d^2 / (4 g^2)), is fitted to that of the residuals at a distance
# d of 0.35 sigmas, then the variance of the centre over that of independent residuals of the same size is
# exp(24 (g - 0.18)) sigma^2 with g in sigmas. Source: ours, a Monte Carlo with spots of 1.5 to 6 px and grains of 0.15
# to 1 sigma; coarser grains look like a spot of another shape.
_AWAY, _GRAIN_RISE, _GRAIN_OF_ONE = 0.35, 24.0, 0.18
_LEAST_RHO, _COARSEST, _MOST_TAKEN = 0.01, 0.29, 3.0
_LARGEST_SHIFT = 0.3  # widths: speckle of contrast 0.3 moves the centre by 0.14 widths, that of a streak by 0.28


@compiled
def assess_fit(
    window: Window, frame: PolynomialFrame, chi2: float, noise: Noise, cells: Array, spot: Candidate
) -> None:
    """Fill peak, chi-square, misfit and both shares explained of a spot, which has its covariances and gain.

    chi2: after the last step. The covariance is the Cramer-Rao bound of the model on entry; it is scaled by the factors
    of `_misfit`, as is the variance of the flux.
    """
    count = window.columns * window.rows
    weight, light = cells[WEIGHT, :count], cells[LIGHT, :count]
    used, most = 0, maximum_of(light)
    for k in range(weight.shape[0]):
        used += 1 if weight[k] > 0.0 else 0
    free = max(used - 9, 1)
    peak = 0.0
    for k in range(count):
        if light[k] > _CORE * most and cells[STATE, k] != OUTSIDE:
            peak = max(peak, cells[RESIDUAL, k] + light[k])
    spot["peak"], spot["chi2"] = peak, chi2 / free
    # Chi-square scatters by sqrt(2 free): twice that is not counted as misfit, for the sake of faint spots.
    by_noise = free + 2.0 * sqrt(2.0 * free)
    spot["explained"] = spot["gain"] / (max(chi2 - by_noise, 0.0) + max(spot["gain"], 1e-9))
    by_structure = by_noise * max(_chi2_beside(count, most, cells), 1.0)
    spot["explained_here"] = spot["gain"] / (max(chi2 - by_structure, 0.0) + max(spot["gain"], 1e-9))
    width2 = sqrt(max(frame.S[0] * frame.S[2] - frame.S[1] ** 2, 0.0))
    largest = _LARGEST_SHIFT**2 * width2 / max(0.5 * (spot["var_u"] + spot["var_v"]), 1e-300)
    by_compression, by_grain, of_flux = _misfit(window, frame, noise.compression, cells, used)
    spot["sigma_flux"] *= sqrt(1.0 + of_flux)
    # Errors of compression are those of the picture's content: a spot at rest has the same in every picture.
    factor = 1.0 + by_compression + min(by_grain, largest)
    spot["misfit"] = 1.0 - 1.0 / factor
    spot["var_u"], spot["cov_uv"], spot["var_v"] = (
        spot["var_u"] * factor,
        spot["cov_uv"] * factor,
        spot["var_v"] * factor,
    )


@compiled
def _chi2_beside(count: int, most: float, cells: Array) -> float:
    """Mean square of the residuals, in sigmas, of the cells with hardly any light of the spot; 0 with few of them."""
    weight, light, residual = cells[WEIGHT, :count], cells[LIGHT, :count], cells[RESIDUAL, :count]
    square, n = cells[SCRATCH, :count], 0
    for k in range(square.shape[0]):
        beside = light[k] < _BESIDE * most
        square[k] = residual[k] * residual[k] * weight[k] if beside else 0.0
        n += 1 if beside and weight[k] > 0.0 else 0
    squares = total_of(square)
    return squares / n if n >= _FEWEST_BESIDE else 0.0


@compiled
def exclude_isolated_cells(window: Window, spot: Candidate, cells: Array) -> bool:
    """Exclude cells with a large residual that all eight neighbours lack: hot or dead pixels, never part of a spot."""
    outlying, n, count, found = 0, window.columns, window.rows * window.columns, False
    residual, weight, size = cells[RESIDUAL, :count], cells[WEIGHT, :count], cells[SCRATCH, :count]
    for k in range(size.shape[0]):
        size[k] = residual[k] * residual[k] * weight[k]
        outlying += 1 if size[k] > _OUTLIER**2 else 0
    if outlying == 0:
        return False
    narrow_spot, middle = min(spot["uu"], spot["vv"]) < 0.8**2, 0.5 * (window.cell - 1)
    for r in range(window.rows):
        for c in range(n):
            k = r * n + c
            if size[k] <= _OUTLIER**2:
                continue
            most = size[k] / _ISOLATED**2  # of a neighbour; in most cases that in the row exceeds it
            if (c > 0 and size[k - 1] >= most) or (c < n - 1 and size[k + 1] >= most):
                continue
            u = window.left + middle + c * window.cell - spot["u"]
            v = window.top + middle + r * window.cell - spot["v"]
            if narrow_spot and u * u + v * v < 1.8**2:  # the middle of a spot about one pixel wide is always isolated
                continue
            around = 0.0
            for i in range(max(r - 1, 0), min(r + 2, window.rows)):
                for j in range(max(c - 1, 0), min(c + 2, n)):
                    if i != r or j != c:
                        around = max(around, size[i * n + j])
            if around < most:
                cells[USE, k], found = 0.0, True
    return found


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
def light_beside(image: Pixels, spot: Candidate, noise: Noise, width: float) -> float:
    """The light of a fitted narrow spot of sigma `width`, px, outside its two brightest pixels, in its own sigmas.

    A matched filter over 5x5 pixels. Hot pixels, which occur in pairs, have no light beside them.
    """
    column, row = int(np.rint(spot["u"])), int(np.rint(spot["v"]))
    product, power, first, second = 0.0, 0.0, (-1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)
    for i in range(max(row - 2, 0), min(row + 3, image.height)):
        for j in range(max(column - 2, 0), min(column + 3, image.width)):
            light = spot["flux"] * _within_pixel(j - spot["u"], width) * _within_pixel(i - spot["v"], width)
            plane = spot["level"] + spot["slope_u"] * (j - spot["u"]) + spot["slope_v"] * (i - spot["v"])
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
def _misfit(
    window: Window, frame: PolynomialFrame, compression: float, cells: Array, used: int
) -> tuple[float, float, float]:
    """Additions to a factor of 1 on the covariance of the centre: by compression, and by errors of the Gaussian model.

    Only the part of the residuals that is odd about the centre can shift it: a spot with a flat top, a ring or a streak
    is not Gaussian, but its centre is correct. If the odd part is significantly larger than noise and compression, the
    addition is its mean square, weighted by the sensitivity of the centre (the slopes), times the number of cells that
    one grain of the light has. Spots at the border, with few cells in mirrored pairs, use all residuals. The third
    value is that for the flux, on which the fit's freedom has less effect. Source: ours, after the sandwich covariance
    of misspecified models; measured in bench/detection.py (sets streak, speckle).
    """
    count, n = window.columns * window.rows, window.columns
    weight, residual = cells[WEIGHT, :count], cells[RESIDUAL, :count]
    z, odd, known = cells[VALUES, :count], cells[SCRATCH, :count], cells[USE, :count]  # no longer needed
    for k in range(z.shape[0]):
        z[k] = residual[k] * sqrt(weight[k])
        known[k] = 1.0 if weight[k] > 0.0 else 0.0
    both, half = 0.0, (count + 1) // 2
    for k in range(half):
        both += known[k] * known[count - 1 - k]
    both = 2.0 * both - known[half - 1]  # the middle is its own mirror image
    whole = 0.5 * both < 0.3 * used
    free = max(used - 9.0, 1.0) if whole else max(0.5 * both - 4.0, 1.0)  # u, v and two slopes are odd
    if whole:
        for k in range(z.shape[0]):
            odd[k] = z[k] * sqrt(2.0)
    else:
        # Mirrored cells are at w + d and -w + d from the centre: an even residual differs there by 2 d times its slope.
        du = frame.u0 / window.cell + 0.5 * (n - 1)
        dv = frame.v0 / window.cell + 0.5 * (window.rows - 1)
        _subtract_slope(window, z, known, du, dv, odd)
        share = 1.0 / sqrt(2.0 + du * du + dv * dv)
        for k in range(half):
            mirror = count - 1 - k
            difference = (odd[k] - odd[mirror]) * (known[k] * known[mirror] * share)
            odd[k], odd[mirror] = difference, -difference
    anywhere = 0.5 * total_of_products(odd, odd) / free > 1.0 + 3.0 * sqrt(2.0 / free)
    return _odd_misfit(window, frame, compression, cells, odd, 2.0 if whole else 1.0, anywhere)


@compiled
def _subtract_slope(window: Window, z: Array, known: Array, du: float, dv: float, out: Array) -> None:
    """Values (cells,) less their change over a distance in cells, which follows from a cell's neighbours.

    A direction in which one of them is missing does not count. Loops over the whole window are faster than over rows.
    """
    n, count, half_u, half_v = window.columns, z.shape[0], 0.5 * du, 0.5 * dv
    before, after, both = z[: count - 2], z[2:], out[1 : count - 1]
    known_before, known_after = known[: count - 2], known[2:]
    for k in range(both.shape[0]):
        both[k] = half_u * (after[k] - before[k]) * (known_before[k] * known_after[k])
    for row in range(window.rows):
        out[row * n] = out[row * n + n - 1] = 0.0
    above, below, both = z[: count - 2 * n], z[2 * n :], out[n : count - n]
    known_above, known_below = known[: count - 2 * n], known[2 * n :]
    for k in range(both.shape[0]):
        both[k] += half_v * (below[k] - above[k]) * (known_above[k] * known_below[k])
    for k in range(count):
        out[k] = z[k] - out[k]


@compiled
def _odd_misfit(
    window: Window, frame: PolynomialFrame, compression: float, cells: Array, odd: Array, doubled: float, anywhere: bool
) -> tuple[float, float, float]:
    """As `_misfit`. odd (cells,): residuals in sigmas. Overwrites NEIGHBOUR_LIGHT.

    anywhere: whether there is one in the mean of all cells. Grain of the light is in the core only: there the mean
    weighted with the sensitivity shows it. Its variance, with noise alone, is 2 sum(share^2), or 4 of mirrored pairs.
    """
    count = window.columns * window.rows
    weight, light = cells[WEIGHT, :count], cells[LIGHT, :count]
    share = cells[NEIGHBOUR_LIGHT, :count]  # no longer needed: the sensitivity of the centre to each cell
    a, b, c = ellipse.inverse(frame.S[0], frame.S[1], frame.S[2])
    for row in range(window.rows):
        dv, first = frame.v0 + row * window.cell, row * window.columns
        w, l, out = weight[first : first + window.columns], light[first : first + window.columns], share[first:]
        for j in range(w.shape[0]):
            du = frame.u0 + j * window.cell
            wu, wv = a * du + b * dv, b * du + c * dv
            out[j] = w[j] * (l[j] * l[j]) * (wu * wu + wv * wv)
    total = max(total_of(share), 1e-300)
    added = 0.0
    if compression > 0.0:
        added = total_of_products(share, weight) * compression / (total * window.cell**2)
    for k in range(share.shape[0]):
        share[k] = share[k] / total if odd[k] != 0.0 else 0.0
    crowd = total_of_products(share, share)
    square = cells[VALUES, :count]
    for k in range(share.shape[0]):
        square[k] = odd[k] * odd[k] * share[k]
        share[k] = sqrt(share[k])
    mean_square = total_of(square) / doubled
    scatter = sqrt(4.0 / doubled * crowd)  # of the mean square by noise
    beyond = mean_square - (1.0 + added)
    if beyond <= 0.0 or (not anywhere and (crowd > _CROWDED or mean_square <= 1.0 + 3.0 * scatter)):
        return added, 0.0, 0.0
    width2 = sqrt(max(frame.S[0] * frame.S[2] - frame.S[1] ** 2, 0.0)) / window.cell**2
    rho, away2 = _correlation_within(window, frame, odd, share)
    rho = min(max(rho / (doubled * beyond), _LEAST_RHO), 0.99)
    grain = min(sqrt(away2 / (-4.0 * log(rho))), _COARSEST)
    # Four fitted parameters are odd: of a narrow spot they take a large part of the odd residuals.
    odd_cells = 0.5 * doubled / max(crowd, 1e-12)
    taken = min(odd_cells / max(odd_cells - 4.0, 1e-9), _MOST_TAKEN)
    cells_of_one = taken * exp(_GRAIN_RISE * (grain - _GRAIN_OF_ONE)) * width2
    # A misfit that is barely significant has no reliable correlation.
    reliable = max(1.0 - scatter * (1.0 + added) / beyond, 0.0)
    visible = 4.0 * pi * grain * grain * width2
    return added, beyond * max(cells_of_one * reliable, 1.0), beyond * max(visible * reliable, 1.0)


@compiled
def _correlation_within(window: Window, frame: PolynomialFrame, z: Array, weight: Array) -> tuple[float, float]:
    """Mean product of two of the values (cells,) that are about _AWAY sigmas of the spot apart, weighted.

    The mean of four directions, evenly spaced where the spot's ellipse is a circle; and their mean squared distance,
    sigma^2.
    """
    n, total, weights, away2 = window.columns, 0.0, 0.0, 0.0
    a = sqrt(max(frame.S[0], 1e-9))
    b = frame.S[1] / a
    c = sqrt(max(frame.S[2] - b * b, 1e-9))
    for direction in range(4):
        p, q = cos(direction * pi / 4), sin(direction * pi / 4)
        right = int(np.rint(_AWAY * a * p / window.cell))
        down = int(np.rint(_AWAY * (b * p + c * q) / window.cell))
        if down < 0:
            right, down = -right, -down
        if right == 0 and down == 0:
            right, down = (0, 1) if direction == 2 else (1, 0)
        x = right * window.cell / a
        y = (down * window.cell - b * x) / c
        away2 += 0.25 * (x * x + y * y)
        for row in range(window.rows - down):
            for column in range(max(-right, 0), min(n - right, n)):
                k = row * n + column
                both = weight[k] * weight[k + down * n + right]
                total, weights = total + both * z[k] * z[k + down * n + right], weights + both
    return total / max(weights, 1e-300), away2
