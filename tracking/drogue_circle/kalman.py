"""Kalman filter of a circle: Zhou (2014), eqs. (1) and (2), with white acceleration; and the form that is printed.

State (u, v, r) in px and their rates in px/frame. In the print Gamma lets noise act on the rates alone and Q is both
3 x 3 (eq. 6) and (1 - gamma) I of 6 x 6 (section 2.2), which differ by a factor of 5e4. Here Gamma = [dt^2/2; dt] and Q
is 3 x 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, symmetric

PRINTED_P0 = np.diag([50.0, 20.0, 5.0, 50.0, 20.0, 5.0]) ** 2 / 9  # eq. (3)
PRINTED_Q, PRINTED_R = 2e-5, 1e-3  # eq. (6): initial values


def transition(dt: float) -> Array:
    """Phi of eq. (1), (6, 6). dt: frames."""
    phi = np.eye(6)
    phi[:3, 3:] = dt * np.eye(3)
    return phi


def process_noise(dt: float, acceleration_px: Array) -> Array:
    """Gamma Q Gamma' (..., 6, 6) of accelerations (..., 3), px/frame^2, 1 sigma, constant within a step."""
    gamma = np.concatenate([0.5 * dt**2 * np.eye(3), dt * np.eye(3)])
    q = np.asarray(acceleration_px, dtype=float)[..., None, :] ** 2 * np.eye(3)
    return np.asarray(gamma @ q @ gamma.T)


def predict(x: Array, P: Array, phi: Array, Q: Array) -> tuple[Array, Array]:
    """Prediction of states (..., 6) and covariances (..., 6, 6)."""
    return (phi @ x[..., None])[..., 0], symmetric(phi @ P @ phi.T + Q)


def update(x: Array, P: Array, z: Array, R: Array) -> tuple[Array, Array]:
    """Update by a circle z (3,) with covariance R (3, 3), H = [I 0], Joseph form, of stacked states."""
    S = P[..., :3, :3] + R
    K = np.swapaxes(np.linalg.solve(S, np.swapaxes(P[..., :, :3], -1, -2)), -1, -2)
    x = x + (K @ (z - x[..., :3])[..., None])[..., 0]
    keep = np.eye(6) - np.concatenate([K, np.zeros_like(K)], axis=-1)
    P = keep @ P @ np.swapaxes(keep, -1, -2) + K @ R @ np.swapaxes(K, -1, -2)
    return x, symmetric(P)


def distance2(x: Array, P: Array, z: Array, R: Array) -> tuple[Array, Array]:
    """Squared Mahalanobis distance (...,) of a circle from predictions, and log det S / 2 + distance^2 / 2."""
    S = P[..., :3, :3] + R
    away = z - x[..., :3]
    d2 = np.sum(away * np.linalg.solve(S, away[..., None])[..., 0], axis=-1)
    return d2, 0.5 * (d2 + np.linalg.slogdet(S)[1])


@dataclass(frozen=True, slots=True)
class FilterBank:
    """Kalman filters with different accelerations, weighted by their likelihood (Magill 1965, IEEE Trans. AC-10).

    The acceleration of the target is unknown. A filter with too much of it has noisy rates, which matter when the
    target is occluded; one with too little follows late.
    """

    x: Array  # (n, 6)
    P: Array  # (n, 6, 6)
    log_weight: Array  # (n,) natural logarithms, largest 0
    acceleration_px: Array  # (n, 3) px/frame^2

    @classmethod
    def started(
        cls, z: Array, R: Array, rate_sigma_px: float, accelerations_px: tuple[float, ...], radius_share: float
    ) -> FilterBank:
        """A bank at a first circle z (3,) with covariance R, at rest within rate_sigma_px (px/frame)."""
        n = len(accelerations_px)
        P = np.zeros((6, 6))
        P[:3, :3] = R
        P[3:, 3:] = np.diag([rate_sigma_px, rate_sigma_px, max(radius_share, 0.1) * rate_sigma_px]) ** 2
        q = np.outer(accelerations_px, [1.0, 1.0, radius_share])
        return cls(np.tile(np.concatenate([z, np.zeros(3)]), (n, 1)), np.tile(P, (n, 1, 1)), np.zeros(n), q)

    def predicted(self, dt: float) -> FilterBank:
        """The bank dt frames later."""
        x, P = predict(self.x, self.P, transition(dt), process_noise(dt, self.acceleration_px))
        return FilterBank(x, P, self.log_weight, self.acceleration_px)

    def updated(self, z: Array, R: Array, forgetting: float) -> FilterBank:
        """The bank after a measured circle. forgetting: factor of the earlier log likelihoods."""
        log_weight = forgetting * self.log_weight - distance2(self.x, self.P, z, R)[1]
        x, P = update(self.x, self.P, z, R)
        return FilterBank(x, P, log_weight - log_weight.max(), self.acceleration_px)

    def state(self) -> tuple[Array, Array]:
        """Mean (6,) and covariance (6, 6) of the mixture."""
        share = np.exp(self.log_weight)
        share = share / share.sum()
        mean = share @ self.x
        away = self.x - mean
        spread = np.einsum("n,ni,nj->ij", share, away, away)
        return mean, symmetric(np.einsum("n,nij->ij", share, self.P) + spread)


def printed_coefficient(area: float, previous_area: float) -> float:
    """gamma of eq. (4) from the areas of this frame and the one before. 1 where the area before is zero."""
    if previous_area <= 0:
        return 1.0
    return float(min(abs(area / previous_area - 1), 1.0))


def printed_step(x: Array, P: Array, dt: float, z: Array | None, gamma: float, beta: float) -> tuple[Array, Array]:
    """One step of section 2.2 as printed: R = gamma I, Q = (1 - gamma) I, or prediction alone with Q = 0.

    z None: nothing was measured, as for gamma >= beta.
    """
    measured = z is not None and gamma < beta
    x, P = predict(x, P, transition(dt), (1 - gamma) * np.eye(6) if measured else np.zeros((6, 6)))
    return update(x, P, z, gamma * np.eye(3)) if measured and z is not None else (x, P)
