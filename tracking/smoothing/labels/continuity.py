"""Labels by continuity of the spots' paths in the pictures: of each path by itself, and of two paths together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.camera import Camera
from geometry.planes import intersect_surface
from geometry.rig import Rig
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.labels.view_path import (
    MAX_AHEAD,
    REACH,
    Limits,
    Line,
    PathContext,
    Prediction,
    ViewPath,
    after_corner,
    agreed,
    error_sigmas,
    known_before,
    mean_density,
    predictions,
)
from tracking.smoothing.motion.run_detections import RunDetections

# Labels by continuity of the spots' paths in the pictures, where too few spots are visible to determine the pose.
#
# If only two or three spots are visible for long, the pose becomes uncertain, and with it the predicted places of the
# spots, although each spot's own path in the picture continues. Each view's labelled path is extrapolated into such
# frames from both of its ends, as a tracker of single spots does, also across corners (view_path.py). Before that,
# pairs of spots are followed together (below). These labels do not contribute to the pose.
#
# Source: ours.

P_GONE = 0.1  # probability per frame that a spot (of a pair: one of the two, or both) is not visible any more
MIN_PROBABILITY = 0.99  # of a label; and where the path from the other side does not lead to the point:
MIN_ONE_SIDED_PROBABILITY = 0.995  # (from one side alone)
MIN_LAST_PROBABILITY = 0.9999  # of the last label of a path that ends, just where a false point is not rare
CORNER_PROBABILITY = 0.998  # of the labels of a row of points that continues a path across a corner
MIN_ROW_SIGMA_PX = 0.1  # least error of the extrapolation along a row, for slight curvature
# Frames in a row in which a single spot, or two alone, are followed; shorter chains are dropped.
MIN_SINGLE_CHAIN, MIN_PAIR_CHAIN = 5, 3


def continued(
    detections: RunDetections, assigned: Ints, context: PathContext, transfers: Mapping[tuple[int, int], Transfer]
) -> tuple[Ints, Array]:
    """Assignments (T, n) with the labels that continuity adds, and the probabilities (T, n) of these; nan of others.

    transfers: as of `pair_labels`.
    """
    paired, probability = pair_labels(detections, assigned, context, transfers)
    _drop(_isolated(paired, assigned, 2, MIN_PAIR_CHAIN), paired, probability, assigned)
    out = paired.copy()
    for view in range(assigned.shape[1]):
        path = _Path(detections, paired, context, view)
        if not path.continuable:
            continue
        ahead, back = path.chain(1), path.chain(-1)
        for k in ahead.keys() | back.keys():
            found = agreed([side[k] for side in (ahead, back) if k in side], MIN_ONE_SIDED_PROBABILITY)
            if found is not None:
                out[k, view], probability[k, view] = found
    _drop_shared(out, probability, assigned)
    _drop(_isolated(out, assigned, 1, MIN_SINGLE_CHAIN), out, probability, assigned)
    return out, probability


def _drop(mask: Bools, out: Ints, probability: Array, before: Ints) -> None:
    """Take new labels back, in place; mask (T, n)."""
    out[mask], probability[mask] = before[mask], np.nan


def _isolated(out: Ints, before: Ints, most: int, least_frames: int) -> Bools:
    """(T, n): new labels that are the only `most` ones of their frame or fewer, except in chains of enough frames.

    If all spots are occluded for a frame or two, a false point near one of the paths is not rare, nor are two that lie
    right for a pair.
    """
    new = out != before
    alone = new & (np.count_nonzero(out >= 0, axis=1) <= most)[:, None]
    for view in range(new.shape[1]):
        for run in np.split(np.arange(len(new)), np.flatnonzero(np.diff(new[:, view].astype(np.int8))) + 1):
            if len(run) >= least_frames:
                alone[run, view] = False
    return np.asarray(alone)


def _drop_shared(out: Ints, probability: Array, before: Ints) -> None:
    """Drop new labels that would give one point to two spots, in place."""
    for k in np.flatnonzero(np.any(out != before, axis=1)):
        for i in np.flatnonzero(out[k] != before[k]):
            others = (np.arange(out.shape[1]) != i) & (out[k] >= 0)
            if np.any(out[k][others] % BLENDED == out[k, i]):
                out[k, i], probability[k, i] = before[k, i], np.nan


def _drop_unsure(labels: dict[int, tuple[int, float] | None], last: int) -> None:
    """Drop the last label of a path that ends, in place, unless it is very probable."""
    found = labels[last]
    if found is not None and found[1] < MIN_LAST_PROBABILITY:
        labels[last] = None


class _Path(ViewPath):
    """A path that is extrapolated by itself."""

    def __init__(self, detections: RunDetections, assigned: Ints, context: PathContext, view: int) -> None:
        super().__init__(detections, assigned, context, view)
        self.sigmas = error_sigmas(self.uv) if self.continuable else []

    def chain(self, direction: int) -> dict[int, tuple[int, float] | None]:
        """Row and probability of new labels by frame, along the direction of time (1) or against it (-1).

        None where the path leads through a frame but no point lies on it. The last label of a path that ends is
        dropped unless it is very probable: a point found just where a spot vanished may be false.
        """
        out: dict[int, tuple[int, float] | None] = {}
        uv, latest = self.uv.copy(), -1
        beyond: dict[int, int] = {}  # rows of points after a corner
        frames = range(len(uv)) if direction == 1 else range(len(uv) - 1, -1, -1)
        for k in frames:
            if np.isfinite(self.uv[k, 0]):
                latest = -1  # the chain has reached a label, which confirms it
                continue
            if self.open[k]:
                predicted = predictions(uv, self.sigmas, k, direction)
                if predicted:
                    found = (beyond[k], CORNER_PROBABILITY) if k in beyond else self._found(k, predicted)
                    if found is None and (beyond := self._beyond_corner(k, uv, direction)):
                        found = beyond[k], CORNER_PROBABILITY
                    out[k] = found
                    if found is not None:
                        uv[k] = self.detections.uv[self.detections.begin[k] + found[0]]
                        latest = k
                        continue
            if latest >= 0 and abs(k - latest) >= MAX_AHEAD:
                _drop_unsure(out, latest)
                latest = -1
        if latest >= 0:
            _drop_unsure(out, latest)
        return out

    def _found(self, k: int, predicted: list[Prediction]) -> tuple[int, float] | None:
        """Row of the point of frame k that continues a path, and its probability; None: there is none."""
        rows, place = self.points(k)
        if not len(rows):
            return None
        likelihood = mean_density(predicted, place, self.covariances(k, rows))
        odds = likelihood * (1 - P_GONE) / self.false_density(k, rows)
        best = int(np.argmax(odds))
        p = float(odds[best] / (odds.sum() + P_GONE))
        if p < MIN_PROBABILITY or not self.allowed(k, int(rows[best])):
            return None
        return int(rows[best]), p

    def _beyond_corner(self, k: int, uv: Array, direction: int) -> dict[int, int]:
        """Rows of the path's points by frame from frame k on, across a corner shortly before; {}: none are sure."""
        sigma = self.sigmas[0][0]
        if sigma is None or not len(self.points(k)[0]):
            return {}
        limits = Limits(float(np.hypot(sigma[0], MIN_ROW_SIGMA_PX)), self.speed_px)
        near = known_before(uv, k, direction, REACH)
        # The last point may lie beyond the corner itself, found by chance of its small distance.
        for last, before in pairwise(near[:3]):
            if abs(k - last) > MAX_AHEAD:
                break
            velocity = (uv[last] - uv[before]) / abs(last - before)
            found = after_corner(self._points_or_label, k, direction, Line(int(last), uv[last], velocity), limits)
            found = {frame: row for frame, row in found.items() if not np.isfinite(self.uv[frame, 0])}
            if found and all(self.allowed(frame, row) for frame, row in found.items()):
                return found
        return {}

    def _points_or_label(self, k: int) -> tuple[Ints, Array]:
        """Rows and places of the points of a frame that may be the spot: its label alone where it has one."""
        if not 0 <= k < len(self.uv) or (np.isnan(self.uv[k, 0]) and not self.open[k]):
            return np.zeros(0, dtype=np.int64), np.zeros((0, 2))
        if np.isfinite(self.uv[k, 0]):
            return self.assigned[k, [self.view]], self.uv[[k]]
        return self.points(k)


