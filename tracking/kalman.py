"""Kalman filters with white acceleration: of positions, for many filters at once, and of the pose of a rigid body.

Positions are those of spots (u, v) or circles (u, v, r).

State (..., n): m positions, m rates, and what else a filter has. Measured are the m positions: H = [I 0].
Source: Huo, Yang & Yang 2015, eqs. (1) to (6). The paper calls the transition matrix H and the observation matrix F;
here they have their usual letters, F and (implicitly) H.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry import rotations
from geometry.arrays import Array, symmetric
from geometry.pose import Pose


def transition(dt: float, m: int = 2) -> Array:
    """The transition matrix F (2m, 2m) of eq. (1) for a time step dt."""
    F = np.eye(2 * m)
    F[:m, m:] = dt * np.eye(m)
    return F


def process_noise(sigma_a: Array, dt: float) -> Array:
    """The process noise Q (..., 2m, 2m) of eq. (2), with the 1-sigma accelerations (..., m) of the positions.

    The acceleration is white noise that is constant within a frame and independent between frames.
    """
    gain = np.concatenate([0.5 * dt * dt * np.eye(sigma_a.shape[-1]), dt * np.eye(sigma_a.shape[-1])])
    return np.asarray(gain * sigma_a[..., None, :] ** 2 @ gain.T)


def predict(x: Array, P: Array, dt: float, sigma_a: Array) -> tuple[Array, Array]:
    """Eqs. (1) and (2): states (..., 2m) and covariances after a time step; sigma_a (...) is that of each axis."""
    m = x.shape[-1] // 2
    Q = process_noise(np.repeat(np.asarray(sigma_a, dtype=float)[..., None], m, axis=-1), dt)
    return propagate(x, P, transition(dt, m), Q)


def propagate(x: Array, P: Array, F: Array, Q: Array) -> tuple[Array, Array]:
    """States (..., n) and covariances (..., n, n) predicted with F and Q (..., n, n)."""
    return (F @ x[..., None])[..., 0], F @ P @ np.swapaxes(F, -1, -2) + Q


def innovation(x: Array, P: Array, z: Array, R: Array) -> tuple[Array, Array, Array]:
    """The innovation y = z - Hx (..., m) of eq. (4), its covariance S (..., m, m) of eq. (3), and y^T S^-1 y (...).

    z (..., m): measured positions; R (..., m, m): their covariances.
    """
    m = z.shape[-1]
    y = z - x[..., :m]
    S = P[..., :m, :m] + R
    nis = np.sum(y * np.linalg.solve(S, y[..., None])[..., 0], axis=-1)
    return y, S, nis


def update(x: Array, P: Array, z: Array, R: Array) -> tuple[Array, Array]:
    """Eqs. (3), gain, (4), state, and (5), covariance: the update with positions z (..., m) of covariances R.

    The covariance has Joseph's form instead of the paper's (I - KH) P: rounding errors cannot make it indefinite.
    """
    m = z.shape[-1]
    y = z - x[..., :m]
    K = np.swapaxes(np.linalg.solve(P[..., :m, :m] + R, np.swapaxes(P[..., :, :m], -1, -2)), -1, -2)
    return x + (K @ y[..., None])[..., 0], _joseph(P, K, K, R)


def _joseph(P: Array, K: Array, KH: Array, R: Array) -> Array:
    """The covariance (..., n, n) after an update with gain K (..., n, k); KH (..., n, m): for the first m numbers."""
    keep = np.broadcast_to(np.eye(P.shape[-1]), P.shape).copy()
    keep[..., :, : KH.shape[-1]] -= KH
    return symmetric(keep @ P @ np.swapaxes(keep, -1, -2) + K @ R @ np.swapaxes(K, -1, -2))


def restart(z: Array, R: Array, last: Array, R_last: Array, dt_s: Array | float) -> tuple[Array, Array]:
    """Eq. (6), the filter restart at a bend: state and covariance from the measured and the last position.

    z, last (..., 2), px, with covariances R, R_last (..., 2, 2). The paper does not define the rate and the covariance
    at a bend; here the rate is (z - last) / dt, with dt the time between the two positions, and the covariance follows
    from it: R, R/dt, (R + R_last)/dt^2.
    """
    dt = np.asarray(dt_s, dtype=float)
    x = np.concatenate([z, (z - last) / dt[..., None]], axis=-1)
    P = np.empty((*z.shape[:-1], 4, 4))
    step = dt[..., None, None]
    P[..., :2, :2] = R
    P[..., :2, 2:] = P[..., 2:, :2] = R / step
    P[..., 2:, 2:] = (R + R_last) / step**2
    return x, P


@dataclass(frozen=True, slots=True)
class RigidMotion:
    """Pose and velocities of a rigid body with their covariance: a filter with constant velocities on R3 x SO(3).

    Error state (12): [dt (m, world), dtheta (rad, body), dv (m/s, world), domega (rad/s, body)]. Source: ours; the
    error-state form of Sola (2017), "Quaternion kinematics for the error-state Kalman filter", sec. 5, without the
    inertial sensors.
    """

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

    @staticmethod
    def at_rest(pose: Pose, covariance: Array, sigma_m_s: float = 3.0, sigma_rad_s: float = 3.0) -> RigidMotion:
        """The initial state: a pose with covariance (6, 6), velocities of zero with wide sigmas."""
        P = np.zeros((12, 12))
        P[:6, :6] = covariance
        P[6:9, 6:9] = sigma_m_s**2 * np.eye(3)
        P[9:, 9:] = sigma_rad_s**2 * np.eye(3)
        return RigidMotion(pose, np.zeros(3), np.zeros(3), P)

    def predicted(self, dt_s: float, sigma_a_m_s2: float, sigma_a_rad_s2: float) -> RigidMotion:
        """The prediction over one time step, with white accelerations (1 sigma) that are constant within the step."""
        turn = self.rate * dt_s
        pose = self.world_from_body.plus(np.concatenate([self.velocity * dt_s, turn]))
        F = transition(dt_s, 6)
        F[3:6, 3:6] = rotations.exp(-turn)
        F[3:6, 9:] = dt_s * rotations.right_jacobian(turn)
        Q = process_noise(np.repeat([sigma_a_m_s2, sigma_a_rad_s2], 3), dt_s)
        return RigidMotion(pose, self.velocity, self.rate, symmetric(F @ self.P @ F.T + Q))

    def updated(self, y: Array, H: Array, R: Array) -> tuple[RigidMotion, Array]:
        """The update with a measurement; also the innovation covariance S (k, k).

        y (k,): innovation; H (k, 6): its Jacobian with respect to the pose; R (k, k): measurement covariance.
        """
        PH = self.P[:, :6] @ H.T
        S = H @ PH[:6] + R
        K = np.asarray(np.linalg.solve(S, PH.T).T, dtype=float)
        d = K @ y
        P = _joseph(self.P, K, K @ H, R)
        return RigidMotion(self.world_from_body.plus(d[:6]), self.velocity + d[6:9], self.rate + d[9:], P), S

    def updated_with_pose(self, pose: Pose, covariance: Array) -> tuple[RigidMotion, Array, Array]:
        """The update with a measured pose, covariance (6, 6); also the innovation (6,) and its covariance (6, 6)."""
        y = pose.minus(self.world_from_body)
        after, S = self.updated(y, np.eye(6), covariance)
        return after, y, S
