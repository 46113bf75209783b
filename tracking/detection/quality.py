"""What a finished fit says of itself."""

from __future__ import annotations

from math import sqrt

from geometry.arrays import Array
from geometry.compiled import compiled
from tracking.detection import ellipse
from tracking.detection.normal_equations import Cells, Frame
from tracking.detection.pixels import OUTSIDE, Window

# Columns of a fit's quality: covariance of the centre, px^2; sigma of the flux, DN; highest pixel above plane and
# neighbours, DN (of a clipped spot the clipping level's); chi-square per degree of freedom; share of what stands out of
# the plane, beyond noise, that the Gaussian explains; by how much the Gaussian lowers chi-square.
VAR_U, COV_UV, VAR_V, SIGMA_FLUX, PEAK, CHI2, EXPLAINED, GAIN = range(8)
COLUMNS = 8
_CORE = 0.2  # of the brightest cell's light: clipped cells count there, hot pixels in the wings do not
_LAGS = 2  # cells


@compiled
def judge(window: Window, frame: Frame, cells: Cells, N: Array, b: Array, before: float, chi2: float, out: Array) -> None:
    """Complete a row of quality (COLUMNS,), whose first four are given, from the normal equations of the last step.

    `before` is chi-square before that step, `chi2` after. The covariance given is the Cramer-Rao bound of the model; it
    and the flux's variance are raised by `_misfit`.
    """
    count = window.columns * window.rows
    used, most = 0, 0.0
    for k in range(count):
        used += 1 if cells.weight[k] > 0 else 0
        most = max(most, cells.light[k])
    free = max(used - 9, 1)
    peak = 0.0
    for k in range(count):
        if cells.state[k] != OUTSIDE and cells.light[k] > _CORE * most:
            peak = max(peak, cells.residual[k] + cells.light[k])
    flat = max(before + 2 * b[0] + N[0, 0] - _gain_of_plane(N, b), chi2)
    out[PEAK], out[CHI2], out[GAIN] = peak, chi2 / free, flat - chi2
    # Chi-square scatters by sqrt(2 free): so much in a faint spot's surroundings is no misfit.
    noise = min(free + 2.0 * sqrt(2.0 * free), chi2)
    out[EXPLAINED] = (flat - chi2) / max(flat - noise, 1e-9)
    factor = _misfit(window, frame, cells, used)
    out[VAR_U], out[COV_UV], out[VAR_V] = out[VAR_U] * factor, out[COV_UV] * factor, out[VAR_V] * factor
    out[SIGMA_FLUX] *= sqrt(factor)


@compiled
def _gain_of_plane(N: Array, b: Array) -> float:
    """By how much a plane alone lowers chi-square: of what it leaves, the Gaussian explains its share."""
    gain = 0.0
    y0, y1, y2 = b[6] + N[0, 6], b[7] + N[0, 7], b[8] + N[0, 8]
    d0 = max(N[6, 6], 1e-300)
    l1, l2 = N[7, 6] / d0, N[8, 6] / d0
    d1 = max(N[7, 7] - l1 * N[7, 6], 1e-9 * N[7, 7] + 1e-300)
    l3 = (N[8, 7] - l2 * N[7, 6]) / d1
    d2 = max(N[8, 8] - l2 * N[8, 6] - l3 * l3 * d1, 1e-9 * N[8, 8] + 1e-300)
    y1 -= l1 * y0
    y2 -= l2 * y0 + l3 * y1
    gain = y0 * y0 / d0 + y1 * y1 / d1 + y2 * y2 / d2
    return gain


@compiled
def _misfit(window: Window, frame: Frame, cells: Cells, used: int) -> float:
    """Factor >= 1 by which the model's faults raise the covariance of the centre.

    Only the part of the residuals that is odd about the centre can move it: a flat top, a ring or a streak is a bad
    Gaussian with a good centre. Where the odd part is significantly larger than noise, the factor is its mean square,
    taken where the centre is read (the slopes), times the number of cells over which it goes together. Spots with few
    cells to mirror (at the border) are judged by all residuals. Ours, after the sandwich covariance of misspecified
    models; measured in bench/detection.py (sets streak, speckle).
    """
    count = window.columns * window.rows
    both = 0
    for k in range(count):
        both += 1 if cells.weight[k] > 0 and cells.weight[count - 1 - k] > 0 else 0
    whole = 0.5 * both < 0.3 * used
    free = max(used - 9.0, 1.0) if whole else max(0.5 * both - 4.0, 1.0)  # u, v and two slopes are odd
    squares = 0.0
    odd = cells.values  # no longer needed
    for k in range(count):
        mirror = count - 1 - k
        here = cells.residual[k] * sqrt(cells.weight[k])
        there = cells.residual[mirror] * sqrt(cells.weight[mirror])
        if whole:
            odd[k] = here * sqrt(2.0)
        elif cells.weight[k] > 0 and cells.weight[mirror] > 0:
            odd[k] = (here - there) * sqrt(0.5)
        else:
            odd[k] = 0.0
        squares += odd[k] * odd[k]
    if 0.5 * squares / free <= 1.0 + 3.0 * sqrt(2.0 / free):
        return 1.0
    return _lopsided(window, frame, cells, odd, 2.0 if whole else 1.0)


@compiled
def _lopsided(window: Window, frame: Frame, cells: Cells, odd: Array, doubled: float) -> float:
    """The factor where there is a misfit; `odd` (cells,), residuals in sigmas, is overwritten."""
    count = window.columns * window.rows
    share = cells.others  # no longer needed
    a, b, c = ellipse.inverse(frame.S[0], frame.S[1], frame.S[2])
    total = 0.0
    for k in range(count):
        du = frame.u0 + (k % window.columns) * window.cell
        dv = frame.v0 + (k // window.columns) * window.cell
        wu, wv = a * du + b * dv, b * du + c * dv
        share[k] = cells.weight[k] * cells.light[k] ** 2 * (wu * wu + wv * wv)
        total += share[k]
    total = max(total, 1e-300)
    square, crowd = 0.0, 0.0
    for k in range(count):
        part = share[k] / total if odd[k] != 0.0 else 0.0
        square += odd[k] * odd[k] * part / doubled
        crowd += part * part
        odd[k] *= sqrt(part)
    grain = _grain(window, odd)
    grains = 1.0 / max(crowd * grain, 1e-12)  # independent ones in the slopes
    # The fit has bent four parameters to the odd part, so that less of it is left than was.
    return max(square * grain * min(grains / max(grains - 4.0, 1e-9), 3.0), 1.0)


@compiled
def _grain(window: Window, z: Array) -> float:
    """Number of cells over which residuals (cells,) go together: by so much fewer independent ones does the fit have.

    Speckle is smooth, so chi2 alone understates what it does to the centre. The sum of the residuals' autocorrelation
    over lags up to two cells.
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
