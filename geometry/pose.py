"""Rigid transforms between two frames, and their small errors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools, Ints, cross, normalised


@dataclass(frozen=True, slots=True)
class Pose:
    """The rigid transform a_from_b, x_a = rotation x_b + translation, or a stack of transforms.

    Leading axes are those of the stack, the same for both fields.
    """

    rotation: Array  # (..., 3, 3), proper and orthogonal
    translation: Array  # (..., 3), m

    @staticmethod
    def identity() -> Pose:
        """The identity."""
        return Pose(np.eye(3), np.zeros(3))

    @staticmethod
    def stack(poses: Iterable[Pose]) -> Pose:
        """A stack (k,) of single transforms, possibly none."""
        rows = [(p.rotation, p.translation) for p in poses]
        return Pose(np.array([R for R, _ in rows]).reshape(-1, 3, 3), np.array([t for _, t in rows]).reshape(-1, 3))

    @staticmethod
    def from_quaternion(quaternion_wxyz: Array, translation_m: Array) -> Pose:
        """From a quaternion (..., 4) in the order w, x, y, z and a translation (..., 3), m."""
        rotation = rotations.matrix_from_quaternion(np.asarray(quaternion_wxyz, dtype=float))
        return Pose(rotation, np.asarray(translation_m, dtype=float))

    @staticmethod
    def from_ypr(yaw_pitch_roll: Array, translation_m: Array) -> Pose:
        """From yaw, pitch, roll (..., 3), rad, and a translation (..., 3), m."""
        return Pose(rotations.matrix_from_ypr(yaw_pitch_roll), np.asarray(translation_m, dtype=float))

    @property
    def quaternion_wxyz(self) -> Array:
        """(..., 4), unit, w >= 0."""
        return rotations.quaternion_from_matrix(self.rotation)

    @property
    def ypr(self) -> Array:
        """Yaw, pitch, roll (..., 3), rad."""
        return rotations.ypr_from_matrix(self.rotation)

    def apply(self, points: Array) -> Array:
        """Coordinates in a, (..., 3), of points given in b, (..., 3)."""
        return self.turn(points) + self.translation

    def turn(self, vectors: Array) -> Array:
        """Directions in a, (..., 3), of directions given in b, (..., 3)."""
        return (self.rotation @ np.asarray(vectors, dtype=float)[..., None])[..., 0]

    def inverse(self) -> Pose:
        """b_from_a."""
        R_t = np.swapaxes(self.rotation, -1, -2)
        return Pose(R_t, -(R_t @ self.translation[..., None])[..., 0])

    def __matmul__(self, other: Pose) -> Pose:
        """a_from_c = a_from_b @ b_from_c."""
        return Pose(self.rotation @ other.rotation, self.apply(other.translation))

    def __getitem__(self, index: int | slice | tuple[int, ...] | Ints | Bools) -> Pose:
        """One or some of a stack of transforms."""
        return Pose(self.rotation[index], self.translation[index])

    def plus(self, delta: Array) -> Pose:
        """The transform changed by `delta` (..., 6) = [dt (m, in a), dtheta (rad, in b)]: t + dt and R Exp(dtheta).

        This is the pose error of section 1 of the file contract. Of one transform and many deltas, a stack.
        """
        delta = np.asarray(delta, dtype=float)
        return Pose(self.rotation @ rotations.exp(delta[..., 3:]), self.translation + delta[..., :3])

    def minus(self, other: Pose) -> Array:
        """The delta (..., 6) for which other.plus(delta) = self."""
        turn = np.swapaxes(other.rotation, -1, -2) @ self.rotation
        return np.concatenate([self.translation - other.translation, rotations.log(turn)], axis=-1)


def look_at(position_m: Array, target_m: Array, up: Array | tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Pose:
    """camera_from_world of a camera at `position_m` (3,) aimed at `target_m` (3,), with `up` (3,) up in its picture.

    The target is not the position, and `up` is not along the line of sight.
    """
    z = normalised(np.asarray(target_m, dtype=float) - position_m)
    x = normalised(cross(z, np.asarray(up, dtype=float)))
    R = np.stack([x, cross(z, x), z])
    return Pose(R, -R @ np.asarray(position_m, dtype=float))


def ypr_sigmas(pose: Pose, covariance: Array) -> Array:
    """Standard deviations of yaw, pitch, roll (..., 3), rad, to first order, from pose covariances (..., 6, 6)."""

    J = rotations.ypr_jacobian(pose.rotation)
    turned = J @ covariance[..., 3:, 3:] @ np.swapaxes(J, -1, -2)
    return np.sqrt(np.maximum(np.diagonal(turned, axis1=-2, axis2=-1), 0.0))
