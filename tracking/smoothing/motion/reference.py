"""A reference motion of a run, about which everything is linearised; compiled where it is used frame by frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools
from geometry.compilation.jit import compiled
from geometry.compiled_linalg import copy_into, copy_matrix_into, pose_plus
from geometry.pose import Pose


class Reference(NamedTuple):
    """Motion of T frames, as in tracking/rigid_body/models/motion.py."""

    R: Array  # (T, 3, 3)
    t: Array  # (T, 3), m
    m: Array  # (T, 12)


def speeds(m: Array) -> Array:
    """Speeds (..., 2), m/s and rad/s, of motions (..., 12)."""
    return np.stack([np.linalg.norm(m[..., :3], axis=-1), np.linalg.norm(m[..., 3:6], axis=-1)], axis=-1)


def first_variance(ref: Reference, dt: Array, measured: bool) -> Array:
    """Variances (18,) of the first frame's deviation: wide compared with the run's motion."""
    speed = np.abs(ref.m[:, :6]).reshape(-1, 2, 3).max(axis=(0, 2), initial=0.0)
    change = np.abs(np.diff(ref.m[:, :6], axis=0)) / np.maximum(dt[1:, None], 1e-9)
    acceleration = change.reshape(-1, 2, 3).max(axis=(0, 2), initial=0.0)
    pose = [0.1, 0.1] if measured else [1.0, 1.0]
    return np.asarray(np.repeat([*pose, *(2 * speed + 0.1), *(2 * acceleration + 1.0)], 3) ** 2)


@compiled
def shifted(ref: Reference, x: Array) -> Reference:
    """The reference moved by deviations (T, 18)."""
    R, t, m = ref.R.copy(), ref.t.copy(), ref.m.copy()
    for k in range(ref.t.shape[0]):
        R_k, t_k = pose_plus(ref.R[k], ref.t[k], x[k])
        copy_matrix_into(R[k], R_k)
        copy_into(t[k], t_k)
        for i in range(12):
            m[k, i] += x[k, 6 + i]
    return Reference(R, t, m)


def straight_between(poses: Array, measured: Bools, t_s: Array) -> Reference:
    """First reference: the measured poses, straight interpolation between them, and velocities by differences.

    poses (T, 4, 3): rotation and, below it, translation; measured (T,); t_s (T,): times.
    """
    at = np.flatnonzero(measured & np.isfinite(poses[:, 3, 0]))
    frames = len(t_s)
    if not len(at):
        return Reference(np.tile(np.eye(3), (frames, 1, 1)), np.zeros((frames, 3)), np.zeros((frames, 12)))
    right = np.clip(np.searchsorted(at, np.arange(frames)), 0, len(at) - 1)
    left = np.where(at[right] > np.arange(frames), np.maximum(right - 1, 0), right)
    a, b = at[left], at[right]
    length = t_s[b] - t_s[a]
    share = np.where(length > 0, (t_s - t_s[a]) / np.where(length > 0, length, 1.0), 0.0)
    share = np.clip(share, 0.0, 1.0)  # before the first and after the last: that pose
    before, after = Pose(poses[a, :3], poses[a, 3]), Pose(poses[b, :3], poses[b, 3])
    between = before.plus(after.minus(before) * share[:, None])
    R, t = np.ascontiguousarray(between.rotation), np.ascontiguousarray(between.translation)
    m = np.zeros((frames, 12))
    if frames > 2:
        step = Pose(R[2:], t[2:]).minus(Pose(R[:-2], t[:-2]))
        time = (t_s[2:] - t_s[:-2])[:, None]
        m[1:-1, :6] = step / np.where(time > 0, time, 1.0)
        m[0], m[-1] = m[1], m[-2]
    return Reference(R, t, m)
