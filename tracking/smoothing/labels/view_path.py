"""The labelled path of a view's spot in its picture: its prediction, also across corners, and points to continue it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple, TypeVar

import numpy as np

from geometry.arrays import Array, Bools, Ints
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.motion.run_detections import RunDetections

# Prediction of a path from its own last points: polynomials in time, with their errors measured on the known part.
#
# Source: ours; the prediction from a spot's own last places is that of Huo, Yang & Yang (2015) in its simplest form.

POLYNOMIALS = ((1, 2), (1, 4), (2, 3), (2, 5))  # in time: degree, number of points that they are fitted to
MAX_AHEAD = 4  # frames that a path is extrapolated over
REACH = 8  # frames, within which a polynomial's points must lie
MIN_HISTORY = 12  # errors that a polynomial's scale is estimated from
# The errors' distribution is modelled as a mixture: the weight of each component, and the quantile of the measured
# errors that gives its sigma. Smooth motion makes the first component, velocity jumps the last.
COMPONENTS = ((0.6, 0.5), (0.35, 0.95), (0.05, 0.995))

ErrorSigmas = list[list[Array | None]]
"""By polynomial and number of frames ahead: sigmas (components,) px per axis; None if there are too few errors."""


Row = TypeVar("Row")  # of a point of a frame, or those of several points


class Prediction(NamedTuple):
    """Prediction of a path by one polynomial."""

    at: Array  # (2,) px
    sigma: Array  # (components,) px per axis, of the errors

    def density(self, place: Array, cov: Array) -> Array:
        """Density (...), 1/px^2, of the path at places (..., 2) with covariances (..., 2, 2)."""
        S = cov[..., None, :, :] + self.sigma[:, None, None] ** 2 * np.eye(2)  # (..., components, 2, 2)
        e = place - self.at
        d2 = np.einsum("...i,...pij,...j->...p", e, np.linalg.inv(S), e)
        densities = np.exp(-0.5 * d2) / (2 * np.pi * np.sqrt(np.linalg.det(S)))
        return np.asarray(densities @ np.array([w for w, _ in COMPONENTS]))


def error_sigmas(uv: Array) -> ErrorSigmas:
    """The errors of all predictions along the known part of a path uv (T, 2), px; nan where unknown."""
    return [[_error_sigmas(uv, *form, ahead) for ahead in range(1, MAX_AHEAD + 1)] for form in POLYNOMIALS]


def known_before(uv: Array, k: int, direction: int, reach: int) -> Ints:
    """Frames, the nearest first, in which a path uv (T, 2) is known, fewer than `reach` frames before frame k."""
    near = k - direction * np.arange(1, reach)
    near = near[(near >= 0) & (near < len(uv))]
    return np.asarray(near[np.isfinite(uv[near, 0])])


def predictions(uv: Array, sigmas: ErrorSigmas, k: int, direction: int) -> list[Prediction]:
    """Predictions for frame k: short polynomials suit the time after a velocity jump, long ones a smooth path.

    uv (T, 2), px: the path, nan where unknown. direction: of time, 1 or -1.
    """
    near = known_before(uv, k, direction, REACH + MAX_AHEAD)
    if not len(near) or abs(k - near[0]) > MAX_AHEAD:
        return []
    ahead = int(abs(k - near[0]))
    out = []
    for (degree, points), by_distance in zip(POLYNOMIALS, sigmas, strict=True):
        sigma = by_distance[ahead - 1]
        if sigma is None or len(near) < points or abs(near[points - 1] - near[0]) >= REACH:
            continue
        weights = _weights(tuple(np.abs(k - near[:points]).tolist()), degree)
        consecutive = _weights(tuple(range(ahead, ahead + points)), degree)
        # The sigmas hold for consecutive points; points farther apart have larger weights, and so larger errors.
        wider = max(float(np.linalg.norm(weights) / np.linalg.norm(consecutive)), 1.0)
        out.append(Prediction(weights @ uv[near[:points]], sigma * wider))
    return out


def mean_density(of: list[Prediction], place: Array, cov: Array) -> Array:
    """Density (...), 1/px^2, of a path by all its predictions; arguments as of `Prediction.density`."""
    return np.asarray(np.mean([p.density(place, cov) for p in of], axis=0))


def agreed(sides: list[tuple[Row, float] | None], least: float) -> tuple[Row, float] | None:
    """The answer of a path from both of its ends, with the larger of the two probabilities; None: there is none.

    sides: points and their probability from each end that reaches a frame; None: searched without success. Where both
    ends reach, they must agree, or the probability of the one that found points must be at least `least`.
    """
    found = [s for s in sides if s is not None]
    if len({row for row, _ in found}) != 1:
        return None
    p = max(p for _, p in found)
    return (found[0][0], p) if len(found) == len(sides) or p >= least else None


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
    shares = np.array([share for _, share in COMPONENTS])
    per_axis = np.append(-2 * np.log(1 - shares[:-1]), 2.0)
    return np.asarray(np.sqrt(np.quantile(squared, shares) / per_axis))


# Continuation of a spot's path across a corner: a straight row of points that meets the path.
#
# At a velocity jump the spot leaves its extrapolated path by many times its error, and a single point near by may be
# false. But the spot continues straight, so the points of the next frames form a row, and the lines before and after
# the corner meet at one moment between the frames. False points do neither. Source: ours.

ROW_FRAMES = 6  # in which a row is looked for
MIN_ROW = 4  # points of a row
SIGMAS = 4.0  # of a point from the extrapolation of its row
MEETING_SIGMAS = 5.0  # of the two lines at the corner, extrapolated there from two points each
MAX_SIGMA_PX = 2.0  # of the extrapolation; a path that is less straight says too little about where a row may begin
MIN_MOTION_PX = 1.0  # from the first to the last point of a row: a reflection makes a row, too, but one that rests
FASTER = 2.0  # a spot moves at most so many times as fast as ever on its labelled path
MIN_SPEED_LIMIT_PX = 10.0  # per frame, at the least


class Line(NamedTuple):
    """A straight path before a corner."""

    frame: int  # of its last point
    uv: Array  # (2,) px, that point
    velocity: Array  # (2,) px per frame of the direction in which the path is continued


class Limits(NamedTuple):
    """Of the rows of one spot."""

    sigma_px: float  # error of the extrapolation from two points by one frame
    speed_px: float  # largest speed, px per frame


PointsOf = Callable[[int], tuple[Ints, Array]]
"""Rows (m,) and places (m, 2), px, of the points of a frame that may belong to the spot."""


def after_corner(points_of: PointsOf, k: int, direction: int, line: Line, limits: Limits) -> dict[int, int]:
    """Row of the spot's point by frame, from frame k on, after a corner since the line's last point; {}: none is sure.

    direction: of time, 1 or -1. points_of gives none outside the recording. A second row that fits makes it unsure.
    """
    if limits.sigma_px > MAX_SIGMA_PX:
        return {}
    fitting = [row for row in _rows(points_of, k, direction, limits) if _meets(row, k, direction, line, limits)]
    if not fitting:
        return {}
    longest = max(fitting, key=len)
    if any(frame in longest and longest[frame][0] != row for one in fitting for frame, (row, _) in one.items()):
        return {}
    return {frame: row for frame, (row, _) in longest.items()}


_Row = dict[int, tuple[int, Array]]  # row and place by frame


def _rows(points_of: PointsOf, k: int, direction: int, limits: Limits) -> list[_Row]:
    """All straight rows of at least MIN_ROW points that begin in frame k."""
    frames = [k + direction * i for i in range(ROW_FRAMES)]
    points = [points_of(frame) for frame in frames]
    out = []
    for first, start in zip(*points[0], strict=True):
        for second, place in zip(*points[1], strict=True):
            if np.linalg.norm(place - start) > limits.speed_px:
                continue
            row: _Row = {frames[0]: (int(first), start), frames[1]: (int(second), place)}
            step, latest, at = place - start, 1, place
            for i in range(2, ROW_FRAMES):
                rows, places = points[i]
                if not len(rows):
                    continue
                ahead = i - latest
                away = np.linalg.norm(places - (at + ahead * step), axis=1)
                nearest = int(np.argmin(away))
                if away[nearest] <= SIGMAS * limits.sigma_px * ahead:
                    step, latest, at = (places[nearest] - at) / ahead, i, places[nearest]
                    row[frames[i]] = (int(rows[nearest]), at)
            if len(row) >= MIN_ROW and np.linalg.norm(at - start) >= MIN_MOTION_PX + SIGMAS * limits.sigma_px:
                out.append(row)
    return out


def _meets(row: _Row, k: int, direction: int, line: Line, limits: Limits) -> bool:
    """Whether the row and the line before the corner meet between the line's last point and frame k."""
    second = k + direction
    start, step = row[k][1], row[second][1] - row[k][1]
    gap = abs(k - line.frame)
    # After a time tau since the line's last point: line.uv + tau line.velocity = start - (gap - tau) step.
    apart = line.uv - start + gap * step
    change = line.velocity - step
    tau = float(np.clip(-(apart @ change) / max(float(change @ change), 1e-12), 0.0, gap))
    miss = float(np.linalg.norm(apart + tau * change))
    return miss <= MEETING_SIGMAS * limits.sigma_px * gap


