"""The three-step matching of one camera's detections with its tracks.

Source: Huo, Yang & Yang 2015, section 4.1.2. Where the paper takes the best detection for each track in turn, here a
detection serves one track and the sum of the gains is largest (scipy's assignment).
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
    """For t tracks of one camera: which detection each took."""

    point: Ints  # (t,) row of the detection, or UNMATCHED
    step: Ints  # (t,) 1 or 2: the step that found it; 3: none did
    gain: Array  # (t,) g3 of the match; nan without


def match(
    last: Array,
    predicted: Array,
    r1_px: Array,
    r2_px: Array,
    points: Array,
    image_size_px: Array,
    parameters: TrackerParameters,
) -> Matches:
    """Match tracks (t) with points (m, 2), px.

    last, predicted (t, 2), px: the tracks' last and predicted positions; r1_px, r2_px (t,): their search radii.
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
    _take(first, near & (first > p.eps1), np.arange(t), np.arange(len(points)), 1, point, step, gain)

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
        _take(second, near & (second > p.eps2), tracks, free, 2, point, step, gain)
    return Matches(point, step, gain)


def _take(
    g: Array, allowed: Array, tracks: Ints, points: Ints, this_step: int, point: Ints, step: Ints, gain: Array
) -> None:
    """Assign the allowed pairs of largest total gain, and note them."""
    if not allowed.any():
        return
    from scipy.optimize import linear_sum_assignment  # 0.3 s to import: only where the paper's tracker runs

    # A match, however poor, is worth more than none: 1 on top of the gain.
    value = np.where(allowed, 1.0 + g, 0.0)
    for i, j in zip(*linear_sum_assignment(value, maximize=True), strict=True):
        if allowed[i, j]:
            point[tracks[i]], step[tracks[i]], gain[tracks[i]] = points[j], this_step, g[i, j]
