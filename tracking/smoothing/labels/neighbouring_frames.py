"""Labels judged by their neighbours: isolated ones, those of merged spots, and those of a camera that was knocked."""

from __future__ import annotations

from itertools import pairwise, permutations
from typing import NamedTuple

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


# Labels of a camera whose spots are all displaced by the same shift from where the other cameras put them.
#
# A camera that was knocked during the recording shows its spots a pixel or more beside the expected places. Each of
# them alone is far outside its gate and could be a false point, but false points do not form the same figure, frame
# after frame. These labels do not contribute to the pose. Source: ours.

MAX_SHIFT_PX = 20.0  # of the figure; a camera that has turned farther needs a new calibration to be recognised
# Difference between the shifts of two spots, and of two frames: a turn about the optical axis and distortion.
TOLERANCE_PX, TOLERANCE_SHARE = 0.3, 0.1
MIN_FRAMES = 5  # in a row
# A single point beside the place of a spot may be another light. One that keeps its shift while the spot moves is not.
MIN_SINGLE_FRAMES, MAX_SINGLE_SHIFT_PX, MIN_SINGLE_PATH_PX = 10, 5.0, 10.0


def displaced(detections: RunDetections, assigned: Ints, camera: Ints, expected_px: Array, visible: Bools) -> Ints:
    """Assignments (T, n) with the labels of displaced cameras, plus BLENDED.

    camera (n,): of each view. expected_px (T, n, 2): pixels at poses that other cameras measure. visible (T, n):
    whether the spot should be in the picture.
    """
    out = assigned.copy()
    for c in np.unique(camera):
        own = np.flatnonzero(camera == c)
        found: dict[int, _Figure] = {}
        free = visible[:, own].any(axis=1) & (assigned[:, own] < 0).all(axis=1) & detections.has_image[:, c]
        for k in np.flatnonzero(free).tolist():
            views = own[visible[k, own]]
            begin, rows = detections.begin[k], np.arange(detections.first[k, c], detections.first[k, c + 1])
            figure = _figure(detections.uv[begin + rows], expected_px[k, views])
            if figure is not None:
                found[k] = _Figure(views, rows[figure[0]], figure[1], expected_px[k, views[0]])
        for frames in _rows_of_frames(found):
            for k in frames:
                out[k, found[k].views] = found[k].rows + BLENDED
    return out


class _Figure(NamedTuple):
    """Points of one frame in one camera that form the figure of the expected places."""

    views: Ints  # (v,)
    rows: Ints  # (v,) of the points
    shift: Array  # (2,) px
    place: Array  # (2,) px, expected, of the first view


def _tolerance(shift: Array) -> float:
    return TOLERANCE_PX + TOLERANCE_SHARE * float(np.linalg.norm(shift))


def _figure(points: Array, expected: Array) -> tuple[Ints, Array] | None:
    """The points (v,) that form the figure of the v expected places, and its shift (2,), px; None without a clear one.

    points (m, 2) and expected (v, 2), px.
    """
    if len(points) < len(expected):
        return None
    fits: list[tuple[Ints, Array]] = []
    for shift in points - expected[0]:
        if np.linalg.norm(shift) > MAX_SHIFT_PX:
            continue
        off = np.linalg.norm(points - (expected + shift)[:, None], axis=-1)
        nearest = off.argmin(axis=1)
        if off.min(axis=1).max() < _tolerance(shift) and len(np.unique(nearest)) == len(nearest):
            fits.append((nearest, np.asarray((points[nearest] - expected).mean(axis=0))))
    return fits[0] if len(fits) == 1 else None


def _rows_of_frames(found: dict[int, _Figure]) -> list[list[int]]:
    """Consecutive frames with about the same shift, if there are enough in a row."""
    frames = sorted(found)
    rows = [frames[:1]]
    for before, k in pairwise(frames):
        step = found[k].shift - found[before].shift
        if k == before + 1 and np.linalg.norm(step) < _tolerance(found[k].shift):
            rows[-1].append(k)
        else:
            rows.append([k])
    return [r for r in rows if _is_clear([found[k] for k in r])]


def _is_clear(row: list[_Figure]) -> bool:
    """Whether the figures of consecutive frames are those of a displaced camera."""
    if len(row) < MIN_FRAMES:
        return False
    if max(len(f.views) for f in row) > 1:
        return True
    path = np.ptp([f.place for f in row], axis=0).max()
    near = max(float(np.linalg.norm(f.shift)) for f in row) < MAX_SINGLE_SHIFT_PX
    return bool(near and len(row) >= MIN_SINGLE_FRAMES and path > MIN_SINGLE_PATH_PX)