# Labels by continuity of two spots' paths together: where they lie relative to each other changes slowly.
#
# A jerking vehicle moves its spots by many pixels from one frame to the next, and no path can be extrapolated well by
# itself. But two spots in one picture move nearly alike, and two cameras that see one spot see the same place of the
# screen. A pair of points that lies right relative to each other is then the two spots, although the pair as a whole is
# predicted badly; false points seldom form such a pair. Source: ours.

P_JUMP = 0.02  # probability per frame that a spot has moved by any distance that its speed allows
PAIR_MIN_PROBABILITY = 0.999  # of the two labels; and where the pair's path from the other side does not lead there:
PAIR_MIN_ONE_SIDED_PROBABILITY = 0.9999  # (from one side alone)


Transfer = Callable[[Array], Array]
"""Where the second view sees points (m, 2), px, of the first view: (m, 2), px; nan where it cannot see them."""


def transfers_between_cameras(rig: Rig, views: Sequence[tuple[str, str]]) -> dict[tuple[int, int], Transfer]:
    """The transfers between the cameras that see one spot, by pairs of views; views: camera and spot of each."""
    return {
        (a, b): partial(_over_screen, rig, rig.cameras[views[a][0]], rig.cameras[views[b][0]])
        for a, b in combinations(range(len(views)), 2)
        if views[a][1] == views[b][1]
    }


