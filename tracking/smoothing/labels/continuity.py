"""Labels by continuity of each spot's path in the picture, where too few spots are visible to determine the pose.

If only two or three spots are visible for long, the pose becomes uncertain, and with it the predicted places of the
spots, although each spot's own path in the picture continues. Each view's labelled path is extrapolated into such
frames from both of its ends, as a tracker of single spots does, also across corners (path_corners.py). These labels do
not contribute to the pose.

Source: ours; the prediction from a spot's own last places is that of Huo, Yang & Yang (2015) in its simplest form. Its
accuracy is measured on the labelled part of the same path.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.labels.path_corners import FASTER, MIN_SPEED_LIMIT_PX, Limits, Line, after_corner
from tracking.smoothing.motion.run_detections import RunDetections

POLYNOMIALS = ((1, 2), (1, 4), (2, 3), (2, 5))  # in time: degree, number of points that they are fitted to
MAX_AHEAD = 4  # frames that a path is extrapolated over
REACH = 8  # frames, within which a polynomial's points must lie
MIN_HISTORY = 12  # errors that a polynomial's scale is estimated from
# The errors' distribution is modelled as a mixture: the weight of each component, and the quantile of the measured
# errors that gives its sigma. Smooth motion makes the first component, velocity jumps the last.
COMPONENTS = ((0.6, 0.5), (0.35, 0.95), (0.05, 0.995))
REST_CHI2 = 9.0  # of the distance between two points of one spot at rest (2 degrees of freedom)
P_GONE = 0.1  # probability per frame that the spot is not visible any more
POSE_GATE_CHI2 = 25.0  # squared Mahalanobis distance from the place that the pose predicts
MIN_PROBABILITY = 0.99  # of a label; and where the path from the other side does not lead to the point:
MIN_ONE_SIDED_PROBABILITY = 0.995
MIN_LAST_PROBABILITY = 0.9999  # of the last label of a path that ends, just where a false point is not rare
CORNER_PROBABILITY = 0.998  # of the labels of a row of points that continues a path across a corner
MIN_ROW_SIGMA_PX = 0.1  # least error of the extrapolation along a row, for slight curvature
MIN_SINGLE_CHAIN = 5  # frames in a row in which a single spot is followed; shorter chains are dropped


class PathContext(NamedTuple):
    """What is known of a run besides its labels: T frames, n views."""

    camera: Ints  # (n,)
    expected: Array  # (T, n, 2) px: pixels of the spots at the smoothed poses; nan without a projection
    expected_cov: Array  # (T, n, 2, 2) px^2
    log_clutter: Array  # (T, n) log density of false points, 1/px^2
    open: Bools  # (T,) frames that may get labels


def continued(detections: RunDetections, assigned: Ints, context: PathContext) -> tuple[Ints, Array]:
    """Assignments (T, n) with the labels that continuity adds, and the probabilities (T, n) of these; nan of others."""
    out, probability = assigned.copy(), np.full(assigned.shape, np.nan)
    for view in range(assigned.shape[1]):
        path = _Path.of(detections, assigned, context, view)
        if path is None:
            continue
        ahead, back = path.chain(1), path.chain(-1)
        for k in ahead.keys() | back.keys():
            # Where both ends reach, they must agree, or one must be more certain; None: searched without success.
            sides = [side[k] for side in (ahead, back) if k in side]
            found = [s for s in sides if s is not None]
            p = max((p for _, p in found), default=0.0)
            if len({row for row, _ in found}) == 1 and (len(found) == len(sides) or p >= MIN_ONE_SIDED_PROBABILITY):
                out[k, view], probability[k, view] = found[0][0], p
    _drop_shared(out, probability, assigned)
    isolated = _isolated(out, assigned)
    out[isolated], probability[isolated] = assigned[isolated], np.nan
    return out, probability


def _isolated(out: Ints, before: Ints) -> Bools:
    """(T, n): new labels that are the only one of their frame, except in chains of MIN_SINGLE_CHAIN frames.

    If all spots are occluded for a frame or two, a false point near one of the paths is not rare.
    """
    new = out != before
    alone = new & (np.count_nonzero(out >= 0, axis=1) == 1)[:, None]
    for view in range(new.shape[1]):
        for run in np.split(np.arange(len(new)), np.flatnonzero(np.diff(new[:, view].astype(np.int8))) + 1):
            if len(run) >= MIN_SINGLE_CHAIN:
                alone[run, view] = False
    return np.asarray(alone)


def _drop_shared(out: Ints, probability: Array, before: Ints) -> None:
    """Drop new labels that would give one point to two spots, in place."""
    for k in np.flatnonzero(np.any(out != before, axis=1)):
        for i in np.flatnonzero(out[k] != before[k]):
            others = (np.arange(out.shape[1]) != i) & (out[k] >= 0)
            if np.any(out[k][others] % BLENDED == out[k, i]):
                out[k, i], probability[k, i] = before[k, i], np.nan


def _known_before(uv: Array, k: int, direction: int, reach: int) -> Ints:
    """Frames, the nearest first, in which a path uv (T, 2) is known, fewer than `reach` frames before frame k."""
    near = k - direction * np.arange(1, reach)
    near = near[(near >= 0) & (near < len(uv))]
    return np.asarray(near[np.isfinite(uv[near, 0])])


def _drop_unsure(labels: dict[int, tuple[int, float] | None], last: int) -> None:
    """Drop the last label of a path that ends, in place, unless it is very probable."""
    found = labels[last]
    if found is not None and found[1] < MIN_LAST_PROBABILITY:
        labels[last] = None


class _Prediction(NamedTuple):
    """Prediction of a spot by one polynomial."""

    at: Array  # (2,) px
    sigma: Array  # (components,) px per axis, of the errors

    def density(self, place: Array, cov: Array) -> Array:
        """Density (m,), 1/px^2, of the spot at places (m, 2) with covariances (m, 2, 2)."""
        S = cov[:, None] + self.sigma[:, None, None] ** 2 * np.eye(2)  # (m, components, 2, 2)
        e = place - self.at
        d2 = np.einsum("mi,mpij,mj->mp", e, np.linalg.inv(S), e)
        densities = np.exp(-0.5 * d2) / (2 * np.pi * np.sqrt(np.linalg.det(S)))
        return np.asarray(densities @ np.array([w for w, _ in COMPONENTS]))


class _Path:
    """Path of one view's spot in its picture."""

    def __init__(self, detections: RunDetections, assigned: Ints, context: PathContext, view: int) -> None:
        self.detections, self.assigned, self.context, self.view = detections, assigned, context, view
        self.camera = int(context.camera[view])
        k = np.flatnonzero((assigned[:, view] >= 0) & (assigned[:, view] < BLENDED))
        self.uv = np.full((len(assigned), 2), np.nan)
        self.uv[k] = detections.uv[detections.begin[k] + assigned[k, view]]
        steps = np.linalg.norm(np.diff(self.uv, axis=0), axis=1)
        self.speed_px = max(FASTER * float(np.nanmax(steps, initial=0.0)), MIN_SPEED_LIMIT_PX)
        self.sigmas = [[_error_sigmas(self.uv, *form, h) for h in range(1, MAX_AHEAD + 1)] for form in POLYNOMIALS]

    @staticmethod
    def of(detections: RunDetections, assigned: Ints, context: PathContext, view: int) -> _Path | None:
        """The path of a view; None where there is nothing to continue."""
        missing = (assigned[:, view] < 0) & context.open & detections.has_image[:, context.camera[view]]
        if not missing.any() or np.count_nonzero(assigned[:, view] >= 0) < MIN_HISTORY:
            return None
        return _Path(detections, assigned, context, view)

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
            if self.assigned[k, self.view] < 0 and self.context.open[k]:
                predicted = self._predicted(k, uv, direction)
                if predicted:
                    found = (
                        (beyond[k], CORNER_PROBABILITY)
                        if k in beyond
                        else self._found(k, predicted, uv[_known_before(uv, k, direction, REACH)[0]])
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

    def _found(self, k: int, predicted: list[_Prediction], before: Array) -> tuple[int, float] | None:
        """Row of the point of frame k that continues a path, and its probability; None: there is none.

        before: last place (2,) of the path.
        """
        detections, context, view = self.detections, self.context, self.view
        rows, place = self._points(k)
        if not len(rows):
            return None
        cov = detections.cov[detections.begin[k] + rows]
        likelihood = np.mean([p.density(place, cov) for p in predicted], axis=0)
        # A spot at rest looks like a static reflection while it has no label. One just where the spot has been is none:
        # the two would have been one point.
        away = place - before
        rests = np.einsum("mi,mij,mj->m", away, np.linalg.inv(2 * cov), away) < REST_CHI2
        static = np.where(rests, -np.inf, detections.log_static[detections.begin[k] + rows])
        false = np.exp(np.maximum(context.log_clutter[k, view], static))
        odds = likelihood * (1 - P_GONE) / false
        best = int(np.argmax(odds))
        p = float(odds[best] / (odds.sum() + P_GONE))
        if p < MIN_PROBABILITY or not self._allowed(k, int(rows[best])):
            return None
        return int(rows[best]), p

    def _points(self, k: int) -> tuple[Ints, Array]:
        """Rows (m,) and places (m, 2), px, of the points of a frame that are no labelled spots."""
        detections = self.detections
        if not 0 <= k < len(self.uv):
            return np.zeros(0, dtype=np.int64), np.zeros((0, 2))
        rows = np.arange(detections.first[k, self.camera], detections.first[k, self.camera + 1])
        rows = rows[~np.isin(rows, self.assigned[k][self.assigned[k] >= 0] % BLENDED)]
        return rows, detections.uv[detections.begin[k] + rows]

    def _allowed(self, k: int, row: int) -> bool:
        """Whether the uncertain pose allows the spot at a point. One that does not lead to the screen says nothing."""
        at = self.detections.begin[k] + row
        y = self.detections.uv[at] - self.context.expected[k, self.view]
        if not np.isfinite(y).all():
            return True
        chi2 = y @ np.linalg.solve(self.context.expected_cov[k, self.view] + self.detections.cov[at], y)
        return bool(chi2 < POSE_GATE_CHI2)

    def _beyond_corner(self, k: int, uv: Array, direction: int) -> dict[int, int]:
        """Rows of the path's points by frame from frame k on, across a corner shortly before; {}: none are sure."""
        sigma = self.sigmas[0][0]
        if sigma is None or not len(self._points(k)[0]):
            return {}
        limits = Limits(float(np.hypot(sigma[0], MIN_ROW_SIGMA_PX)), self.speed_px)
        near = _known_before(uv, k, direction, REACH)
        # The last point may lie beyond the corner itself, found by chance of its small distance.
        for last, before in pairwise(near[:3]):
            if abs(k - last) > MAX_AHEAD:
                break
            velocity = (uv[last] - uv[before]) / abs(last - before)
            found = after_corner(self._points_or_label, k, direction, Line(int(last), uv[last], velocity), limits)
            found = {frame: row for frame, row in found.items() if not np.isfinite(self.uv[frame, 0])}
            if found and all(self._allowed(frame, row) for frame, row in found.items()):
                return found
        return {}

    def _points_or_label(self, k: int) -> tuple[Ints, Array]:
        """Rows and places of the points of a frame that may be the spot: its label alone where it has one."""
        if not 0 <= k < len(self.uv) or (np.isnan(self.uv[k, 0]) and not self.context.open[k]):
            return np.zeros(0, dtype=np.int64), np.zeros((0, 2))
        if np.isfinite(self.uv[k, 0]):
            return self.assigned[k, [self.view]], self.uv[[k]]
        return self._points(k)

    def _predicted(self, k: int, uv: Array, direction: int) -> list[_Prediction]:
        """Predictions for frame k: short polynomials suit the time after a velocity jump, long ones a smooth path."""
        near = _known_before(uv, k, direction, REACH + MAX_AHEAD)
        if not len(near) or abs(k - near[0]) > MAX_AHEAD:
            return []
        ahead = int(abs(k - near[0]))
        out = []
        for (degree, points), sigmas in zip(POLYNOMIALS, self.sigmas, strict=True):
            sigma = sigmas[ahead - 1]
            if sigma is None or len(near) < points or abs(near[points - 1] - near[0]) >= REACH:
                continue
            weights = _weights(tuple(np.abs(k - near[:points]).tolist()), degree)
            consecutive = _weights(tuple(range(ahead, ahead + points)), degree)
            # The sigmas hold for consecutive points; points farther apart have larger weights, and so larger errors.
            wider = max(float(np.linalg.norm(weights) / np.linalg.norm(consecutive)), 1.0)
            out.append(_Prediction(weights @ uv[near[:points]], sigma * wider))
        return out


@cache
def _weights(ago: tuple[int, ...], degree: int) -> Array:
    """Weights (m,) of points so many frames ago for the present value of a polynomial fitted to them."""
    at = -np.array(ago, dtype=float)
    return np.asarray(np.linalg.pinv(np.vander(at, degree + 1, increasing=True))[0])


def _error_sigmas(uv: Array, degree: int, points: int, ahead: int) -> Array | None:
    """Sigmas (components,) per axis, px, of predictions so many frames ahead along a labelled path uv (T, 2).

    None if there are too few labels.
    """
    weights = _weights(tuple(range(ahead, ahead + points)), degree)
    n = len(uv) - ahead - points + 1
    if n < MIN_HISTORY:
        return None
    predicted = sum(w * uv[points - 1 - j : points - 1 - j + n] for j, w in enumerate(weights))
    squared = np.sum((uv[points - 1 + ahead :][:n] - predicted) ** 2, axis=1)
    squared = squared[np.isfinite(squared)]
    if len(squared) < MIN_HISTORY:
        return None
    # The squared distance of a two-dimensional Gaussian is exponentially distributed; the tail's sigma is its quantile.
    core = [np.quantile(squared, q) / (-2 * np.log(1 - q)) for _, q in COMPONENTS[:-1]]
    return np.asarray(np.sqrt([*core, np.quantile(squared, COMPONENTS[-1][1]) / 2]))
