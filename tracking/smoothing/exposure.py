"""What an exposure does to spots that move: a picture shows the mean of a path, a pose is asked for at mid-exposure."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools
from geometry.compiled_projection import Views, project_all
from geometry.pose import Pose
from tracking.smoothing.fixed_interval import Reference


def exposure_offsets(views: Views, motion: Reference, exposure_s: float, steady: Bools) -> Array:
    """Mean place of each view's spot over the exposure less its place in the middle (T, n, 2), px; 0 where unknown.

    motion: of T frames, at mid-exposure. A path with a steady acceleration a in the picture has its mean a T^2 / 24
    beside its middle: Simpson's rule on the path of the spot, so that turning and the lens are in it. steady (T,):
    frames whose velocity does not jump within the exposure; the others are left as they are. Ours.
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
    good = np.isfinite(offset).all(axis=-1) & steady[:, None]
    out[good] = offset[good]
    return out


def moved_by(views: Views, motion: Reference, offsets: Array) -> Array:
    """Pose errors (T, 6) that such offsets (T, n, 2), px, make: the least-squares fit to them."""
    _, J = project_all(views, motion.R, motion.t)
    out = np.zeros((len(motion.t), 6))
    for k in np.flatnonzero(np.any(offsets != 0, axis=(1, 2))).tolist():
        rows = np.flatnonzero(np.any(offsets[k] != 0, axis=-1) & np.isfinite(J[k]).all(axis=(1, 2)))
        out[k] = np.linalg.lstsq(J[k, rows].reshape(-1, 6), offsets[k, rows].ravel(), rcond=1e-6)[0]
    return out