def _over_screen(rig: Rig, camera: Camera, other: Camera, uv: Array) -> Array:
    """Pixels (m, 2) of one camera, seen by another one as the places of the screen that they show."""
    out, known = np.full(uv.shape, np.nan), np.isfinite(uv).all(axis=1)
    if known.any():
        screen = rig.screens[camera.screen]
        out[known] = other.project(intersect_surface(*camera.rays(uv[known]), screen.world_from_screen, screen.bow))
    return out


class PairLabels(NamedTuple):
    """Rows of both views' points in one frame."""

    rows: tuple[int, int]
    probability: float


Chain = dict[int, PairLabels | None]
"""New labels by frame; None where the pair's path leads through a frame but no points lie on it."""


def pair_labels(
    detections: RunDetections, assigned: Ints, context: PathContext, transfers: Mapping[tuple[int, int], Transfer]
) -> tuple[Ints, Array]:
    """Assignments (T, n) with the labels that pairs add, and the probabilities (T, n) of these; nan of others.

    transfers: by pairs of views that see one spot.
    """
    out, probability = assigned.copy(), np.full(assigned.shape, np.nan)
    for a, b in _nearest_first(detections, assigned, context, transfers):
        first, second = (ViewPath(detections, out, context, view) for view in (a, b))
        if not np.any(first.open & second.open):
            continue  # another pair has labelled one of them
        pair = _Pair(first, second, transfers.get((a, b), _same))
        ahead, back = pair.chain(1), pair.chain(-1)
        for k in ahead.keys() | back.keys():
            found = agreed([side[k] for side in (ahead, back) if k in side], PAIR_MIN_ONE_SIDED_PROBABILITY)
            if found is not None:
                out[k, [a, b]], probability[k, [a, b]] = found
    return out, probability


def _nearest_first(
    detections: RunDetections, assigned: Ints, context: PathContext, transfers: Mapping[tuple[int, int], Transfer]
) -> list[tuple[int, int]]:
    """Pairs of views with unlabelled frames: those of one spot, then those of one picture, the nearest spots first."""
    paths = [ViewPath(detections, assigned, context, view) for view in range(assigned.shape[1])]
    paths = [path for path in paths if path.continuable]
    apart: dict[tuple[int, int], float] = {}
    for one, other in combinations(paths, 2):
        together = (one.view, other.view)
        if together in transfers:
            apart[together] = 0.0
        elif one.camera == other.camera:
            distance = np.linalg.norm(one.uv - other.uv, axis=1)
            apart[together] = float(np.nanmedian(distance)) if np.isfinite(distance).any() else np.inf
    return sorted(apart, key=lambda pair: apart[pair])


def _same(uv: Array) -> Array:
    return uv


def _drop_unsure_pairs(labels: Chain, loose: list[int]) -> None:
    """Drop, in place, what the end of a path may have labelled by chance: a single frame, or an unsure last one."""
    if loose:
        last = labels[loose[-1]]
        if len(loose) == 1 or (last is not None and last.probability < MIN_LAST_PROBABILITY):
            labels[loose[-1]] = None


