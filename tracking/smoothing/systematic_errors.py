"""Errors that are common to the frames of a run: of the calibration, and of the exposure time on moving spots.

They are given for the expected pixels and for the poses. A picture shows the mean of a path over the exposure; the pose
is that at its middle.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compiled_projection import Views, project_all
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import covariances_of
from geometry.uncertainty.rig_uncertainty import share_without_calibration
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.motion.process_noise import corner_offsets
from tracking.smoothing.motion.run_detections import Reference, RunDetections
from tracking.smoothing.recording import TrackedRecording

_FEWEST_SPOTS = 3  # of a frame's pose
_TOGETHER = 256  # frames whose covariances of all pixels are moved at once
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
    use = (assigned >= 0) & (assigned < BLENDED)
    at = np.flatnonzero(rec.measured & (use.sum(axis=1) >= _FEWEST_SPOTS))
    if rec.calibration is None or not len(at):
        return calibration_cov, np.zeros((1, 6, 6)), np.ones(frames)
    use, noise = use[at], np.zeros((len(at), n, 2, 2))
    noise[use] = detections.cov[(detections.begin[at][:, None] + assigned[at])[use]]
    J = project_all(rec.model.numbers, ref.R[at], ref.t[at])[1]
    gains, has_pose, _ = _gains(J, use, noise, noise)
    at, use = at[has_pose], use[has_pose]
    noise, J, gains = noise[has_pose], J[has_pose], gains[has_pose]
    pixel_cov = np.empty((len(at), 2 * n, 2 * n))
    for some in np.array_split(np.arange(len(at)), len(at) // _TOGETHER + 1):
        pixel_cov[some] = C = rec.calibration.at(Pose(ref.R[at[some]], ref.t[at[some]]))
        left = (np.eye(2 * n) - J[some].reshape(-1, 2 * n, 6) @ gains[some]).reshape(-1, n, 2, 2 * n)
        calibration_cov += np.sum((left @ C[:, None]) @ np.swapaxes(left, -1, -2), axis=0) / max(len(at), 1)
    weighted, has_pose, share_left = _gains(J, use, noise, noise + calibration_cov)
    gains[has_pose] = weighted[has_pose]
    systematic, share = np.zeros((frames, 6, 6)), np.ones(frames)
    if len(at):
        latest = np.maximum(np.searchsorted(at, np.arange(frames), side="right") - 1, 0)
        systematic, share[at] = (gains @ pixel_cov @ np.swapaxes(gains, 1, 2))[latest], share_left
    return calibration_cov, systematic, share


def _gains(J: Array, use: Bools, noise: Array, cov: Array) -> tuple[Array, Bools, Array]:
    """The poses' derivatives (K, 6, 2 n) by the pixels of K frames' used views (K, n), with weights of `cov`.

    J (K, n, 2, 6): Jacobians; noise, cov (K, n, 2, 2). Second: which frames have a pose (K,). Third: the share (K,) of
    an optimal motion's covariance that is left without what `cov` has beyond the noise.
    """
    W = np.where(use[..., None, None], np.linalg.inv(np.where(use[..., None, None], cov, np.eye(2))), 0.0)
    JW = np.swapaxes(J, -1, -2) @ W  # (K, n, 6, 2)
    H = np.sum(JW @ J, axis=1)
    covariance, full_rank = covariances_of(H)
    gains = np.where(full_rank[:, None, None], covariance, 0.0) @ np.concatenate(list(np.moveaxis(JW, 1, 0)), axis=-1)
    return gains, full_rank, share_without_calibration(H, np.sum(JW @ noise @ np.swapaxes(JW, -1, -2), axis=1))
