"""Constant-velocity prediction of the target's pose: for matching, and for frames without a measurement. Ours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, symmetric
from geometry.pose import Pose

FIRST_SPEED_M_S, FIRST_RATE_RAD_S = 5.0, 2.0  # 1 sigma of the unknown velocity after the first pose


@dataclass(frozen=True, slots=True)
class Motion:
    """A pose with its velocity: error [dt (m, world), dtheta (rad, body), dv (m/s), domega (rad/s, body)]."""

    t_s: float
    pose: Pose
    velocity: Array  # (6,): m/s in world, rad/s in body
    covariance: Array  # (12, 12)

    @staticmethod
    def at_rest(t_s: float, pose: Pose, covariance: Array) -> Motion:
        """The first measured pose, covariance (6, 6), of unknown velocity."""
        P = np.zeros((12, 12))
        P[:6, :6] = covariance
        P[6:, 6:] = np.diag([FIRST_SPEED_M_S**2] * 3 + [FIRST_RATE_RAD_S**2] * 3)
        return Motion(t_s, pose, np.zeros(6), P)

    def predicted(self, t_s: float, acceleration: float, turn: float) -> Motion:
        """At a later time, with accelerations of these sigmas, m/s^2 and rad/s^2, constant between two times."""
        dt = t_s - self.t_s
        F = np.eye(12)
        F[:6, 6:] = dt * np.eye(6)
        G = np.concatenate([0.5 * dt * dt * np.eye(6), dt * np.eye(6)])
        q = np.diag([acceleration**2] * 3 + [turn**2] * 3)
        P = F @ self.covariance @ F.T + G @ q @ G.T
        return Motion(t_s, self.pose.plus(dt * self.velocity), self.velocity, symmetric(P))

    def updated(self, pose: Pose, covariance: Array) -> Motion:
        """With a measured pose of covariance (6, 6): Kalman update, Joseph form."""
        H = np.eye(6, 12)
        S = self.covariance[:6, :6] + covariance
        gain = np.linalg.solve(S, self.covariance[:6]).T
        change = gain @ pose.minus(self.pose)
        keep = np.eye(12) - gain @ H
        P = symmetric(keep @ self.covariance @ keep.T + gain @ covariance @ gain.T)
        return Motion(self.t_s, self.pose.plus(change[:6]), self.velocity + change[6:], P)

    @property
    def pose_covariance(self) -> Array:
        """(6, 6)."""
        return self.covariance[:6, :6]