POSE_GATE_CHI2 = 25.0  # squared Mahalanobis distance from the place that the pose predicts


class PathContext(NamedTuple):
    """What is known of a run besides its labels: T frames, n views."""

    camera: Ints  # (n,)
    expected: Array  # (T, n, 2) px: pixels of the spots at the smoothed poses; nan without a projection
    expected_cov: Array  # (T, n, 2, 2) px^2
    log_clutter: Array  # (T, n) log density of false points, 1/px^2
    log_static: Array  # (m,) log density of static points at each detection, 1/px^2
    open: Bools  # (T, n) views that may get labels


class ViewPath:
    """Path of one view's spot in its picture; T frames."""

    def __init__(self, detections: RunDetections, assigned: Ints, context: PathContext, view: int) -> None:
        """assigned (T, n): the labels so far."""
        self.detections, self.assigned, self.context, self.view = detections, assigned, context, view
        self.camera = int(context.camera[view])
        k = np.flatnonzero((assigned[:, view] >= 0) & (assigned[:, view] < BLENDED))
        self.uv = np.full((len(assigned), 2), np.nan)  # px, nan without a label
        self.uv[k] = detections.uv[detections.begin[k] + assigned[k, view]]
        self.open = (assigned[:, view] < 0) & context.open[:, view]  # (T,) frames that may get a label
        steps = np.linalg.norm(np.diff(self.uv, axis=0), axis=1)
        self.speed_px = max(FASTER * float(np.nanmax(steps, initial=0.0)), MIN_SPEED_LIMIT_PX)  # per frame, at most

    @property
    def continuable(self) -> bool:
        """Whether it has frames to label and a history long enough for predictions."""
        missing = self.open & self.detections.has_image[:, self.camera]
        return bool(missing.any() and np.count_nonzero(self.assigned[:, self.view] >= 0) >= MIN_HISTORY)

    def points(self, k: int) -> tuple[Ints, Array]:
        """Rows (m,) and places (m, 2), px, of the points of a frame that are no labelled spots."""
        detections = self.detections
        if not 0 <= k < len(self.uv):
            return np.zeros(0, dtype=np.int64), np.zeros((0, 2))
        rows = np.arange(detections.first[k, self.camera], detections.first[k, self.camera + 1])
        rows = rows[~np.isin(rows, self.assigned[k][self.assigned[k] >= 0] % BLENDED)]
        return rows, detections.uv[detections.begin[k] + rows]

    def covariances(self, k: int, rows: Ints) -> Array:
        """Covariances (m, 2, 2), px^2, of points of a frame."""
        return np.asarray(self.detections.cov[self.detections.begin[k] + rows])

    def false_density(self, k: int, rows: Ints) -> Array:
        """Density (m,), 1/px^2, of false points at points of a frame: a static one is no spot that has come to rest."""
        static = self.context.log_static[self.detections.begin[k] + rows]
        return np.asarray(np.exp(np.maximum(self.context.log_clutter[k, self.view], static)))

    def allowed(self, k: int, row: int) -> bool:
        """Whether the uncertain pose allows the spot at a point. One that does not lead to the screen says nothing."""
        at = self.detections.begin[k] + row
        y = self.detections.uv[at] - self.context.expected[k, self.view]
        if not np.isfinite(y).all():
            return True
        chi2 = y @ np.linalg.solve(self.context.expected_cov[k, self.view] + self.detections.cov[at], y)
        return bool(chi2 < POSE_GATE_CHI2)
