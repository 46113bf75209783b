"""Measuring candidates: all of a picture are fitted together, each with its neighbours' light taken off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Ints
from tracking import ellipses
from tracking.gaussian_fit import Spots, judged, solve, stepped
from tracking.noise import NoiseModel, Picture
from tracking.patches import Patches, Window, chunks, cut, profile

_STEPS = 12  # Gauss-Newton converges in three or four; a clipped spot, whose top must be guessed, takes up to ten
_CONVERGED = 0.15  # of the centre's own sigma. The next step would be some hundredths of this one
_WINDOW = (
    3.2  # sigmas from centre to the window's side; 2.5 costs 8 % of the accuracy, for the plane is then badly known
)
_MOST_NEIGHBOURS = 6
_FEW = 16  # so few spots step on together until the last rests: the numpy calls cost the same for one as for all
_MOST_CELLS = {1: 18, 2: 36, 4: 24}  # from a window's centre to its side, by the cells' size


@dataclass(frozen=True, slots=True)
class Measurement:
    """What the fit says of n candidates, in their order."""

    spots: Spots
    cov_px2: Array  # (n, 2, 2), of the centre
    sigma_flux: Array  # (n,), DN
    peak: Array  # (n,), DN above the plane, of the pixels
    chi2: Array  # (n,) per degree of freedom
    explained: Array  # (n,) share of what stands out of the plane, beyond noise, that the Gaussian explains


def measure(
    image: Picture, uv: Array, shape: Array, background_dn: Array, noise: NoiseModel, saturation_dn: float,
    widest_px: float,
) -> Measurement:  # fmt: skip
    """Fit all candidates of a picture (h, w) together, from moments (uv (n, 2), px; shape (n, 3), px^2).

    background_dn (n,) is a first idea of theirs. Gauss-Newton steps from there; clipped pixels, pixels outside and hot
    pixels are left out; the light of the neighbours, as of the step before, is taken off. A candidate that grows
    beyond widest_px or walks away is given up: its cov_px2 stays nan.
    """
    return refine(image, first_guess(image, uv, shape, background_dn), noise, saturation_dn, widest_px)


def first_guess(image: Picture, uv: Array, shape: Array, background: Array) -> Spots:
    """Spots with the flux that the pixel at their centre suggests."""
    u = np.clip(np.rint(uv[:, 0]).astype(np.int64), 0, image.shape[1] - 1)
    v = np.clip(np.rint(uv[:, 1]).astype(np.int64), 0, image.shape[0] - 1)
    size = 2 * np.pi * np.sqrt(np.maximum(ellipses.determinant(shape + np.array([1.0, 0.0, 1.0]) / 12), 1e-3))
    plane = np.zeros((len(uv), 3))
    plane[:, 0] = background
    return Spots(uv, shape, size * np.maximum(image[v, u] - background, 1.0), plane)


def refine(image: Picture, spots: Spots, noise: NoiseModel, saturation_dn: float, widest_px: float) -> Measurement:
    """Gauss-Newton from given spots, as long as their centres move."""
    n = len(spots.uv)
    state = Spots(spots.uv.copy(), spots.shape.copy(), spots.flux.copy(), spots.plane.copy())
    out = Measurement(
        state, np.full((n, 2, 2), np.nan), np.full(n, np.nan), np.zeros(n), np.full(n, np.inf), np.zeros(n)
    )
    far = 3.0 + 2.0 * ellipses.axes(spots.shape)[0]
    lost = ellipses.axes(spots.shape)[0] > 1.5 * widest_px  # moments see a spot too wide rather than too narrow
    state.flux[lost] = 0.0
    active: Ints = np.flatnonzero(~lost)
    for step in range(_STEPS):
        need = _half_widths(state.shape)
        near = _neighbours(state, need)
        before = Spots(state.uv.copy(), state.shape.copy(), state.flux.copy(), state.plane)
        moved = np.zeros(n, dtype=bool)
        for window, members in _windows(state.shape, need, active):
            for rows in chunks(members, window):
                patches = cut(image, before.uv[rows], window, saturation_dn)
                here = before[rows]
                solution = solve(patches, here, _light_of_neighbours(patches, rows, near, before), noise)
                there = stepped(here, solution)
                sigma = np.sqrt(np.maximum(solution.inverse[:, [0, 1], [0, 1]], 1e-12))
                moved[rows] = (np.abs(there.uv - here.uv) > _CONVERGED * sigma).any(axis=1)
                if len(rows) <= _FEW:
                    moved[rows] = moved[rows].any()
                state.uv[rows], state.shape[rows] = there.uv, there.shape
                state.flux[rows], state.plane[rows] = there.flux, there.plane
                done = ~moved[rows] if step < _STEPS - 1 else np.ones(len(rows), dtype=bool)
                if done.any():
                    quality = judged(solution, done)
                    at = rows[done]
                    out.cov_px2[at], out.sigma_flux[at], out.peak[at] = quality.cov, quality.sigma_flux, quality.peak
                    out.chi2[at], out.explained[at] = quality.chi2, quality.explained
        lost = (ellipses.axes(state.shape)[0] > 1.5 * widest_px) | (np.hypot(*(state.uv - spots.uv).T) > far)
        state.flux[lost] = 0.0
        moved &= ~lost
        if step == _STEPS - 1:  # a centre that still moves is known no better than by that
            last = (state.uv - before.uv)[active]
            out.cov_px2[active] += last[:, :, None] * last[:, None, :]
        if len(near):
            moved[near[moved[near[:, 1]], 0]] = True
        active = np.flatnonzero(moved)
        if not len(active):
            break
    out.cov_px2[state.flux <= 0] = np.nan
    return out


def _half_widths(shape: Array) -> Array:
    """Half width (n,), px, of the window that each spot needs: its wings and a ring of background."""
    return _WINDOW * np.sqrt(np.maximum(shape[:, 0], shape[:, 2]) + 1 / 12) + 1.0


def _neighbours(spots: Spots, need: Array) -> Ints:
    """Pairs (m, 2), by the first spot: the second one's light reaches into the first one's window."""
    n = len(spots.uv)
    if n < 2:
        return np.zeros((0, 2), dtype=np.int64)
    # A window may be as large as that of the largest spot of its group (_windows).
    window = np.where(need <= 12, 13.0, np.where(need <= 36, need + 18.0, need + 36.0))
    gap = np.abs(spots.uv[:, None, :] - spots.uv[None, :, :]).max(axis=2) - 1.25 * need[None, :] - window[:, None]
    gap[:, spots.flux <= 0] = np.inf
    np.fill_diagonal(gap, np.inf)
    if n > _MOST_NEIGHBOURS + 1 and ((gap < 0).sum(axis=1) > _MOST_NEIGHBOURS).any():
        nearest = np.partition(gap, _MOST_NEIGHBOURS, axis=1)[:, _MOST_NEIGHBOURS]
        gap[gap >= nearest[:, None]] = np.inf
    return np.argwhere(gap < 0)


def _light_of_neighbours(patches: Patches, rows: Ints, near: Ints, spots: Spots) -> Array | float:
    """Grey value (n, cells) that the other spots put into the patches of `rows`."""
    if not len(near):
        return 0.0
    place = np.full(len(spots.uv), -1)
    place[rows] = np.arange(len(rows))
    pairs = near[place[near[:, 0]] >= 0]
    if not len(pairs):
        return 0.0
    light = np.zeros_like(patches.values)
    # The k-th neighbour of every spot that has one: no spot comes twice in one addition.
    _, start, count = np.unique(pairs[:, 0], return_index=True, return_counts=True)
    for k in range(count.max()):
        one = pairs[start[count > k] + k]
        here, there = place[one[:, 0]], one[:, 1]
        light[here] += profile(patches, here, spots.uv[there], spots.shape[there]).value * spots.flux[there, None]
    return light


def _windows(shape: Array, need: Array, active: Ints) -> list[tuple[Window, Ints]]:
    """Groups of the active spots that share a window: few, since every group costs a round of numpy calls."""
    slim = ellipses.eigenvalues(shape[active])[0] < 9.0
    half = need[active]
    groups = [
        (1, half <= 12),
        (1, (half > 12) & (half <= 18)),
        (2, (half > 18) & ((half <= 36) | slim)),  # a long streak too: cells of four would blur its narrow side
        (4, (half > 36) & ~slim),
    ]
    out = []
    for cell, members in groups:
        if members.any():
            cells = np.clip(half[members].max() / cell, 7.0, _MOST_CELLS[cell])
            out.append((Window(int(np.ceil(cells)), cell), active[members]))
    return out
