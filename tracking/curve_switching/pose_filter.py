"""The Kalman filter of the vehicle's pose: constant velocity on R3 x SO(3), for frames that do not determine the pose.

Error state (12): [dt (m, world), dtheta (rad, body), dv (m/s, world), domega (rad/s, body)]. Source: ours; the
error-state form of Sola (2017), "Quaternion kinematics for the error-state Kalman filter", sec. 5, without the inertial
sensors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry import rotations
from geometry.arrays import Array, symmetric
from geometry.pose import Pose


@dataclass(frozen=True, slots=True)
class RigidMotion:
    """Pose and velocities with their covariance."""

    world_from_body: Pose
    velocity: Array  # (3,), m/s, world
    rate: Array  # (3,), rad/s, body
    P: Array  # (12, 12) of the error state

    @property
    def twist(self) -> Array:
        """(6,): time derivative of the pose's error coordinates; a pixel Jacobian (.., 6) times it is px/s."""
        return np.concatenate([self.velocity, self.rate])

    @property
    def covariance(self) -> Array:
        """(6, 6) of the pose alone."""
        return self.P[:6, :6]


def begin(pose: Pose, covariance: Array, sigma_velocity_m_s: float = 3.0, sigma_rate_rad_s: float = 3.0) -> RigidMotion:
    """The initial state: a pose with covariance (6, 6), velocities of zero with wide sigmas."""
    P = np.zeros((12, 12))
    P[:6, :6] = covariance
    P[6:9, 6:9] = sigma_velocity_m_s**2 * np.eye(3)
    P[9:, 9:] = sigma_rate_rad_s**2 * np.eye(3)
    return RigidMotion(pose, np.zeros(3), np.zeros(3), P)


def predict(motion: RigidMotion, dt_s: float, sigma_a_m_s2: float, sigma_a_rad_s2: float) -> RigidMotion:
    """The prediction over one time step, with white accelerations (1 sigma) that are constant within the step."""
    turn = motion.rate * dt_s
    pose = motion.world_from_body.plus(np.concatenate([motion.velocity * dt_s, turn]))
    F = np.eye(12)
    F[:3, 6:9] = dt_s * np.eye(3)
    F[3:6, 3:6] = rotations.exp(-turn)
    F[3:6, 9:] = dt_s * rotations.right_jacobian(turn)
    Q = np.zeros((12, 12))
    a2 = np.repeat([sigma_a_m_s2**2, sigma_a_rad_s2**2], 3)
    i = np.arange(6)
    Q[i, i] = a2 * dt_s**4 / 4
    Q[i, i + 6] = Q[i + 6, i] = a2 * dt_s**3 / 2
    Q[i + 6, i + 6] = a2 * dt_s**2
    return RigidMotion(pose, motion.velocity, motion.rate, symmetric(F @ motion.P @ F.T + Q))


def update(motion: RigidMotion, y: Array, H: Array, R: Array) -> tuple[RigidMotion, Array]:
    """The update with a measurement; also the innovation covariance S (k, k).

    y (k,): innovation; H (k, 6): its Jacobian with respect to the pose; R (k, k): measurement covariance.
    """
    PH = motion.P[:, :6] @ H.T
    S = H @ PH[:6] + R
    K = np.linalg.solve(S, PH.T).T
    keep = np.eye(12)
    keep[:, :6] -= K @ H
    P = symmetric(keep @ motion.P @ keep.T + K @ R @ K.T)
    d = K @ y
    return (
        RigidMotion(motion.world_from_body.plus(d[:6]), motion.velocity + d[6:9], motion.rate + d[9:], P),
        S,
    )


def update_with_pose(motion: RigidMotion, pose: Pose, covariance: Array) -> tuple[RigidMotion, Array, Array]:
    """The update with a measured pose, covariance (6, 6); also the innovation (6,) and its covariance (6, 6)."""
    y = pose.minus(motion.world_from_body)
    after, S = update(motion, y, np.eye(6), covariance)
    return after, y, S
