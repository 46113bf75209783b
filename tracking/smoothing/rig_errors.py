"""What a recording shows of the errors of its rig, which are the same in all frames.

A rig that is wrong by a draw of its covariance shifts a spot by nearly the same everywhere. Residuals that contain such
shifts look like errors that belong to places, and hide how large the noise is. Source: ours; mean and covariance of the
posterior distribution of a linear regression from which the poses are eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints, evenly_spread, finite
from geometry.compiled_projection import Views, project_all
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import RigUncertainty
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.motion.run_detections import Reference, RunDetections
from tracking.smoothing.place_errors import PLACE_REACH, frames_with_same_error, usable_widths

_FRAMES = 300  # at most so many, evenly spaced, show the errors
_BLOCK = 256  # frames whose derivatives are computed together
_OUTLIER2 = 9.0  # times their median: squared residuals above it say nothing about the rig


@dataclass(frozen=True, slots=True)
class RigErrors:
    """r independent errors of a rig (`RigUncertainty.root_at`), whose sigmas are 1 before the recording."""

    calibration: RigUncertainty
    mean: Array  # (r,)
    covariance: Array  # (r, r)

    @staticmethod
    def shown(
        calibration: RigUncertainty, views: Views, run: RunDetections, assigned: Ints, place_px2: Array,
        ref: Reference, measured: Bools,
    ) -> RigErrors:  # fmt: skip
        """From the labelled points (T, n) of the measured ones of T frames, near a reference motion.

        place_px2 (m,): part of the variances of the m detections that belongs to places. Such errors count once for
        each place, not for each frame.
        """
        frames = evenly_spread(np.flatnonzero(measured), _FRAMES)
        points = _Points.of(run, assigned, frames, ref)
        share = np.minimum(place_px2[points.rows] / (0.5 * np.trace(run.cov[points.rows], axis1=2, axis2=3)), 1.0)
        for i, width in enumerate(usable_widths(run.usual_size_px)):
            same = frames_with_same_error(points.uv[:, i], PLACE_REACH * width)
            points.cov[:, i] *= (1 + share[:, i] * (same - 1))[:, None, None]
        residual = (points.uv - project_all(views, points.R, points.t)[0])[..., None]
        both = np.concatenate([residual, points.moves(calibration)], axis=-1)
        for _ in range(2):  # the second time without outliers
            beside, W = points.beside_poses(views, both), points.weights()
            left, A = beside[..., 0], beside[..., 1:]
            WA = W @ A
            covariance = np.linalg.inv(np.eye(A.shape[-1]) + np.einsum("knip,kniq->pq", A, WA, optimize=True))
            mean = covariance @ np.einsum("knip,kni->p", WA, left)
            left = left - A @ mean
            square = np.einsum("kni,knij,knj->kn", left, W, left)
            usual = np.median(square[square > 0]) if (square > 0).any() else np.inf
            points.cov[square > _OUTLIER2 * usual] = np.nan
        return RigErrors(calibration, mean, covariance)

    def in_residuals(
        self, views: Views, run: RunDetections, assigned: Ints, frames: Ints, ref: Reference, more_cov: Array
    ) -> tuple[Array, Array]:
        """The errors' mean in the residuals of F frames (F, n, 2), px, and the covariances (F, n, 2, 2), px^2, of what
        it leaves in them or takes from them; 0 without a point.

        The residuals are those to poses fitted with the covariances of the detections and more_cov (n, 2, 2), px^2.
        """
        shift, unknown = np.zeros((len(frames), assigned.shape[1], 2)), np.zeros((len(frames), assigned.shape[1], 2, 2))
        for begin in range(0, len(frames), _BLOCK):
            some = slice(begin, begin + _BLOCK)
            points = _Points.of(run, assigned, frames[some], ref)
            points.cov += more_cov
            A = points.beside_poses(views, points.moves(self.calibration))
            shift[some], unknown[some] = A @ self.mean, A @ self.covariance @ np.swapaxes(A, -1, -2)
        return shift, unknown

    def taken_from(
        self, views: Views, run: RunDetections, assigned: Ints, ref: Reference
    ) -> tuple[RunDetections, Array]:
        """The detections with their labelled points (T, n) where they would be without the shown errors; and the mean
        covariances (n, 2, 2), px^2, of what their residuals may have kept or lost.
        """
        none = np.zeros((assigned.shape[1], 2, 2))
        shift, unknown = self.in_residuals(views, run, assigned, np.arange(len(assigned)), ref, none)
        labelled = (assigned >= 0) & (assigned < BLENDED)
        uv = run.uv.copy()
        uv[(run.begin[:-1, None] + assigned)[labelled]] -= shift[labelled]
        return run._replace(uv=uv), unknown.sum(axis=0) / np.maximum(labelled.sum(axis=0), 1)[:, None, None]


@dataclass(slots=True)
class _Points:
    """The labelled points of F frames and n views, near a motion."""

    rows: Ints  # (F, n) of the detections, 0 without a point
    uv: Array  # (F, n, 2) px, nan without a point
    cov: Array  # (F, n, 2, 2) px^2, nan where not used
    R: Array  # (F, 3, 3)
    t: Array  # (F, 3)

    @staticmethod
    def of(run: RunDetections, assigned: Ints, frames: Ints, ref: Reference) -> _Points:
        assigned = assigned[frames]
        labelled = (assigned >= 0) & (assigned < BLENDED)
        rows = np.where(labelled, run.begin[frames, None] + assigned, 0)
        uv, cov = np.where(labelled[..., None], run.uv[rows], np.nan), run.cov[rows]
        return _Points(rows, uv, np.where(labelled[..., None, None], cov, np.nan), ref.R[frames], ref.t[frames])

    def moves(self, calibration: RigUncertainty) -> Array:
        """(F, n, 2, r): px per error of the rig."""
        root = calibration.root_at(Pose(self.R, self.t))
        return np.asarray(root.reshape(*self.uv.shape, root.shape[-1]))

    def weights(self) -> Array:
        """(F, n, 2, 2): the inverse of the covariances, 0 where not used."""
        W, used = np.zeros_like(self.cov), finite(self.cov, (2, 3))
        W[used] = np.linalg.inv(self.cov[used])
        return W

    def beside_poses(self, views: Views, moves: Array) -> Array:
        """The part of displacements (F, n, 2, r) of the points that is left beside fitted poses; 0 where not used."""
        J, W = project_all(views, self.R, self.t)[1], self.weights()
        used = finite(self.cov, (2, 3)) & finite(J, (2, 3)) & finite(moves, (2, 3))
        J, moves = np.where(used[..., None, None], J, 0.0), np.where(used[..., None, None], moves, 0.0)
        WJ = W @ J
        information = np.einsum("knia,knib->kab", J, WJ)
        pose = np.linalg.pinv(information, hermitian=True) @ np.einsum("knia,knir->kar", WJ, moves)
        return np.asarray(moves - J @ pose[:, None])
