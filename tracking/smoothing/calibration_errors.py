"""Effect of the calibration's errors on a whole run: on the expected pixels and on the poses."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compiled_projection import project_all
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import covariance_of
from geometry.uncertainty.rig_uncertainty import share_without_calibration
from tracking.smoothing.motion.run_detections import Reference, RunDetections, labelled_points
from tracking.smoothing.recording import TrackedRecording


def calibration_errors(
    rec: TrackedRecording, detections: RunDetections, assigned: Ints, ref: Reference
) -> tuple[Array, Array, Array]:
    """Covariances of the expected pixels (n, 2, 2), px^2, mean over the run, and of the poses (T or 1, 6, 6).

    Third: the share (T,) of the smoother's own covariance that is left, since its weights include the first of these.

    The smoother weights each spot with its noise and the first of these. The pose that follows from such weights moves
    with the calibration's errors by (J^T W J)^-1 J^T W: the same in every frame with these spots, so that no averaging
    reduces it. A frame without such a pose has the covariance of the frame before.
    """
    n, frames = len(rec.model), len(rec)
    calibration_cov = np.zeros((n, 2, 2))
    if rec.calibration is None:
        return calibration_cov, np.zeros((1, 6, 6)), np.ones(frames)
    pixel_cov: list[Array | None] = [None] * frames
    for block in np.array_split(np.flatnonzero(rec.measured), frames // 256 + 1):
        for k, C in zip(block.tolist(), rec.calibration.at(Pose(ref.R[block], ref.t[block])), strict=True):
            pixel_cov[k] = C
    J = project_all(rec.model.numbers, ref.R, ref.t)[1]
    gains = _gains(rec, detections, assigned, J, calibration_cov)
    total, count = np.zeros((n, 2, 2)), 0
    for k, (gain, C) in enumerate(zip(gains, pixel_cov, strict=True)):
        if gain is not None and C is not None:
            rows, G = gain
            residual = np.eye(2 * n)
            residual[:, _coordinates(rows)] -= J[k].reshape(2 * n, 6) @ G
            joint = (residual @ C @ residual.T).reshape(n, 2, n, 2)
            total += joint[np.arange(n), :, np.arange(n)]
            count += 1
    calibration_cov = total / max(count, 1)
    weighted = _gains(rec, detections, assigned, J, calibration_cov)
    systematic, share = np.zeros((frames, 6, 6)), np.ones(frames)
    latest = np.zeros((6, 6))
    for k, C in enumerate(pixel_cov):
        gain = gains[k] if weighted[k] is None else weighted[k]
        if gain is not None and C is not None:
            rows, G = gain
            both = _coordinates(rows)
            latest = G @ C[np.ix_(both, both)] @ G.T
            _, _, cov = labelled_points(detections, k, assigned[k], np.zeros_like(calibration_cov))
            share[k] = share_without_calibration(J[k][rows], cov[rows], calibration_cov[rows])
        systematic[k] = latest
    return calibration_cov, systematic, share


def _coordinates(rows: Ints) -> Ints:
    """Indices (2 m,) of both coordinates of views (m,) in a vector of all pixels."""
    return np.stack([2 * rows, 2 * rows + 1], axis=-1).ravel()


def _gains(
    rec: TrackedRecording, detections: RunDetections, assigned: Ints, J: Array, calibration_cov: Array
) -> list[tuple[Ints, Array] | None]:
    """By frame: the views (m,) used in the pose, and the pose's derivative (6, 2 m) by their pixels; None: no pose.

    J (T, n, 2, 6): Jacobians; the weights are those of noise plus calibration_cov (n, 2, 2).
    """
    out: list[tuple[Ints, Array] | None] = [None] * len(rec)
    for k in np.flatnonzero(rec.measured).tolist():
        use, _, cov = labelled_points(detections, k, assigned[k], np.zeros_like(calibration_cov))
        rows = np.flatnonzero(use)
        if len(rows) < 3:
            continue
        J_k, W = J[k][rows], np.linalg.inv(cov[rows] + calibration_cov[rows])
        JW = np.swapaxes(J_k, 1, 2) @ W  # (m, 6, 2)
        covariance, full_rank = covariance_of(np.sum(JW @ J_k, axis=0))
        if full_rank:
            out[k] = rows, covariance @ np.concatenate(list(JW), axis=1)
    return out
