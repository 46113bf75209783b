"""One weighted least-squares step for many spots at once: an elliptical Gaussian on a background plane, each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints
from tracking import ellipses
from tracking.noise import NoiseModel
from tracking.patches import Patches, profile

_OUTLIER = 6.0  # sigmas by which a hot or dead pixel sticks out of the fit
_LEAST_VARIANCE = 0.02  # px^2: narrower is a point to any sensor
_PIXEL = np.array([1.0, 0.0, 1.0]) / 12


@dataclass(frozen=True, slots=True)
class Spots:
    """What the fit varies, for n spots."""

    uv: Array  # (n, 2), px
    shape: Array  # (n, 3), px^2: uu, uv, vv of the light before the pixels integrate it
    flux: Array  # (n,), DN
    plane: Array  # (n, 3): level at the centre, DN, and its slopes, DN/px

    def __getitem__(self, rows: Ints | Bools | slice) -> Spots:
        return Spots(self.uv[rows], self.shape[rows], self.flux[rows], self.plane[rows])


@dataclass(frozen=True, slots=True)
class Solution:
    """The weighted linear problem at one state of n spots, and its solution."""

    patches: Patches
    J: Array  # (n, 9, cells)
    y: Array  # (n, cells), DN: what the nine parameters have to explain
    weight: Array  # (n, cells), 1/DN^2; 0 where a cell does not count
    z: Array  # (n, cells): residuals in sigmas, 0 where a cell does not count
    x: Array  # (n, 9): increments of u, v, uu, uv, vv; flux; level at the patch's origin, slopes per half window
    inverse: Array  # (n, 9, 9): covariance of x
    normal: Array  # (n, 9, 9)
    rhs: Array  # (n, 9): normal @ x


def solve(patches: Patches, spots: Spots, others: Array | float, noise: NoiseModel) -> Solution:
    """Linearise about `spots` and solve; `others` (n, cells), DN, is the light of the neighbours.

    Cells are weighted by the noise model's variance at the FITTED level: weights from the noisy values would
    pull the fit down. Hot and dead pixels are found in the residuals and left out.
    """
    g = profile(patches, slice(None), spots.uv, spots.shape)
    light = g.value * spots.flux[:, None]
    J = np.empty((len(light), 9, light.shape[1]))
    J[:, 0] = light * g.wu
    J[:, 1] = light * g.wv
    J[:, 2] = (0.5 * light) * (g.wu * g.wu - g.inverse[:, :1])
    J[:, 3] = light * (g.wu * g.wv - g.inverse[:, 1:2])
    J[:, 4] = (0.5 * light) * (g.wv * g.wv - g.inverse[:, 2:])
    J[:, 5] = g.value
    J[:, 6] = 1.0
    J[:, 7] = patches.du / _half_width(patches)
    J[:, 8] = patches.dv / _half_width(patches)
    slopes, offset = spots.plane[:, 1:], patches.origin - spots.uv
    ground = (spots.plane[:, 0] + (slopes * offset).sum(axis=1))[:, None]
    ground = ground + slopes[:, :1] * patches.du + slopes[:, 1:] * patches.dv
    weight = patches.valid * patches.cell_px**2 / noise.variance(light + ground + others)
    y = patches.values - others
    x, inverse, normal, rhs = least_squares(J, weight, y)
    z = _residuals(J, x, y, weight)
    if np.abs(z).max() > _OUTLIER:
        lonely = _lonely(z, patches, spots)
        if lonely.any():
            weight = np.where(lonely, 0.0, weight)
            x, inverse, normal, rhs = least_squares(J, weight, y)
            z = _residuals(J, x, y, weight)
    return Solution(patches, J, y, weight, z, x, inverse, normal, rhs)


def least_squares(J: Array, weight: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """n problems J^T x = y with J (n, k, p), y (n, p): x (n, k), inverse normal matrix, normal matrix, right side."""
    JW = J * weight[:, None, :]
    N = JW @ J.transpose(0, 2, 1)
    diagonal = np.arange(J.shape[1])
    scale = 1.0 / (np.sqrt(N[:, diagonal, diagonal]) + 1e-12)
    both = scale[:, :, None] * scale[:, None, :]
    scaled = N * both
    scaled[:, diagonal, diagonal] += 1e-9  # only keeps hopeless cases finite
    inverse = np.linalg.inv(scaled) * both
    rhs = JW @ y[:, :, None]
    return (inverse @ rhs)[:, :, 0], inverse, N, rhs[:, :, 0]


def stepped(spots: Spots, solution: Solution) -> Spots:
    """The spots after the step, which is held to one sigma of the spot in length and a factor 2.5 in its variances."""
    x, patches = solution.x, solution.patches
    S = spots.shape + _PIXEL
    step = x[:, :2] / np.maximum(ellipses.length(x[:, :2], S), 1.0)[:, None]
    uv = spots.uv + step
    shape = ellipses.at_least(ellipses.kept_within(S + x[:, 2:5], S, 0.4, 2.5) - _PIXEL, _LEAST_VARIANCE)
    slopes = x[:, 7:9] / _half_width(patches)
    level = x[:, 6] + (slopes * (uv - patches.origin)).sum(axis=1)
    flux = np.clip(x[:, 5], 0.2 * spots.flux, 5.0 * spots.flux)
    return Spots(uv, shape, flux, np.concatenate([level[:, None], slopes], axis=1))


@dataclass(frozen=True, slots=True)
class Quality:
    """What a finished fit says of itself, for n spots."""

    cov: Array  # (n, 2, 2), px^2
    sigma_flux: Array  # (n,), DN
    chi2: Array  # (n,) per degree of freedom
    explained: Array  # (n,) share of what stands out of the plane, beyond noise, that the Gaussian explains
    peak: Array  # (n,), DN above plane and neighbours; of a clipped spot the clipping level's


def judged(solution: Solution, rows: Bools) -> Quality:
    """Covariances and goodness of the chosen ones of n solutions (rows (n,): which).

    The covariance is the inverse normal matrix, the Cramer-Rao bound of this model, raised by `_misfit`.
    """
    patches, y, weight = solution.patches, solution.y[rows], solution.weight[rows]
    z, x, inverse = solution.z[rows], solution.x[rows], solution.inverse[rows]
    squares, free = (z * z).sum(axis=1), np.maximum((weight > 0).sum(axis=1) - 9, 1)
    # What is left without the Gaussian: the plane's part of the same normal equations.
    N, rhs = solution.normal[rows, 6:, 6:], solution.rhs[rows, 6:, None]
    N = N + 1e-9 * np.eye(3) * np.maximum(np.trace(N, axis1=1, axis2=2), 1e-12)[:, None, None]
    flat = (weight * y * y).sum(axis=1) - (rhs * np.linalg.solve(N, rhs)).sum(axis=(1, 2))
    information = weight * (solution.J[rows, 0] ** 2 + solution.J[rows, 1] ** 2)
    factor = _misfit(z, weight, information, patches.side)
    above = y - (x[:, 6:] @ solution.J[0, 6:])  # the plane's columns are the same for all
    light = solution.J[rows, 5]
    core = light > 0.2 * light.max(axis=1, keepdims=True)  # clipped cells count, hot pixels in the wings do not
    return Quality(
        inverse[:, :2, :2] * factor[:, None, None],
        np.sqrt(inverse[:, 5, 5] * factor),
        squares / free,
        (flat - squares) / np.maximum(flat - np.minimum(free, squares), 1e-9),
        np.where(core & patches.inside[rows], above, -np.inf).max(axis=1),
    )


def _misfit(z: Array, weight: Array, information: Array, side: int) -> Array:
    """Factors (n,) >= 1 by which the model's faults raise the covariance of the centre, from residuals (n, cells).

    Only the part of the residuals that is odd about the centre can move it: a flat top, a ring or a streak is a bad
    Gaussian with a good centre. Where the odd part is significantly larger than noise, the factor is its mean square,
    taken where the centre is read (`information`, (n, cells): the slopes), times the number of cells over which it
    goes together. Spots with few cells to mirror (at the border) are judged by all residuals. Ours, after the
    sandwich covariance of misspecified models; measured in bench/detection.py (sets streak, speckle).
    """
    mirrored = (weight > 0) & (weight[:, ::-1] > 0)
    pairs = 0.5 * mirrored.sum(axis=1)
    whole = pairs < 0.3 * (weight > 0).sum(axis=1)
    r = np.where(mirrored, (z - z[:, ::-1]) * np.sqrt(0.5), 0.0)
    free = np.maximum(pairs - 4, 1.0)  # u, v and two slopes are odd
    if whole.any():
        r[whole] = z[whole] * np.sqrt(2.0)
        free[whole] = np.maximum((weight[whole] > 0).sum(axis=1) - 9, 1)
    chi2 = 0.5 * (r * r).sum(axis=1) / free
    bad = chi2 > 1 + 3 * np.sqrt(2.0 / free)
    factor = np.ones(len(z))
    if bad.any():
        r, share = r[bad], information[bad] / np.maximum(information[bad].sum(axis=1, keepdims=True), 1e-300)
        share = np.where(r != 0, share, 0.0)
        grain = _grain(r * np.sqrt(share), side)
        grains = 1 / np.maximum((share * share).sum(axis=1) * grain, 1e-12)  # independent ones in the slopes
        square = (r * r * share).sum(axis=1) / np.where(whole[bad], 2.0, 1.0)
        # The fit has bent four parameters to the odd part, so that less of it is left than was.
        factor[bad] = np.maximum(square * grain * np.minimum(grains / np.maximum(grains - 4, 1e-9), 3.0), 1.0)
    return factor


def _half_width(patches: Patches) -> float:
    return float(patches.cell_px * (patches.side // 2))


def _residuals(J: Array, x: Array, y: Array, weight: Array) -> Array:
    return (y - (x[:, None, :] @ J)[:, 0]) * np.sqrt(weight)


def _lonely(z: Array, patches: Patches, spots: Spots) -> Bools:
    """Cells that stick out of the fit and of all eight neighbours: hot or dead pixels, never the body of a spot."""
    side = patches.side
    size = np.abs(z).reshape(-1, side, side)
    padded = np.pad(size, ((0, 0), (1, 1), (1, 1)))
    around = np.zeros_like(size)
    for i in range(3):
        for j in range(3):
            if (i, j) != (1, 1):
                np.maximum(around, padded[:, i : i + side, j : j + side], out=around)
    lonely = ((size > _OUTLIER) & (size > 2.5 * around)).reshape(len(z), -1)
    # The middle of a spot about one pixel wide is lonely by nature.
    offset = patches.origin - spots.uv
    r2 = (patches.du + offset[:, :1]) ** 2 + (patches.dv + offset[:, 1:]) ** 2
    narrow = np.minimum(spots.shape[:, 0], spots.shape[:, 2]) < 0.8**2
    return lonely & ~(narrow[:, None] & (r2 < 1.8**2))


def _grain(z: Array, side: int) -> Array:
    """Number of cells (n,) over which residuals go together: by so much fewer independent ones does the fit have.

    Speckle is smooth, so chi2 alone understates what it does to the centre. The sum of the residuals' autocorrelation
    over lags up to two cells.
    """
    r = z.reshape(-1, side, side)
    power = np.maximum((r * r).sum(axis=(1, 2)), 1e-12)
    area = np.ones(len(r))
    for i in range(3):
        for j in range(-2, 3):
            if (i, j) > (0, 0):
                a = r[:, i:, max(j, 0) : side + min(j, 0)]
                b = r[:, : side - i, max(-j, 0) : side + min(-j, 0)]
                area += 2 * (a * b).sum(axis=(1, 2)) / power
    return np.maximum(area, 1.0)
