"""The three-step matching of one camera's detections with its tracks.

Source: Huo, Yang & Yang 2015, section 4.1.2. Step 1 searches around the prediction with g3 > epsilon1, step 2 around
the last position with g3 > epsilon2 and omega1 = 0, step 3 leaves the track without a detection. The paper takes the
best detection for each track in turn; here each detection is assigned to at most one track and the sum of the gains is
maximal (scipy's linear assignment).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Ints
from tracking.curve_switching.gains import combined, picture_scale
from tracking.detections import UNMATCHED
from tracking.parameters import TrackerParameters


@dataclass(frozen=True, slots=True)
class Matches:
    """The detections matched to t tracks of one camera."""

    point: Ints  # (t,) row of the detection, or UNMATCHED
    step: Ints  # (t,) 1 or 2: the matching step that found it; 3: no detection
    gain: Array  # (t,) g3, eq. (9), of the match; nan without a match


def match(
    last: Array,
    predicted: Array,
    r1_px: Array,
    r2_px: Array,
    points: Array,
    image_size_px: Array,
    parameters: TrackerParameters,
) -> Matches:
    """Match t tracks with detections at points (m, 2), px: steps 1 to 3 of section 4.1.2.

    last, predicted (t, 2), px: the tracks' last and predicted positions; r1_px, r2_px (t,): the search radii of steps
    1 and 2. image_size_px (2,): width and height, for the paper's scale of g1.
    """
    p = parameters
    t = len(predicted)
    point, step, gain = np.full(t, UNMATCHED), np.full(t, 3), np.full(t, np.nan)
    if not t or not len(points):
        return Matches(point, step, gain)
    scale = r1_px[:, None] if p.g1_scale == "search radius" else picture_scale(image_size_px, p.p_norm)
    weights = (p.omega1, p.omega2, p.omega3)
    first = combined(last[:, None], predicted[:, None], points[None], weights, scale, p.min_vector_px, p.p_norm)
    near = np.linalg.norm(points[None] - predicted[:, None], axis=-1) <= r1_px[:, None]
    _assign(first, near & (first > p.eps1), np.arange(t), np.arange(len(points)), Matches(point, step, gain), 1)

    tracks = np.flatnonzero(point == UNMATCHED)
    free = np.setdiff1d(np.arange(len(points)), point)
    if len(tracks) and len(free):
        second = combined(
            last[tracks][:, None],
            predicted[tracks][:, None],
            points[free][None],
            (0.0, p.omega2, p.omega3),
            1.0,
            p.min_vector_px,
            p.p_norm,
        )
        near = np.linalg.norm(points[free][None] - last[tracks][:, None], axis=-1) <= r2_px[tracks][:, None]
        _assign(second, near & (second > p.eps2), tracks, free, Matches(point, step, gain), 2)
    return Matches(point, step, gain)


def _assign(g: Array, allowed: Array, tracks: Ints, points: Ints, matches: Matches, this_step: int) -> None:
    """Enter the allowed pairs with the largest total gain into `matches`; g, allowed (len(tracks), len(points))."""
    if not allowed.any():
        return
    from scipy.optimize import linear_sum_assignment  # 0.3 s to import: loaded only when this tracker runs

    # The 1 makes as many matches as possible: any allowed match is worth more than no match.
    value = np.where(allowed, 1.0 + g, 0.0)
    for i, j in zip(*linear_sum_assignment(value, maximize=True), strict=True):
        if allowed[i, j]:
            row = tracks[i]
            matches.point[row], matches.step[row], matches.gain[row] = points[j], this_step, g[i, j]
