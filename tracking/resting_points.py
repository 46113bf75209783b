"""Points that stay in their places in a recording while others move: lamps, reflections and edges, no spots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

from geometry.arrays import Array, Bools

SAME_PX = 2.0  # points nearer to each other are at the same place
_STEADY_PX = 3.0  # second difference of a spot's places in three successive frames, at most
_FASTEST_PX = 60.0  # of a spot from frame to frame; what is farther away is another point
_FEWEST_FRAMES = 2  # in one frame all points are where they are
# Mean square about the mean of what is at a place, in that of its noise from frame to frame, above which it moves ...
_MOVES = 4.0
_LEAST_MOVED_PX = 0.3  # ... if it is more than so much per axis: a camera that drifts moves lamps, too
NOWHERE = np.zeros((0, 2))
Three: TypeAlias = tuple[Array, Array, Array]  # the points (n, 2), px, of three successive frames


def resting_places(frames: Mapping[str, Sequence[Three]], least_moving: int, share: float) -> dict[str, Array]:
    """By camera the places (m, 2) of points at rest, from some frames, each with its neighbours; m may be 0.

    share: of a camera's frames that have a point there; more than half. None are at rest unless so many others move
    steadily in the usual frame of all cameras together: a pose has to be possible without those at rest, or the vehicle
    may be at rest itself, among false points that are in other places in each frame. A spot far from a camera may stay
    near one place, but moves there from frame to frame. Source: ours.
    """
    out: dict[str, Array] = {}
    moving = np.zeros(max(map(len, frames.values()), default=0))
    for name, threes in frames.items():
        every = np.concatenate([NOWHERE, *(here for _, here, _ in threes)])
        count = sum((at_places(every, here).astype(int) for _, here, _ in threes), np.zeros(len(every), int))
        places = every[count >= share * len(threes)]
        # At the ends of its way a spot is near the place for a part of it only.
        out[name] = places[~at_places(places, places[_moving(places, threes)])]
        for k, three in enumerate(threes):
            moving[k] += _steady(*(uv[~at_places(uv, out[name])] for uv in three))
    if len(moving) >= _FEWEST_FRAMES and np.median(moving) >= least_moving:
        return out
    return dict.fromkeys(frames, NOWHERE)


def _moving(places: Array, threes: Sequence[Three]) -> Bools:
    """(m,): whether what is at places (m, 2) moves more than its noise from frame to frame explains."""
    if not len(places):
        return np.zeros(0, dtype=bool)
    paths = np.array([[_nearest(places, uv) for uv in three] for three in threes])
    here, bend = paths[:, 1], paths[:, 0] - 2 * paths[:, 1] + paths[:, 2]
    spread, noise = (
        np.nansum(d**2, axis=(0, 2)) / np.maximum(np.isfinite(d[..., 0]).sum(axis=0), 1)
        for d in (here - np.nanmean(here, axis=0), bend)
    )
    return np.asarray(spread > np.maximum(_MOVES * noise / 6, 2 * _LEAST_MOVED_PX**2))


def _nearest(places: Array, uv_px: Array) -> Array:
    """(m, 2): the point (n, 2) at each place (m, 2) that is nearest to it; nan without one."""
    away = np.linalg.norm(places[:, None] - uv_px, axis=-1)
    if not len(uv_px):
        return np.full_like(places, np.nan)
    at = np.argmin(away, axis=1)
    return np.where((away.min(axis=1) <= SAME_PX)[:, None], uv_px[at], np.nan)


def _steady(before: Array, here: Array, after: Array) -> int:
    """How many points (n, 2) of a frame continue a motion from the frame before to the one after it."""
    count = 0
    for uv in here:
        old, new = (near[np.linalg.norm(near - uv, axis=1) < _FASTEST_PX] for near in (before, after))
        bend = np.linalg.norm(old[:, None] + new - 2 * uv, axis=-1)
        count += bool((bend <= _STEADY_PX).any())
    return count


def at_places(uv_px: Array, places: Array) -> Bools:
    """(n,): which points (n, 2), px, are at one of these places (m, 2)."""
    away = np.linalg.norm(uv_px[:, None] - places, axis=-1)
    return np.asarray((away <= SAME_PX).any(axis=1))
