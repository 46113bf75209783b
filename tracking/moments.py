"""A first centre and size of each candidate: moments under a Gaussian window that adapts to what it sees."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools, Ints
from tracking import ellipses
from tracking.noise import Picture
from tracking.patches import Patches, Window, chunks, cut

# Growing windows, each with its rounds and the 1-sigma half axis (px) up to which it serves.
_WINDOWS = ((Window(9, 1), 3, 3.5), (Window(18, 2), 5, 9.0), (Window(18, 4), 5, np.inf))


def adaptive_moments(image: Picture, start_uv_px: Array, background_dn: Array) -> tuple[Array, Array]:
    """Centres (n, 2), px, and covariances (n, 3: uu, uv, vv), px^2, of candidates (n, 2) on a background (n,), DN.

    Good to a tenth of a pixel or so, which is enough to start a fit.
    Source: Bernstein & Jarvis (2002), "Shapes and shears, stars and smears", Astron. J. 123, section 3.
    """
    uv = start_uv_px.copy()
    shape = np.tile([2.0, 0.0, 2.0], (len(uv), 1))
    left: Ints = np.arange(len(uv))
    for window, rounds, limit in _WINDOWS:
        for rows in chunks(left, window):
            # Clipped pixels stay in: for a first width and centre a cut top is better than a hole.
            patches = cut(image, uv[rows], window, np.inf)
            level = background_dn[rows]
            if window.cell_px > 1:  # the given background is a median over 40 px: too near to a wide spot
                level = np.median(patches.values[:, _border(patches.side)], axis=1)
            light = np.where(patches.valid & _nearest(patches, rows, uv), patches.values - level[:, None], 0.0)
            du, dv = patches.du, patches.dv
            powers = np.stack([np.ones_like(du), du, dv, du * du, du * dv, dv * dv])
            for _ in range(rounds):
                uv[rows], shape[rows] = _one_round(patches, light, powers, uv[rows], shape[rows])
        left = left[ellipses.eigenvalues(shape[left])[1] > limit**2]
        if not len(left):
            break
    return uv, shape


def _one_round(patches: Patches, light: Array, powers: Array, uv: Array, shape: Array) -> tuple[Array, Array]:
    """Under a window W a Gaussian S has covariance (1/S + 1/W)^-1; if they are equal, half its offset is seen.

    powers (6, cells): 1, du, dv, du^2, du dv, dv^2 from the patches' origins. The window's exponent is a sum of them,
    and so are the moments: two products of matrices instead of many passes over the cells.
    """
    pixel = patches.cell_px**2 / 12 * np.array([1.0, 0.0, 1.0])
    window = shape + pixel
    narrow = ellipses.inverse(window)
    a, b, c = narrow.T
    u, v = (uv - patches.origin).T
    exponent = np.stack(
        [-0.5 * (a * u * u + 2 * b * u * v + c * v * v), a * u + b * v, b * u + c * v, -0.5 * a, -b, -0.5 * c], axis=1
    )
    sums = (light * np.exp(exponent @ powers)) @ powers.T
    mean = sums[:, 1:] / np.maximum(sums[:, :1], 1e-9)
    mu, mv = mean[:, 0], mean[:, 1]
    seen = mean[:, 2:] - np.stack([mu * mu, mu * mv, mv * mv], axis=1)
    seen = ellipses.kept_within(seen, window, 0.15, 0.75)
    found = ellipses.inverse(ellipses.inverse(seen) - narrow)
    step = 2.0 * np.stack([mu - u, mv - v], axis=1)
    step = step / np.maximum(ellipses.length(step, window), 1.0)[:, None]
    return uv + step, ellipses.at_least(found - pixel, 0.1)


def _nearest(patches: Patches, rows: Ints, uv: Array) -> Bools:
    """Cells (n, cells) that lie nearer to their own spot than to any other."""
    own = np.ones(patches.values.shape, dtype=bool)
    if len(uv) < 2:
        return own
    between = uv[None, :, :] - uv[rows, None, :]
    close = np.abs(between).max(axis=2) < 1.5 * patches.cell_px * patches.side
    close[np.arange(len(rows)), rows] = False
    here, there = np.nonzero(close)
    for i, d in zip(here, between[here, there], strict=True):
        offset = patches.origin[i] - uv[rows[i]]
        own[i] &= (patches.du + offset[0]) * d[0] + (patches.dv + offset[1]) * d[1] <= 0.5 * (d @ d)
    return own


def _border(side: int) -> Bools:
    edge = np.ones((side, side), dtype=bool)
    edge[1:-1, 1:-1] = False
    return edge.reshape(-1)
