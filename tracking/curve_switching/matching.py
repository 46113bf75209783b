"""The gains g1, g2, g3, and the three-step matching of one camera's detections with its tracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Ints
from tracking.detections import UNMATCHED
from tracking.parameters import TrackerParameters

# The gains g1, g2, g3: scores of how well a detection continues a track.
#
# Source: Huo, Yang & Yang 2015, eqs. (7), (8), (9); g2 after Sethi & Jain 1987. Two changes make them well defined:
# vector lengths have a floor, because (8) and (9) are 0/0 at zero displacement, and g1 may be divided by the search
# radius, because divided by the image diagonal it changes by only 0.006 per 10 px and does not affect the result.


def nearness(predicted: Array, candidates: Array, scale_px: Array | float, p_norm: float = 2.0) -> Array:
    """g1, eq. (7): 1 - |candidate - predicted|_p / scale, (...); 1 at the prediction. Points (..., 2), px.

    scale_px: the denominator, the image diagonal (`picture_scale`, the paper) or the search radius r1 (ours).
    """
    gap = np.sum(np.abs(candidates - predicted) ** p_norm, axis=-1) ** (1 / p_norm)
    return 1 - gap / np.asarray(scale_px)


def picture_scale(image_size_px: Array, p_norm: float = 2.0) -> Array:
    """The denominator of eq. (7): the p-norm of the image size (Sx, Sy), px, (...).

    The paper prints sqrt(Sx^p + Sy^p), which is the p-norm for p = 2 only.
    """
    return np.asarray(np.sum(np.abs(image_size_px) ** p_norm, axis=-1) ** (1 / p_norm))


def direction_and_speed(last: Array, predicted: Array, candidates: Array, min_vector_px: float) -> tuple[Array, Array]:
    """The two terms of eq. (8), each (...) in [0, 1]: similarity of direction and similarity of speed.

    The direction term is 1/2 + cos/2 of the angle between the predicted and the observed displacement; the speed term
    is the ratio of the geometric to the arithmetic mean of their lengths. Points (..., 2), px. Displacements shorter
    than `min_vector_px` (ours) have no direction: two such displacements have a direction term of 1.
    """
    expected, observed = predicted - last, candidates - last
    length_e = np.linalg.norm(expected, axis=-1)
    length_o = np.linalg.norm(observed, axis=-1)
    floored_e, floored_o = np.maximum(length_e, min_vector_px), np.maximum(length_o, min_vector_px)
    # A vector shorter than the floor counts as partly parallel to the other one: the cosine tends to 1, not to 0.
    cosine = np.sum(expected * observed, axis=-1) / (floored_e * floored_o)
    cosine = cosine + (1 - length_e / floored_e) + (1 - length_o / floored_o)
    direction = 0.5 + 0.5 * np.clip(cosine, -1.0, 1.0)
    speed = 2 * np.sqrt(floored_e * floored_o) / (floored_e + floored_o)
    return direction, speed


def combined(
    last: Array,
    predicted: Array,
    candidates: Array,
    weights: tuple[float, float, float],
    scale_px: Array | float,
    min_vector_px: float,
    p_norm: float = 2.0,
) -> Array:
    """g3, eq. (9), (...): the weighted sum of g1 and the two terms of eq. (8).

    last, predicted, candidates (..., 2), px: the spot's last position, its predicted position and the detections.
    weights: omega1, omega2, omega3. They are divided by their sum (ours): matching step 2 sets omega1 to 0, and the
    paper's weights then no longer add up to 1.
    """
    w1, w2, w3 = np.asarray(weights, dtype=float) / sum(weights)
    direction, speed = direction_and_speed(last, predicted, candidates, min_vector_px)
    g = w2 * direction + w3 * speed
    if w1:
        g = g + w1 * nearness(predicted, candidates, scale_px, p_norm)
    return g


# The three-step matching of one camera's detections with its tracks.
#
# Source: Huo, Yang & Yang 2015, section 4.1.2. Step 1 searches around the prediction with g3 > epsilon1, step 2 around
# the last position with g3 > epsilon2 and omega1 = 0, step 3 leaves the track without a detection. The paper takes the
# best detection for each track in turn; here each detection is assigned to at most one track and the sum of the gains
# is maximal (scipy's linear assignment).


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
