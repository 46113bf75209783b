"""Points that stay in their places in a recording while others move: lamps, reflections and edges, no spots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from geometry.arrays import Array, Bools

SAME_PX = 2.0  # points nearer to each other are at the same place
_FEWEST_FRAMES = 2  # in one frame all points are where they are
NOWHERE = np.zeros((0, 2))


def resting_places(frames: Mapping[str, Sequence[Array]], least_moving: int, share: float) -> dict[str, Array]:
    """By camera the places (m, 2) of points at rest, from the points (n, 2), px, of some frames; m may be 0.

    share: of a camera's frames that have a point there; more than half. None are at rest unless so many others are in
    the usual frame of all cameras together: a pose has to be possible without those at rest, or the vehicle may be at
    rest itself. Source: ours.
    """
    out: dict[str, Array] = {}
    moving = np.zeros(max(map(len, frames.values()), default=0))
    for name, uv in frames.items():
        every = np.concatenate([NOWHERE, *uv])
        count = np.count_nonzero([at_places(every, one) for one in uv], axis=0) if len(uv) else np.zeros(0)
        resting = count >= share * len(uv)
        out[name] = every[resting]
        moving[: len(uv)] += [np.count_nonzero(~at_places(one, out[name])) for one in uv]
    if len(moving) >= _FEWEST_FRAMES and np.median(moving) >= least_moving:
        return out
    return dict.fromkeys(frames, NOWHERE)


def at_places(uv_px: Array, places: Array) -> Bools:
    """(n,): which points (n, 2), px, are at one of these places (m, 2)."""
    away = np.linalg.norm(uv_px[:, None] - places, axis=-1)
    return np.asarray((away <= SAME_PX).any(axis=1))
