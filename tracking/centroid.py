"""Measuring candidates: an elliptical Gaussian on a background plane, fitted to each with its neighbours taken off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints
from tracking.noise import NoiseModel, Picture
from tracking.patches import Patches, cut, profile

_STEPS = 12  # Gauss-Newton converges in three or four; a clipped spot, whose top must be guessed, takes up to ten
_CONVERGED = 0.02  # of the centre's own sigma: a further step would move the result by less
_LEAST_VARIANCE = 0.02  # px^2: narrower is a point to any sensor
_WINDOW = (
    3.2  # sigmas from centre to the window's side. 2.5 costs 8 % of the accuracy, as the plane is then badly known
)
_CELLS_AT_ONCE = 300_000  # bounds the memory of crowded pictures
_OUTLIER = 6.0  # sigmas by which a hot or dead pixel sticks out of fit and neighbours


@dataclass(frozen=True, slots=True)
class Fit:
    """What the fit says of n candidates, in their order."""

    uv_px: Array  # (n, 2)
    cov_px2: Array  # (n, 2, 2)
    shape_px2: Array  # (n, 3): uu, uv, vv of the Gaussian before the pixels integrated it
    flux: Array  # (n,), DN: of the fitted Gaussian, so also above the clipping level
    sigma_flux: Array  # (n,), DN
    peak: Array  # (n,), DN above the plane, of the pixels
    chi2: Array  # (n,) per degree of freedom
    explained: Array  # (n,) share of the variance about the plane that the Gaussian explains
    converged: Bools  # (n,)


@dataclass(frozen=True, slots=True)
class _Window:
    half: int
    cell_px: int


def measure(image: Picture, start_uv_px: Array, background_dn: Array, noise: NoiseModel, saturation_dn: float) -> Fit:
    """Fit all candidates (n, 2), px, of a picture (h, w) together; background_dn (n,) is a first idea of theirs.

    Adaptive elliptical moments give the start; Gauss-Newton steps weighted by the noise model's variance at the
    fitted level follow (so no bias from weighting with the noisy value itself). Clipped pixels, pixels outside and
    hot pixels are left out. The covariance is the inverse of the normal matrix, raised where the residuals are
    larger than the noise.

    Source: moments after Bernstein & Jarvis (2002), "Shapes and shears, stars and smears", Astron. J. 123; the fit is
    plain weighted least squares, whose covariance is the Cramer-Rao bound for this model with normal noise.
    """
    uv, shape = _moments(image, start_uv_px, background_dn, noise, saturation_dn)
    return _refine(image, uv, shape, background_dn, noise, saturation_dn)


# --- adaptive moments -------------------------------------------------------------------------------------------------


def _moments(image: Picture, uv: Array, background: Array, noise: NoiseModel, saturation: float) -> tuple[Array, Array]:
    """Centres (n, 2) and covariances (n, 3) by a Gaussian window that adapts to what it sees, in growing patches."""
    uv = uv.copy()
    shape = np.tile([2.0, 0.0, 2.0], (len(uv), 1))
    left: Ints = np.arange(len(uv))
    for window, limit in ((_Window(9, 1), 3.0), (_Window(18, 2), 9.0), (_Window(18, 4), np.inf)):
        for rows in _chunks(left, window):
            # Clipped pixels stay in: for a first width and centre a cut top is better than a hole.
            patches = cut(image, uv[rows], window.half, window.cell_px, np.inf)
            level = background[rows]
            if window.cell_px > 1:
                level = np.median(patches.values[:, _border(patches.side)], axis=1)
            own = patches.valid & _nearest(patches, rows, uv)
            for _ in range(3):
                uv[rows], shape[rows] = _one_round(patches, own, level, uv[rows], shape[rows])
        left = left[np.sqrt(np.maximum(shape[left, 0], shape[left, 2])) > limit]
        if not len(left):
            break
    return uv, shape


def _one_round(patches: Patches, own: Bools, level: Array, uv: Array, shape: Array) -> tuple[Array, Array]:
    """A Gaussian seen through a window of its own size: covariance half the true one, offset half the true one."""
    seen = profile(patches, slice(None), uv, shape)
    weight = np.where(own, seen.value, 0.0) * (patches.values - level[:, None])
    total = np.maximum(weight.sum(axis=1), 1e-9)
    offset = patches.origin - uv
    du, dv = patches.du + offset[:, :1], patches.dv + offset[:, 1:]
    mu, mv = (weight * du).sum(axis=1) / total, (weight * dv).sum(axis=1) / total
    weighted_u, weighted_v = weight * du, weight * dv
    found = np.stack(
        [
            (weighted_u * du).sum(axis=1) / total - mu**2,
            (weighted_u * dv).sum(axis=1) / total - mu * mv,
            (weighted_v * dv).sum(axis=1) / total - mv**2,
        ],
        axis=1,
    )
    pixel = patches.cell_px**2 / 12
    window = _matrices(shape) + pixel * np.eye(2)
    # In the window's own metric: measured m, window 1, spot s: 1/m = 1/s + 1.
    values, vectors, root = _relative(window, _matrices(found))
    values = np.clip(values, 0.15, 0.75)
    grown = _back(values / (1 - values), vectors, root)
    step = np.stack([mu, mv], axis=1) * 2.0
    length = np.sqrt(np.einsum("ni,nij,nj->n", step, np.linalg.inv(window), step))
    step *= np.minimum(1.0, 1.0 / np.maximum(length, 1e-9))[:, None]
    return uv + step, _entries(_at_least(grown - pixel * np.eye(2), 0.1))


# --- Gauss-Newton -----------------------------------------------------------------------------------------------------


def _refine(image: Picture, uv: Array, shape: Array, background: Array, noise: NoiseModel, saturation: float) -> Fit:
    n = len(uv)
    uv, shape = uv.copy(), shape.copy()
    peak = image[
        np.clip(np.rint(uv[:, 1]).astype(int), 0, image.shape[0] - 1),
        np.clip(np.rint(uv[:, 0]).astype(int), 0, image.shape[1] - 1),
    ]
    roundish = np.sqrt(np.maximum((shape[:, 0] + 0.1) * (shape[:, 2] + 0.1) - shape[:, 1] ** 2, 1e-3))
    flux = 2 * np.pi * roundish * np.maximum(peak - background, 1.0)
    plane = np.zeros((n, 3))  # level at the centre, DN; slopes, DN/px
    plane[:, 0] = background
    cov, sigma_flux = np.full((n, 2, 2), np.nan), np.full(n, np.nan)
    chi2, explained, top = np.full(n, np.inf), np.zeros(n), np.zeros(n)
    converged = np.zeros(n, dtype=bool)
    active: Ints = np.arange(n)
    for step_number in range(_STEPS):
        near = _neighbours(uv, shape, flux)
        moved = np.zeros(n, dtype=bool)
        before = (uv.copy(), shape.copy(), flux.copy())
        for window, members in _windows(shape, active):
            for rows in _chunks(members, window):
                patches = cut(image, uv[rows], window.half, window.cell_px, saturation)
                others = _light_of_neighbours(patches, rows, near, *before)
                step = _solve(patches, uv[rows], shape[rows], flux[rows], plane[rows], others, noise, step_number > 0)
                new_uv, new_shape, new_flux = _limited(uv[rows], shape[rows], flux[rows], step.x)
                sigma = np.sqrt(np.maximum(step.cov[:, [0, 1], [0, 1]], 1e-12))
                moved[rows] = (np.abs(new_uv - uv[rows]) > _CONVERGED * sigma).any(axis=1)
                offset = new_uv - patches.origin
                plane[rows, 1:] = step.x[:, 7:9]
                plane[rows, 0] = step.x[:, 6] + (step.x[:, 7:9] * offset).sum(axis=1)
                uv[rows], shape[rows], flux[rows] = new_uv, new_shape, new_flux
                cov[rows], sigma_flux[rows], top[rows] = step.cov, step.sigma_flux, step.top
                chi2[rows], explained[rows] = step.chi2, step.explained
        converged[active] = ~moved[active]
        if len(near):
            moved[near[moved[near[:, 1]], 0]] = True
        active = np.flatnonzero(moved)
        if not len(active):
            break
    return Fit(uv, cov, shape, flux, sigma_flux, top, chi2, explained, converged)


@dataclass(frozen=True, slots=True)
class _Step:
    x: Array  # (n, 9): du, dv, d uu, d uv, d vv, flux, plane at the patch's origin, its slopes
    cov: Array  # (n, 2, 2), px^2
    sigma_flux: Array
    chi2: Array
    explained: Array
    top: Array


def _solve(
    patches: Patches, uv: Array, shape: Array, flux: Array, plane: Array, others: Array | float, noise: NoiseModel,
    drop_outliers: bool,
) -> _Step:  # fmt: skip
    """One weighted linear least-squares problem per spot: flux and plane whole, centre and shape as increments."""
    g = profile(patches, slice(None), uv, shape)
    n, cells = g.value.shape
    scale = 1.0 / (patches.cell_px * (patches.side // 2))
    J = np.empty((n, 9, cells))
    light = g.value * flux[:, None]
    J[:, 0] = light * g.wu
    J[:, 1] = light * g.wv
    J[:, 2] = light * (0.5 * (g.wu * g.wu - g.inverse[:, :1]))
    J[:, 3] = light * (g.wu * g.wv - g.inverse[:, 1:2])
    J[:, 4] = light * (0.5 * (g.wv * g.wv - g.inverse[:, 2:]))
    J[:, 5] = g.value
    J[:, 6] = 1.0
    J[:, 7] = patches.du * scale
    J[:, 8] = patches.dv * scale
    offset = patches.origin - uv
    ground = (plane[:, 0] + (plane[:, 1:] * offset).sum(axis=1))[:, None]
    ground = ground + plane[:, 1:2] * patches.du + plane[:, 2:] * patches.dv
    y = patches.values - others
    weight = patches.valid / (noise.variance(light + ground + others) / patches.cell_px**2)
    x, inverse, rhs, yy = _normal_equations(J, weight, y)
    z = (y - np.einsum("nkp,nk->np", J, x)) * np.sqrt(weight)
    if drop_outliers and (np.abs(z) > _OUTLIER).any():
        outliers = _lonely(z, patches, uv, shape)
        if outliers.any():
            weight = np.where(outliers, 0.0, weight)
            x, inverse, rhs, yy = _normal_equations(J, weight, y)
            z = (y - np.einsum("nkp,nk->np", J, x)) * np.sqrt(weight)
    free = np.maximum((weight > 0).sum(axis=1) - 9, 1)
    chi2 = np.maximum(yy - (x * rhs).sum(axis=1), 0.0)
    # What a plane alone leaves over, from the plane's part of the same normal equations.
    plane_only = _plane_only(J, weight, y)
    flat = np.maximum(plane_only, 1e-9)
    reduced = chi2 / free
    bad = reduced > 1 + 3 * np.sqrt(2.0 / free)
    factor = np.where(bad, reduced, 1.0)
    if bad.any():
        factor[bad] *= _grain(z[bad], patches.side)
    top_cells = np.where(weight > 0, y - np.einsum("nkp,nk->np", J[:, 6:], x[:, 6:]), -np.inf)
    clipped = ~patches.valid
    if clipped.any():
        all_cells = y - np.einsum("nkp,nk->np", J[:, 6:], x[:, 6:])
        near_core = g.value > 0.3 * g.value.max(axis=1, keepdims=True)
        top_cells = np.where(clipped & near_core, all_cells, top_cells)
    x[:, 7:9] *= scale
    return _Step(
        x,
        inverse[:, :2, :2] * factor[:, None, None],
        np.sqrt(np.maximum(inverse[:, 5, 5] * factor, 0.0)),
        reduced,
        1 - chi2 / flat,
        top_cells.max(axis=1),
    )


def _normal_equations(J: Array, weight: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Solution (n, k), inverse normal matrix (n, k, k), right-hand side and y^T W y of n problems with J (n, k, p)."""
    JW = J * weight[:, None, :]
    N = JW @ J.transpose(0, 2, 1)
    rhs = np.einsum("nkp,np->nk", JW, y)
    d = np.sqrt(np.einsum("nkk->nk", N)) + 1e-12
    k = J.shape[1]
    scaled = N / (d[:, :, None] * d[:, None, :]) + 1e-9 * np.eye(k)  # the ridge only keeps hopeless cases finite
    inverse = np.linalg.inv(scaled) / (d[:, :, None] * d[:, None, :])
    return np.einsum("nij,nj->ni", inverse, rhs), inverse, rhs, np.einsum("np,np,np->n", y, weight, y)


