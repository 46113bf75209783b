"""Errors that are common to the frames of a run: of the calibration, and of the exposure time on moving spots.

They are given for the expected pixels and for the poses. A picture shows the mean of a path over the exposure; the pose
is that at its middle.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compiled_projection import Views, project_all
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import coordinates_of, covariance_of
from geometry.uncertainty.rig_uncertainty import share_without_calibration
from tracking.smoothing.motion.process_noise import corner_offsets
from tracking.smoothing.motion.run_detections import Reference, RunDetections, labelled_points
from tracking.smoothing.recording import TrackedRecording

_SHORT = 0.1  # of the step between two frames: within a shorter exposure accelerations move nothing


def exposure_offsets(views: Views, motion: Reference, exposure_s: float, steady: Bools) -> Array:
    """Mean pixel of each view's spot over the exposure less that at its middle (T, n, 2); 0 where unknown.

    motion: T frames, at mid-exposure. With a constant acceleration a in the picture the mean lies a T^2 / 24 from the
    middle; Simpson's rule on the spot's path includes rotation and lens distortion. steady (T,): frames whose
    velocities do not jump within the exposure; the others get 0. Source: ours.
    """
    frames = len(motion.t)
    out = np.zeros((frames, len(views), 2))
    if exposure_s <= 0 or not steady.any():
        return out
    middle, _ = project_all(views, motion.R, motion.t)
    ends = np.zeros_like(middle)
    pose = Pose(motion.R, motion.t)
    for h in (-0.5 * exposure_s, 0.5 * exposure_s):
        step = h * motion.m[:, :6] + 0.5 * h * h * motion.m[:, 6:]
        moved = pose.plus(step)
        ends += project_all(views, moved.rotation, moved.translation)[0]
    offset = (ends - 2 * middle) / 6
    valid = np.isfinite(offset).all(axis=-1) & steady[:, None]
    out[valid] = offset[valid]
    return out


def exposure_sigmas(motion: Reference, jumped: Bools, exposure_s: float, dt: Array) -> tuple[Array, Array]:
    """Sigmas (T, 6), m and rad, of the pose's mean over the exposure less that at its middle, beyond the offsets above.

    Where the velocities jump (`corner_offsets`), and where the acceleration of the motion is not that of its poses,
    such as beside strong accelerations that are taken for jumps: their difference times T^2 / 24. Each component has
    one of the two, since others may turn in a frame while it accelerates. The first value is for both, the second
    without the jumps, which the covariances of the motion contain. Short exposures get 0. Source: ours.
    """
    corners = corner_offsets(motion, jumped, exposure_s, dt)
    other = np.zeros_like(corners)
    if len(dt) > 2 and exposure_s > _SHORT * float(np.median(dt[1:])):
        pose = Pose(motion.R, motion.t)
        velocity = pose[1:].minus(pose[:-1]) / dt[1:, None]
        acceleration = (velocity[1:] - velocity[:-1]) / (0.5 * (dt[2:] + dt[1:-1]))[:, None]
        acceleration = acceleration[np.r_[0, 0 : len(dt) - 2, len(dt) - 3]]  # at the ends that of the nearest frames
        other = np.abs(acceleration - motion.m[:, 6:]) * exposure_s**2 / 24
        other[corners > 0] = 0.0
    return np.abs(corners) + other, other


def pose_shift(views: Views, motion: Reference, offsets: Array) -> Array:
    """Pose errors (T, 6) that pixel offsets (T, n, 2) cause: their least-squares fit."""
    out = np.zeros((len(motion.t), 6))
    frames = np.flatnonzero(np.any(offsets != 0, axis=(1, 2)))
    _, J = project_all(views, motion.R[frames], motion.t[frames])
    for k, J_k in zip(frames.tolist(), J, strict=True):
        rows = np.flatnonzero(np.any(offsets[k] != 0, axis=-1) & np.isfinite(J_k).all(axis=(1, 2)))
        out[k] = np.linalg.lstsq(J_k[rows].reshape(-1, 6), offsets[k, rows].ravel(), rcond=1e-6)[0]
    return out


def calibration_errors(
    rec: TrackedRecording, detections: RunDetections, assigned: Ints, ref: Reference
) -> tuple[Array, Array, Array]:
    """Covariances of the expected pixels (n, 2, 2), px^2, mean over the run, and of the poses (T or 1, 6, 6).

    Third: the share (T,) of the smoother's own covariance that is left, since its weights include the first of these.

    The smoother weights each spot with its noise and the first of these. The pose that follows from such weights moves
    with the calibration's errors by (J^T W J)^-1 J^T W: the same in every frame with these spots, so that no averaging
    reduces it. A frame without such a pose has the covariance of the frame before, or of the first one that has it.
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
            residual[:, coordinates_of(rows)] -= J[k].reshape(2 * n, 6) @ G
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
            both = coordinates_of(rows)
            before, latest = latest, G @ C[np.ix_(both, both)] @ G.T
            if not before.any():  # the frames before this one have poses only of the smoothing pass
                systematic[:k] = latest
            _, _, cov = labelled_points(detections, k, assigned[k], np.zeros_like(calibration_cov))
            share[k] = share_without_calibration(J[k][rows], cov[rows], calibration_cov[rows])
        systematic[k] = latest
    return calibration_cov, systematic, share


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
