"""The labelled path of one view's spot in its picture, and the points that may continue it. Source: ours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.labels.path_corners import FASTER, MIN_SPEED_LIMIT_PX
from tracking.smoothing.labels.path_prediction import MIN_HISTORY
from tracking.smoothing.motion.run_detections import RunDetections

REST_CHI2 = 9.0  # of the distance between two points of one spot at rest (2 degrees of freedom)
POSE_GATE_CHI2 = 25.0  # squared Mahalanobis distance from the place that the pose predicts


class PathContext(NamedTuple):
    """What is known of a run besides its labels: T frames, n views."""

    camera: Ints  # (n,)
    expected: Array  # (T, n, 2) px: pixels of the spots at the smoothed poses; nan without a projection
    expected_cov: Array  # (T, n, 2, 2) px^2
    log_clutter: Array  # (T, n) log density of false points, 1/px^2
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

    def false_density(self, k: int, rows: Ints, place: Array, before: Array) -> Array:
        """Density (m,), 1/px^2, of false points at those of a frame; before (2,): last place of the path.

        A spot at rest looks like a static reflection while it has no label. One just where the spot has been is none:
        the two would have been one point.
        """
        away = place - before
        rests = np.einsum("mi,mij,mj->m", away, np.linalg.inv(2 * self.covariances(k, rows)), away) < REST_CHI2
        static = np.where(rests, -np.inf, self.detections.log_static[self.detections.begin[k] + rows])
        return np.asarray(np.exp(np.maximum(self.log_clutter(k), static)))

    def log_clutter(self, k: int) -> float:
        """Log density, 1/px^2, of false points in a frame without what is known of static ones."""
        return float(self.context.log_clutter[k, self.view])

    def allowed(self, k: int, row: int) -> bool:
        """Whether the uncertain pose allows the spot at a point. One that does not lead to the screen says nothing."""
        at = self.detections.begin[k] + row
        y = self.detections.uv[at] - self.context.expected[k, self.view]
        if not np.isfinite(y).all():
            return True
        chi2 = y @ np.linalg.solve(self.context.expected_cov[k, self.view] + self.detections.cov[at], y)
        return bool(chi2 < POSE_GATE_CHI2)