def _plane_only(J: Array, weight: Array, y: Array) -> Array:
    x, _, rhs, yy = _normal_equations(J[:, 6:], weight, y)
    return yy - (x * rhs).sum(axis=1)


def _limited(uv: Array, shape: Array, flux: Array, x: Array) -> tuple[Array, Array, Array]:
    """The step, at most one sigma long, with axes that change by at most a factor 2.5 in variance."""
    S = _matrices(shape) + np.eye(2) / 12
    step = x[:, :2]
    length = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", step, np.linalg.inv(S), step), 0.0))
    new_uv = uv + step * np.minimum(1.0, 1.0 / np.maximum(length, 1e-12))[:, None]
    values, vectors, root = _relative(S, S + _matrices(x[:, 2:5]))
    if ((values < 0.4) | (values > 2.5)).any():
        S_new = _back(np.clip(values, 0.4, 2.5), vectors, root)
    else:
        S_new = S + _matrices(x[:, 2:5])
    new_shape = _entries(_at_least(S_new - np.eye(2) / 12, _LEAST_VARIANCE))
    return new_uv, new_shape, np.clip(x[:, 5], 0.2 * flux, 5 * flux)


def _lonely(z: Array, patches: Patches, uv: Array, shape: Array) -> Bools:
    """Cells that stick out of the fit and of all eight neighbours: hot or dead pixels, never the body of a spot."""
    n, side = len(z), patches.side
    size = np.abs(z).reshape(n, side, side)
    padded = np.zeros((n, side + 2, side + 2))
    padded[:, 1:-1, 1:-1] = size
    around = np.zeros_like(size)
    for i in range(3):
        for j in range(3):
            if (i, j) != (1, 1):
                np.maximum(around, padded[:, i : i + side, j : j + side], out=around)
    lonely = ((size > _OUTLIER) & (size > 2.5 * around)).reshape(n, -1)
    # The middle of a spot about one pixel wide is lonely by nature.
    offset = patches.origin - uv
    r2 = (patches.du + offset[:, :1]) ** 2 + (patches.dv + offset[:, 1:]) ** 2
    narrow = np.minimum(shape[:, 0], shape[:, 2]) < 0.8**2
    return lonely & ~(narrow[:, None] & (r2 < 1.8**2))


