"""Rotations in three dimensions: exponential, logarithm, quaternions, yaw-pitch-roll.

All functions take stacks: the last one or two axes are the rotation, the rest broadcasts.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, skew


def exp(rotvec: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad.

    Rodrigues' formula; below 1e-4 rad the series to fourth order, whose error is then under 1e-18.
    """
    rotvec = np.asarray(rotvec, dtype=float)
    angle2 = np.sum(rotvec * rotvec, axis=-1)
    small = angle2 < 1e-8
    safe = np.sqrt(np.where(small, 1.0, angle2))
    a = np.where(small, 1 - angle2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle2 / 24, (1 - np.cos(safe)) / safe**2)
    K = skew(rotvec)
    return np.eye(3) + a[..., None, None] * K + b[..., None, None] * (K @ K)


def log(rotation: Array) -> Array:
    """Rotation vectors (..., 3), rad, |.| <= pi, of rotation matrices (..., 3, 3).

    By way of the quaternion, which is accurate at 0 and at pi (where the skew part of the matrix vanishes).
    """
    q = quaternion_from_matrix(rotation)
    v, w = q[..., 1:], q[..., 0]
    s = np.linalg.norm(v, axis=-1)
    small = s < 1e-8
    factor = np.where(small, 2.0, 2 * np.arctan2(s, w) / np.where(small, 1.0, s))
    return factor[..., None] * v


def angle(rotation: Array) -> Array:
    """Rotation angles (...), rad, 0 to pi, of rotation matrices (..., 3, 3)."""
    return np.linalg.norm(log(rotation), axis=-1)


def right_jacobian(rotvec: Array) -> Array:
    """The right Jacobian J_r (..., 3, 3) of rotation vectors: Exp(v + d) = Exp(v) Exp(J_r d) to first order.

    Source: Chirikjian, Stochastic Models, Information Theory, and Lie Groups 2 (2012), eq. 10.86.
    """
    rotvec = np.asarray(rotvec, dtype=float)
    angle2 = np.sum(rotvec * rotvec, axis=-1)
    small = angle2 < 1e-8
    safe = np.sqrt(np.where(small, 1.0, angle2))
    a = np.where(small, 0.5 - angle2 / 24, (1 - np.cos(safe)) / safe**2)
    b = np.where(small, 1 / 6 - angle2 / 120, (safe - np.sin(safe)) / safe**3)
    K = skew(rotvec)
    return np.eye(3) - a[..., None, None] * K + b[..., None, None] * (K @ K)


def nearest_rotation(matrix: Array) -> Array:
    """The rotation (3, 3) nearest to a matrix (3, 3) in the sum of squares, by its singular values."""
    U, _, Vt = np.linalg.svd(matrix)
    return np.asarray(U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt)


def quaternion_from_matrix(rotation: Array) -> Array:
    """Unit quaternions (..., 4), order w, x, y, z with w >= 0, of rotation matrices (..., 3, 3).

    Source: Shepperd (1978), the one of the four forms with the largest divisor, which is accurate at every angle.
    """
    R = np.asarray(rotation, dtype=float)
    m00, m01, m02 = R[..., 0, 0], R[..., 0, 1], R[..., 0, 2]
    m10, m11, m12 = R[..., 1, 0], R[..., 1, 1], R[..., 1, 2]
    m20, m21, m22 = R[..., 2, 0], R[..., 2, 1], R[..., 2, 2]
    forms = np.empty((*R.shape[:-2], 4, 4))  # symmetric; entry by entry, since np.stack takes as long as all the rest
    for i, diagonal in enumerate((1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22)):
        forms[..., i, i] = diagonal
    for (i, j), entry in (
        ((0, 1), m21 - m12), ((0, 2), m02 - m20), ((0, 3), m10 - m01),
        ((1, 2), m01 + m10), ((1, 3), m02 + m20), ((2, 3), m12 + m21),
    ):  # fmt: skip
        forms[..., i, j] = forms[..., j, i] = entry
    best = np.argmax(np.diagonal(forms, axis1=-2, axis2=-1), axis=-1).ravel()
    q = forms.reshape(-1, 4, 4)[np.arange(len(best)), best].reshape(*R.shape[:-2], 4)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def matrix_from_quaternion(quaternion_wxyz: Array) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), order w, x, y, z; normalised first."""
    q = np.asarray(quaternion_wxyz, dtype=float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    rows = [
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return np.stack(rows, -2)


def matrix_from_ypr(yaw_pitch_roll: Array) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll), (..., 3, 3), of angles (..., 3), rad."""
    ypr = np.asarray(yaw_pitch_roll, dtype=float)
    (cy, cp, cr), (sy, sp, sr) = np.moveaxis(np.cos(ypr), -1, 0), np.moveaxis(np.sin(ypr), -1, 0)
    rows = [
        np.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr], -1),
        np.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], -1),
        np.stack([-sp, cp * sr, cp * cr], -1),
    ]
    return np.stack(rows, -2)


def ypr_from_matrix(rotation: Array) -> Array:
    """Yaw, pitch, roll (..., 3), rad, of rotation matrices (..., 3, 3). At pitch +-90 deg roll is set to 0.

    Roll is computed from Rz(-yaw) R, so that the three angles reproduce R even where yaw is poorly determined, near a
    pitch of +-90 deg.
    """
    R = np.asarray(rotation, dtype=float)
    cos_pitch = np.hypot(R[..., 0, 0], R[..., 1, 0])
    pitch = np.arctan2(-R[..., 2, 0], cos_pitch)
    locked = cos_pitch < 1e-9
    yaw = np.where(locked, np.arctan2(-R[..., 0, 1], R[..., 1, 1]), np.arctan2(R[..., 1, 0], R[..., 0, 0]))
    c, s = np.cos(yaw), np.sin(yaw)
    roll = np.arctan2(s * R[..., 0, 2] - c * R[..., 1, 2], c * R[..., 1, 1] - s * R[..., 0, 1])
    return np.stack([yaw, pitch, roll], -1)


def ypr_jacobian(rotation: Array) -> Array:
    """d(yaw, pitch, roll) / d(theta) (..., 3, 3) for R Exp(theta): the effect of a body-frame error on the angles.

    Source: the kinematic equations of an aircraft's body rates (for instance Stevens & Lewis, Aircraft Control and
    Simulation, eq. 1.3-22): roll' = p + tan(pitch) (q sin(roll) + r cos(roll)), and so on. Unbounded at pitch +-90 deg.
    """

    ypr = ypr_from_matrix(rotation)
    pitch, roll = ypr[..., 1], ypr[..., 2]
    c, s = np.cos(roll), np.sin(roll)
    cos_pitch = np.maximum(np.abs(np.cos(pitch)), 1e-9)
    zero, one = np.zeros_like(c), np.ones_like(c)
    tan_pitch = np.sin(pitch) / cos_pitch
    rows = [
        np.stack([zero, s / cos_pitch, c / cos_pitch], -1),
        np.stack([zero, c, -s], -1),
        np.stack([one, s * tan_pitch, c * tan_pitch], -1),
    ]
    return np.stack(rows, -2)