class _Pair:
    """The path of the first view's spot, and where the second one lies relative to it."""

    def __init__(self, first: ViewPath, second: ViewPath, transfer: Transfer) -> None:
        self.first, self.second, self.transfer = first, second, transfer
        self.open = first.open & second.open
        self.relative = second.uv - transfer(first.uv)  # (T, 2) px
        self.sigmas, self.second_sigmas = error_sigmas(first.uv), error_sigmas(second.uv)
        self.relative_sigmas = error_sigmas(self.relative)

    def chain(self, direction: int) -> Chain:
        """New labels along the direction of time (1) or against it (-1)."""
        out: Chain = {}
        uv, second_uv, relative = self.first.uv.copy(), self.second.uv.copy(), self.relative.copy()
        loose: list[int] = []  # frames labelled since the last known place of the pair
        frames = range(len(uv)) if direction == 1 else range(len(uv) - 1, -1, -1)
        for k in frames:
            if np.isfinite(self.relative[k, 0]):
                loose = []  # the path has come to known labels, which confirm it
            if not self.open[k]:
                continue
            found = self._found(k, uv, second_uv, relative, direction)
            if found is not None:
                uv[k], second_uv[k] = self._places(k, found.rows)
                relative[k] = second_uv[k] - self.transfer(uv[[k]])[0]
                loose.append(k)
            if found is not None or len(known_before(relative, k, direction, MAX_AHEAD + 1)):
                out[k] = found
            elif loose:
                _drop_unsure_pairs(out, loose)
                loose = []
        _drop_unsure_pairs(out, loose)
        return out

    def _places(self, k: int, rows: tuple[int, int]) -> tuple[Array, Array]:
        begin, uv = self.first.detections.begin[k], self.first.detections.uv
        return uv[begin + rows[0]], uv[begin + rows[1]]

    def _found(self, k: int, uv: Array, second_uv: Array, relative: Array, direction: int) -> PairLabels | None:
        """The two points of frame k that continue the pair; None: there are none.

        uv, second_uv, relative (T, 2), px: the paths so far.
        """
        (rows, place), (other_rows, other) = self.first.points(k), self.second.points(k)
        of_first = predictions(uv, self.sigmas, k, direction)
        of_second = predictions(second_uv, self.second_sigmas, k, direction)
        of_relative = predictions(relative, self.relative_sigmas, k, direction)
        if not (len(rows) and len(other_rows) and of_first and of_second and of_relative):
            return None
        last = int(known_before(relative, k, direction, len(uv))[0])
        cov, other_cov = self.first.covariances(k, rows), self.second.covariances(k, other_rows)
        apart = other - self.transfer(place)[:, None]  # (m, l, 2)
        right = np.nan_to_num(mean_density(of_relative, apart, cov[:, None] + other_cov))
        if self.first.camera == self.second.camera:
            right[rows[:, None] == other_rows] = 0.0  # one point is not two spots
        false, other_false = self.first.false_density(k, rows), self.second.false_density(k, other_rows)
        here = _anywhere(of_first, place, cov, uv[last], self.first.speed_px * abs(k - last))
        there = _anywhere(of_second, other, other_cov, second_uv[last], self.second.speed_px * abs(k - last))
        both = here[:, None] * right / (false[:, None] * other_false) * (1 - P_GONE) ** 2
        only_one = ((here / false).sum() + (there / other_false).sum()) * P_GONE * (1 - P_GONE)
        i, j = np.unravel_index(int(np.argmax(both)), both.shape)
        p = float(both[i, j] / (both.sum() + only_one + P_GONE))
        chosen = int(rows[i]), int(other_rows[j])
        if p < PAIR_MIN_PROBABILITY or not self.first.allowed(k, chosen[0]) or not self.second.allowed(k, chosen[1]):
            return None
        return PairLabels(chosen, p)


def _anywhere(of: list[Prediction], place: Array, cov: Array, last: Array, reach_px: float) -> Array:
    """Density (m,), 1/px^2, of a spot at places (m, 2) that has moved as predicted or, rarely, by any distance."""
    jump = np.exp(-0.5 * np.sum((place - last) ** 2, axis=1) / reach_px**2) / (2 * np.pi * reach_px**2)
    return (1 - P_JUMP) * mean_density(of, place, cov) + P_JUMP * jump