def _grain(z: Array, side: int) -> Array:
    """Number of cells (n,) over which residuals go together: by so much fewer independent ones does the fit have.

    Speckle and rings are smooth, so chi2 alone understates what they do to the centre. Sum of the residuals'
    autocorrelation over lags up to two cells.
    """
    n = len(z)
    r = z.reshape(n, side, side)
    power = np.maximum((r * r).sum(axis=(1, 2)), 1e-12)
    area = np.ones(n)
    for i in range(3):
        for j in range(-2, 3):
            if (i, j) > (0, 0):
                a = r[:, i:, max(j, 0) : side + min(j, 0)]
                b = r[:, : side - i, max(-j, 0) : side + min(-j, 0)]
                area += 2 * (a * b).sum(axis=(1, 2)) / power
    return np.maximum(area, 1.0)


# --- neighbours -------------------------------------------------------------------------------------------------------


def _neighbours(uv: Array, shape: Array, flux: Array) -> Ints:
    """Pairs (m, 2) where the second spot's light reaches into the first one's window."""
    n = len(uv)
    if n < 2:
        return np.zeros((0, 2), dtype=np.int64)
    reach = 4.0 * np.sqrt(np.maximum(shape[:, 0], shape[:, 2]) + 0.1)
    window = _WINDOW * np.sqrt(2.0) * np.sqrt(np.maximum(shape[:, 0], shape[:, 2]) + 0.1) + 4.0
    gap = np.abs(uv[:, None, :] - uv[None, :, :]).max(axis=2)
    close = gap < window[:, None] + reach[None, :]
    np.fill_diagonal(close, False)
    return np.argwhere(close)


