"""Static points: reflections and lamps, which stay in their place in the picture. They are not labelled as spots.

Each camera has a list of places at which unlabelled points were found repeatedly. The density of false points there is
much higher than elsewhere, and that density is all that the search for labels uses. Source: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled

MAX_PLACES = 64  # per camera
RADIUS_SIGMAS, MIN_RADIUS_PX = 5.0, 0.4  # radius of a place in sigmas of a point, and at least
MIN_SEEN = 4.0  # count from which on a place is taken for static
SURE_LOG_DENSITY = -float(np.log(np.pi * MIN_RADIUS_PX**2))  # 1/px^2, of points that are known to be static
DECAY = 0.99  # of the counts per frame while tracking: a place is forgotten some hundred frames after its point is gone
NEAR_PX = 3.0  # a point this near to an expected spot may be that spot, labelled or not


class StaticPlaces(NamedTuple):
    """Places of c cameras, up to MAX_PLACES each."""

    uv: Array  # (c, MAX_PLACES, 2) px
    seen: Array  # (c, MAX_PLACES) decaying count of unlabelled points there; 0: no place
    frames: Array  # (c,) count of frames that decays likewise


class PicturePoints(NamedTuple):
    """One frame's m detections, sorted by camera."""

    uv: Array  # (m, 2) px
    cov: Array  # (m, 2, 2) px^2
    first: Ints  # (c + 1,) where the rows of each camera begin
    has_image: Bools  # (c,)


def no_places(cameras: int) -> StaticPlaces:
    """The empty lists of so many cameras."""
    return StaticPlaces(np.zeros((cameras, MAX_PLACES, 2)), np.zeros((cameras, MAX_PLACES)), np.zeros(cameras))


@compiled
def radius2_px2(cov: Array) -> float:
    """Squared radius of a place, px^2, for a point of covariance (2, 2)."""
    return max(RADIUS_SIGMAS * RADIUS_SIGMAS * 0.5 * (cov[0, 0] + cov[1, 1]), MIN_RADIUS_PX * MIN_RADIUS_PX)


@compiled
def static_log_density(places: StaticPlaces, uv: Array, cov: Array, first: Ints) -> Array:
    """Log density of static points, 1/px^2, at each of a frame's detections (m,); -inf where no place is known.

    uv (m, 2), cov (m, 2, 2); first (c + 1,): where the rows of each camera begin.
    """
    out = np.full(uv.shape[0], -np.inf)
    for c in range(first.shape[0] - 1):
        if places.frames[c] <= 0.0:
            continue
        for d in range(first[c], first[c + 1]):
            r2 = radius2_px2(cov[d])
            count = 0.0
            for k in range(MAX_PLACES):
                a, b = places.uv[c, k, 0] - uv[d, 0], places.uv[c, k, 1] - uv[d, 1]
                if places.seen[c, k] > 0.0 and a * a + b * b < r2:
                    count += places.seen[c, k]
            if count >= MIN_SEEN:
                out[d] = np.log(min(count / places.frames[c], 1.0) / (np.pi * r2))
    return out


@compiled
def update_places(
    places: StaticPlaces, points: PicturePoints, assigned: Ints, expected: Array, camera_of: Ints, decay: float
) -> None:
    """Add one frame whose pose is known, in place.

    Points that are labelled, or lie near an expected spot, are left out. assigned (n,): row of each view's detection,
    -1 without a label; expected (n, 2), px: pixels of the spots at the frame's pose; decay: 1 or DECAY.
    """
    uv, cov, first = points.uv, points.cov, points.first
    for c in range(first.shape[0] - 1):
        if not points.has_image[c]:
            continue
        places.frames[c] = decay * places.frames[c] + 1.0
        for k in range(MAX_PLACES):
            places.seen[c, k] *= decay
        for d in range(first[c], first[c + 1]):
            is_spot = False
            for i in range(assigned.shape[0]):
                if camera_of[i] == c:
                    a, b = expected[i, 0] - uv[d, 0], expected[i, 1] - uv[d, 1]
                    is_spot |= assigned[i] == d or a * a + b * b < NEAR_PX * NEAR_PX
            if is_spot:
                continue
            r2 = radius2_px2(cov[d])
            best, nearest = -1, r2
            weakest = 0
            for k in range(MAX_PLACES):
                if places.seen[c, k] < places.seen[c, weakest]:
                    weakest = k
                a, b = places.uv[c, k, 0] - uv[d, 0], places.uv[c, k, 1] - uv[d, 1]
                if places.seen[c, k] > 0.0 and a * a + b * b < nearest:
                    best, nearest = k, a * a + b * b
            if best >= 0:
                places.seen[c, best] += 1.0
                share = 1.0 / places.seen[c, best]
                for a in range(2):
                    places.uv[c, best, a] += share * (uv[d, a] - places.uv[c, best, a])
            elif places.seen[c, weakest] < 1.5:
                places.seen[c, weakest] = 1.0
                places.uv[c, weakest, 0], places.uv[c, weakest, 1] = uv[d, 0], uv[d, 1]
