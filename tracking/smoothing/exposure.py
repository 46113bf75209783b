"""Effect of the exposure time on moving spots: a picture shows the mean of a path, the pose is that at mid-exposure."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools
from geometry.compiled_projection import Views, project_all
from geometry.pose import Pose
from tracking.smoothing.motion.reference import Reference


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


def pose_shift(views: Views, motion: Reference, offsets: Array) -> Array:
    """Pose errors (T, 6) that pixel offsets (T, n, 2) cause: their least-squares fit."""
    _, J = project_all(views, motion.R, motion.t)
    out = np.zeros((len(motion.t), 6))
    for k in np.flatnonzero(np.any(offsets != 0, axis=(1, 2))).tolist():
        rows = np.flatnonzero(np.any(offsets[k] != 0, axis=-1) & np.isfinite(J[k]).all(axis=(1, 2)))
        out[k] = np.linalg.lstsq(J[k, rows].reshape(-1, 6), offsets[k, rows].ravel(), rcond=1e-6)[0]
    return out
