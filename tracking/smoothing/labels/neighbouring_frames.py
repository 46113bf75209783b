"""Labels judged by their neighbours: isolated ones, those of merged spots, and those at the ends of gaps."""

from __future__ import annotations

from itertools import permutations

import numpy as np

from geometry.arrays import Array, Bools, Ints, true_ranges
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.rigid_body.hypotheses.hypothesis_set import MIN_CONFIRMING_SPOTS, MIN_REDUNDANT_SPOTS
from tracking.smoothing.motion.run_detections import RunDetections


def connected(measured: Bools, confirmed: Bools) -> Bools:
    """(T,): measured frames that are confirmed, or that an unbroken row of measured frames connects to one."""
    out = measured & confirmed
    for order in (range(1, len(out)), range(len(out) - 2, -1, -1)):
        for k in order:
            out[k] |= measured[k] and out[k - order.step]
    return out


def merged_with_hidden(assigned: Ints, expected_px: Array, camera: Ints, reach_px: float) -> Ints:
    """Assignments (T, n), plus BLENDED where a point is the light of two spots.

    A spot that is not found beside another one, nearer than a detector separates two lights, has merged with it or is
    hidden; that one's point may be anywhere between both. expected_px (T, n, 2): pixels at the poses; camera (n,).
    """
    out = assigned.copy()
    for one, other in permutations(range(len(camera)), 2):
        if camera[one] == camera[other]:
            near = np.linalg.norm(expected_px[:, one] - expected_px[:, other], axis=-1) < reach_px
            out[near & (assigned[:, one] >= 0) & (assigned[:, one] < BLENDED) & (assigned[:, other] < 0), one] += (
                BLENDED
            )
    return out


def next_to(mask: Bools) -> Bools:
    """(T,): frames next to one of the mask."""
    out = np.zeros_like(mask)
    out[1:] |= mask[:-1]
    out[:-1] |= mask[1:]
    return out


def labelled_once(labelled: Bools, has_image: Bools) -> Bools:
    """(T, n): labels that the pictures before and after of the camera do not have. has_image (T, n): of its views."""
    out = labelled.copy()
    for view, there in enumerate(has_image.T):
        out[there, view] &= ~next_to(labelled[there, view])
    return out


def isolated(count: Ints) -> Bools:
    """(T,): frames with one or two spots next to a frame without any, that the other neighbour does not support.

    count (T,): labelled spots per frame. The other neighbour supports them unless it has none either, or many more.
    Such labels are rather false points than the last or first visible spots: all of some ten that were measured in
    recordings with blackouts were wrong.
    """
    before, after = np.concatenate([[-1], count[:-1]]), np.concatenate([count[1:], [-1]])
    supported = ((before > 0) & (before < count + 2)) | ((after > 0) & (after < count + 2))
    return (count > 0) & (count < MIN_CONFIRMING_SPOTS) & ((before == 0) | (after == 0)) & ~supported


EDGE_FRAMES = 5  # at both ends of a gap: later the spots of a vehicle that has turned away are outside the pictures
USUAL_POINTS = 0.95  # quantile, over measured frames, of the unlabelled points of a picture that count as usual
NEAR_CHI2 = 25.0  # of 2 degrees of freedom: a point nearer to the place of a spot may be that spot


def contradicted_gaps(
    detections: RunDetections, assigned: Ints, camera: Ints, expected: tuple[Array, Array], measured: Bools
) -> Bools:
    """(T,): frames of gaps in the measured ones (T,) at whose ends spots are shown elsewhere than the motion puts them.

    Then the vehicle has not moved as in the other frames, and its motion in the gap is not known. camera (n,): of each
    view. expected: pixels (T, n, 2) at the motion, nan where there are none, and their covariances (T, n, 2, 2).
    Source: ours.
    """
    out, points = np.zeros_like(measured), np.diff(detections.first, axis=1)
    labels = np.stack([(assigned[:, camera == c] >= 0).sum(axis=1) for c in range(points.shape[1])], axis=1)
    shown = [(points - labels)[measured & there, c] for c, there in enumerate(detections.has_image.T)]
    usual = [float(np.quantile(free, USUAL_POINTS)) if len(free) else 0.0 for free in shown]
    for first, end in true_ranges(~measured):
        ends = {*range(first, min(first + EDGE_FRAMES, end)), *range(max(end - EDGE_FRAMES, first), end)}
        astray = 0.0
        for k in (k for k in ends if not labels[k].any()):
            for c, most in enumerate(usual):
                rows = detections.begin[k] + np.arange(detections.first[k, c], detections.first[k, c + 1])
                uv, cov = (a[k, camera == c] for a in expected)
                d, spread = detections.uv[rows, None] - uv, cov + detections.cov[rows, None]
                near = np.einsum("pvi,pvij,pvj->pv", d, np.linalg.inv(spread), d) < NEAR_CHI2
                astray += max(float(np.count_nonzero(~near.any(axis=1))) - most, 0.0)
        out[first:end] = astray >= MIN_REDUNDANT_SPOTS
    return out
