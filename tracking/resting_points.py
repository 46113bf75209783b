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
NOWHERE = np.zeros((0, 2))
Three: TypeAlias = tuple[Array, Array, Array]  # the points (n, 2), px, of three successive frames


def resting_places(frames: Mapping[str, Sequence[Three]], least_moving: int, share: float) -> dict[str, Array]:
    """By camera the places (m, 2) of points at rest, from some frames, each with its neighbours; m may be 0.

    share: of a camera's frames that have a point there; more than half. None are at rest unless so many others move
    steadily in the usual frame of all cameras together: a pose has to be possible without those at rest, or the vehicle
    may be at rest itself, among false points that are in other places in each frame. None of a camera are whose usual
    frame has no steady motion elsewhere: far from it, its spots may hardly move. Source: ours.
    """
    out: dict[str, Array] = {}
    moving = np.zeros(max(map(len, frames.values()), default=0))
    for name, threes in frames.items():
        every = np.concatenate([NOWHERE, *(here for _, here, _ in threes)])
        count = sum((at_places(every, here).astype(int) for _, here, _ in threes), np.zeros(len(every), int))
        places = every[count >= share * len(threes)]
        steady = [_steady(*(uv[~at_places(uv, places)] for uv in three)) for three in threes]
        moving[: len(steady)] += steady
        out[name] = places if steady and np.median(steady) > 0 else NOWHERE
    if len(moving) >= _FEWEST_FRAMES and np.median(moving) >= least_moving:
        return out
    return dict.fromkeys(frames, NOWHERE)


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
