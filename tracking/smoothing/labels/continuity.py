"""Labels by continuity of the spots' paths in the pictures, where too few spots are visible to determine the pose.

If only two or three spots are visible for long, the pose becomes uncertain, and with it the predicted places of the
spots, although each spot's own path in the picture continues. Each view's labelled path is extrapolated into such
frames from both of its ends, as a tracker of single spots does, also across corners (path_corners.py). Before that,
pairs of spots are followed together (path_pairs.py). These labels do not contribute to the pose.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from geometry.arrays import Array, Bools, Ints
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.labels.path_corners import Limits, Line, after_corner
from tracking.smoothing.labels.path_pairs import Transfer, pair_labels
from tracking.smoothing.labels.path_prediction import (
    MAX_AHEAD,
    REACH,
    Prediction,
    agreed,
    error_sigmas,
    known_before,
    mean_density,
    predictions,
)
from tracking.smoothing.labels.view_path import PathContext, ViewPath
from tracking.smoothing.motion.run_detections import RunDetections

P_GONE = 0.1  # probability per frame that the spot is not visible any more
MIN_PROBABILITY = 0.99  # of a label; and where the path from the other side does not lead to the point:
MIN_ONE_SIDED_PROBABILITY = 0.995
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
                    found = (
                        (beyond[k], CORNER_PROBABILITY)
                        if k in beyond
                        else self._found(k, predicted, uv[known_before(uv, k, direction, REACH)[0]])
                    )
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

    def _found(self, k: int, predicted: list[Prediction], before: Array) -> tuple[int, float] | None:
        """Row of the point of frame k that continues a path, and its probability; None: there is none.

        before: last place (2,) of the path.
        """
        rows, place = self.points(k)
        if not len(rows):
            return None
        likelihood = mean_density(predicted, place, self.covariances(k, rows))
        false = self.false_density(k, rows, place, before)
        odds = likelihood * (1 - P_GONE) / false
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
