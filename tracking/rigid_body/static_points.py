"""Points of light that stay where they are in the picture: reflections, lamps. They never count as a spot's return.

Each camera has a list of places at which points without a label were seen again and again. The density of false points
at such a place is much larger than elsewhere, and that density is all that the search for labels needs to know.
Source: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled

MOST_PLACES = 64  # per camera
SIGMAS, LEAST_RADIUS_PX = 5.0, 0.4  # of a place: so many sigmas of a point, and at least this
LEAST_SEEN = 4.0  # times that a place must have been seen
FADES = 0.99  # of a place's count, per frame as it comes: what is gone is forgotten within some hundred frames
NEAR_PX = 3.0  # a point so near to where a spot is expected may be that spot, labelled or not


class StaticPlaces(NamedTuple):
    """Of c cameras, up to MOST_PLACES each."""

    uv: Array  # (c, MOST_PLACES, 2) px
    seen: Array  # (c, MOST_PLACES) how often a point without a label was there, fading; 0: no place
    frames: Array  # (c,) how many frames were looked at, fading alike


def no_places(cameras: int) -> StaticPlaces:
    """Nothing learnt yet."""
    return StaticPlaces(np.zeros((cameras, MOST_PLACES, 2)), np.zeros((cameras, MOST_PLACES)), np.zeros(cameras))


@compiled
def radius2_px2(cov: Array) -> float:
    """The squared radius of a place, px^2, for a point of covariance (2, 2)."""
    return max(SIGMAS * SIGMAS * 0.5 * (cov[0, 0] + cov[1, 1]), LEAST_RADIUS_PX * LEAST_RADIUS_PX)


@compiled
def log_density(places: StaticPlaces, uv: Array, cov: Array, first: Ints) -> Array:
    """(m,) log of the density of false points, 1/px^2, at each of a frame's points; -inf where no place is known.

    uv (m, 2), cov (m, 2, 2); first (c + 1,): where each camera's points begin.
    """
    out = np.full(uv.shape[0], -np.inf)
    for c in range(first.shape[0] - 1):
        if places.frames[c] <= 0.0:
            continue
        for d in range(first[c], first[c + 1]):
            r2 = radius2_px2(cov[d])
            count = 0.0
            for k in range(MOST_PLACES):
                a, b = places.uv[c, k, 0] - uv[d, 0], places.uv[c, k, 1] - uv[d, 1]
                if places.seen[c, k] > 0.0 and a * a + b * b < r2:
                    count += places.seen[c, k]
            if count >= LEAST_SEEN:
                out[d] = np.log(min(count / places.frames[c], 1.0) / (np.pi * r2))
    return out


@compiled
def learn(
    places: StaticPlaces,
    uv: Array,
    cov: Array,
    first: Ints,
    has_image: Bools,
    assigned: Ints,
    expected: Array,
    camera_of: Ints,
    fades: float,
) -> None:
    """Take a frame whose pose is known, in place. assigned (n,): the point of each view's spot, -1 without; expected
    (n, 2), px: where the pose puts it. Points that are spots, or lie near one's place, say nothing. fades: 1 or FADES.
    """
    for c in range(first.shape[0] - 1):
        if not has_image[c]:
            continue
        places.frames[c] = fades * places.frames[c] + 1.0
        for k in range(MOST_PLACES):
            places.seen[c, k] *= fades
        for d in range(first[c], first[c + 1]):
            spot = False
            for i in range(assigned.shape[0]):
                if camera_of[i] == c:
                    a, b = expected[i, 0] - uv[d, 0], expected[i, 1] - uv[d, 1]
                    spot |= assigned[i] == d or a * a + b * b < NEAR_PX * NEAR_PX
            if spot:
                continue
            r2 = radius2_px2(cov[d])
            best, least = -1, r2
            weakest = 0
            for k in range(MOST_PLACES):
                if places.seen[c, k] < places.seen[c, weakest]:
                    weakest = k
                a, b = places.uv[c, k, 0] - uv[d, 0], places.uv[c, k, 1] - uv[d, 1]
                if places.seen[c, k] > 0.0 and a * a + b * b < least:
                    best, least = k, a * a + b * b
            if best >= 0:
                places.seen[c, best] += 1.0
                share = 1.0 / places.seen[c, best]
                for a in range(2):
                    places.uv[c, best, a] += share * (uv[d, a] - places.uv[c, best, a])
            elif places.seen[c, weakest] < 1.5:
                places.seen[c, weakest] = 1.0
                places.uv[c, weakest, 0], places.uv[c, weakest, 1] = uv[d, 0], uv[d, 1]
