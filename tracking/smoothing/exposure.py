"""Effect of the exposure time on moving spots: a picture shows the mean of a path, the pose is that at mid-exposure."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools
from geometry.compiled_projection import Views, project_all
from geometry.pose import Pose
from tracking.smoothing.motion.process_noise import SHORT_EXPOSURE, corner_offsets
from tracking.smoothing.motion.run_detections import Reference


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
    such as beside strong accelerations that are taken for jumps: their difference times T^2 / 24. The first value is
    for both, the second without the jumps, which the covariances of the motion contain. Short exposures get 0.
    Source: ours.
    """
    corners = corner_offsets(motion, jumped, exposure_s, dt)
    other = np.zeros_like(corners)
    if len(dt) > 2 and exposure_s > SHORT_EXPOSURE * float(np.median(dt[1:])):
        pose = Pose(motion.R, motion.t)
        velocity = pose[1:].minus(pose[:-1]) / dt[1:, None]
        acceleration = (velocity[1:] - velocity[:-1]) / (0.5 * (dt[2:] + dt[1:-1]))[:, None]
        acceleration = acceleration[np.r_[0, 0 : len(dt) - 2, len(dt) - 3]]  # at the ends that of the nearest frames
        other = np.abs(acceleration - motion.m[:, 6:]) * exposure_s**2 / 24
        other[corners.any(axis=1)] = 0.0
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