def _light_of_neighbours(
    patches: Patches, rows: Ints, near: Ints, uv: Array, shape: Array, flux: Array
) -> Array | float:
    """Grey value (n, cells) that the other spots put into the patches of `rows`."""
    if not len(near):
        return 0.0
    place = np.full(len(uv), -1)
    place[rows] = np.arange(len(rows))
    pairs = near[place[near[:, 0]] >= 0]
    if not len(pairs):
        return 0.0
    light = np.zeros_like(patches.values)
    most = max(_CELLS_AT_ONCE // patches.values.shape[1], 1)
    for i in range(0, len(pairs), most):
        here, there = place[pairs[i : i + most, 0]], pairs[i : i + most, 1]
        np.add.at(light, here, profile(patches, here, uv[there], shape[there]).value * flux[there, None])
    return light


def _nearest(patches: Patches, rows: Ints, uv: Array) -> Bools:
    """Cells (n, cells) that lie nearer to their own spot than to any other."""
    own = np.ones(patches.values.shape, dtype=bool)
    if len(uv) < 2:
        return own
    between = uv[None, :, :] - uv[rows, None, :]
    size = 2.0 * patches.cell_px * patches.side
    close = np.abs(between).max(axis=2) < size
    close[np.arange(len(rows)), rows] = False
    here, there = np.nonzero(close)
    for i, d in zip(here, between[here, there], strict=True):
        offset = patches.origin[i] - uv[rows[i]]
        own[i] &= (patches.du + offset[0]) * d[0] + (patches.dv + offset[1]) * d[1] <= 0.5 * (d @ d)
    return own


# --- windows and 2x2 matrices -----------------------------------------------------------------------------------------


def _windows(shape: Array, active: Ints) -> list[tuple[_Window, Ints]]:
    """Which window each active spot gets: wide enough for its wings and a ring of background."""
    longest = np.sqrt(np.maximum(shape[active, 0], shape[active, 2]) + 1 / 12)
    need = _WINDOW * longest + 1.0
    half_trace, half_gap = 0.5 * (shape[active, 0] + shape[active, 2]), 0.5 * (shape[active, 0] - shape[active, 2])
    slim = np.sqrt(np.maximum(half_trace - np.hypot(half_gap, shape[active, 1]), 0.0)) < 3.0
    small = need <= 12
    groups = [
        (_Window(9 if not small.any() or need[small].max() <= 9 else 12, 1), small),
        (_Window(18, 1), ~small & (need <= 18)),
        (_Window(18, 2), (need > 18) & (need <= 36)),
        (_Window(36, 2), (need > 36) & slim),  # a long streak: cells of four would blur its narrow side
        (_Window(18, 4), (need > 36) & ~slim),
    ]
    return [(window, active[members]) for window, members in groups if members.any()]


def _chunks(rows: Ints, window: _Window) -> list[Ints]:
    most = max(_CELLS_AT_ONCE // ((2 * window.half + 1) ** 2 * window.cell_px), 1)
    return [rows[i : i + most] for i in range(0, len(rows), most)]


def _border(side: int) -> Bools:
    edge = np.ones((side, side), dtype=bool)
    edge[1:-1, 1:-1] = False
    return edge.reshape(-1)


def _matrices(entries: Array) -> Array:
    return entries[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


def _entries(matrices: Array) -> Array:
    return matrices.reshape(-1, 4)[:, [0, 1, 3]]


def _at_least(matrices: Array, least: float) -> Array:
    """Symmetric matrices (n, 2, 2) with eigenvalues raised to `least`."""
    values, vectors = np.linalg.eigh(matrices)
    if (values >= least).all():
        return matrices
    return (vectors * np.maximum(values, least)[:, None, :]) @ vectors.transpose(0, 2, 1)


def _relative(base: Array, other: Array) -> tuple[Array, Array, Array]:
    """Eigenvalues (n, 2) and vectors of `other` in the metric of `base` (both (n, 2, 2)), and the base's root L."""
    root = np.linalg.cholesky(base)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ other @ inverse.transpose(0, 2, 1))
    return values, vectors, root


def _back(values: Array, vectors: Array, root: Array) -> Array:
    mixed = root @ vectors
    return (mixed * values[:, None, :]) @ mixed.transpose(0, 2, 1)
