"""Kalman filter of a circle: Zhou (2014), eqs. (1) and (2), with white acceleration; and the form that is printed.

State (u, v, r) in px and their rates in px/frame. In the print Gamma lets noise act on the rates alone and Q is both
3 x 3 (eq. 6) and (1 - gamma) I of 6 x 6 (section 2.2), which differ by a factor of 5e4. Here Gamma = [dt^2/2; dt] and Q
is 3 x 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from geometry.arrays import Array, symmetric
from tracking.kalman import innovation, process_noise, propagate, transition, update

PRINTED_P0 = np.diag([50.0, 20.0, 5.0, 50.0, 20.0, 5.0]) ** 2 / 9  # eq. (3)


@dataclass(frozen=True, slots=True)
class MotionModel:
    """How one filter of the bank expects the circle to move; states with accelerations (9,)."""

    acceleration_px: tuple[float, ...]  # (3,) px/frame^2, 1 sigma, white; zero where the acceleration is a state
    jerk_px: tuple[float, ...]  # (3,) px/frame^3, 1 sigma, white; zero where the acceleration is white

    def transition(self, dt: float) -> Array:
        """Phi (9, 9). Where the acceleration is white, its state stays zero."""
        phi = np.zeros((9, 9))
        phi[:6, :6] = transition(dt, 3)
        if any(self.jerk_px):
            phi[:3, 6:], phi[3:6, 6:], phi[6:, 6:] = 0.5 * dt**2 * np.eye(3), dt * np.eye(3), np.eye(3)
        return phi

    def noise(self, dt: float) -> Array:
        """Q (9, 9), of values that are constant within a step."""
        Q = np.zeros((9, 9))
        Q[:6, :6] = process_noise(np.array(self.acceleration_px), dt)
        gamma = np.concatenate([dt**3 / 6 * np.eye(3), 0.5 * dt**2 * np.eye(3), dt * np.eye(3)])
        return Q + gamma @ np.diag(np.square(self.jerk_px)) @ gamma.T


@dataclass(frozen=True, slots=True)
class FilterBank:
    """Kalman filters with different motions, weighted by their likelihood (Magill 1965, IEEE Trans. AC-10).

    The acceleration of the target is unknown. A filter with too much of it has noisy rates, which matter when the
    target is occluded; one with too little follows late. A steady acceleration, as of a pendulum, is followed by the
    filters that have it as a state: in eight hidden frames constant rates miss a pendulum by several pixels.
    """

    x: Array  # (n, 9): u, v, r, rates, accelerations
    P: Array  # (n, 9, 9)
    log_weight: Array  # (n,) natural logarithms, largest 0
    models: tuple[MotionModel, ...]

    @classmethod
    def started(cls, z: Array, R: Array, rate_sigma_px: float, models: tuple[MotionModel, ...]) -> FilterBank:
        """A bank at a first circle z (3,) with covariance R, at rest within rate_sigma_px (px/frame)."""
        n, third = len(models), np.array([1.0, 1.0, 0.15])
        P = np.zeros((n, 9, 9))
        P[:, :3, :3] = R
        P[:, 3:6, 3:6] = np.diag((rate_sigma_px * third) ** 2)
        for i, model in enumerate(models):
            if any(model.jerk_px):
                P[i, 6:, 6:] = np.diag((0.1 * rate_sigma_px * third) ** 2)
        return cls(np.tile(np.concatenate([z, np.zeros(6)]), (n, 1)), P, np.zeros(n), models)

    def predicted(self, dt: float) -> FilterBank:
        """The bank dt frames later."""
        phi, Q = _stacked(self.models, dt)
        x, P = propagate(self.x, self.P, phi, Q)
        return FilterBank(x, symmetric(P), self.log_weight, self.models)

    def updated(self, z: Array, R: Array, forgetting: float) -> FilterBank:
        """The bank after a measured circle. forgetting: factor of the earlier log likelihoods."""
        _, S, d2 = innovation(self.x, self.P, z, R)
        log_weight = forgetting * self.log_weight - 0.5 * (d2 + np.linalg.slogdet(S)[1])
        x, P = update(self.x, self.P, z, R)
        return FilterBank(x, P, log_weight - log_weight.max(), self.models)

    def state(self) -> tuple[Array, Array]:
        """Mean (6,) and covariance (6, 6) of the mixture: centre, radius and rates."""
        share = np.exp(self.log_weight)
        share = share / share.sum()
        x = self.x[:, :6]
        mean = share @ x
        away = x - mean
        P = np.tensordot(share, self.P[:, :6, :6], 1) + (share[:, None] * away).T @ away
        return mean, symmetric(P)

    def distance2(self, z: Array, R: Array, any_model: bool = False) -> float:
        """Squared Mahalanobis distance of a circle from the prediction; any_model: from the nearest filter's."""
        if any_model:
            return float(innovation(self.x, self.P, z, R)[2].min())
        x, P = self.state()
        return float(innovation(x, P, z, R)[2])


def motion_models(
    accelerations_px: tuple[float, ...], jerks_px: tuple[float, ...], radius_share: float
) -> tuple[MotionModel, ...]:
    """One model for each acceleration and each jerk of the centre; those of the radius are a share of them."""
    white = [MotionModel((a, a, a * radius_share), (0.0, 0.0, 0.0)) for a in accelerations_px]
    return (*white, *(MotionModel((0.0, 0.0, 0.0), (j, j, j * radius_share)) for j in jerks_px))


@lru_cache(maxsize=16)
def _stacked(models: tuple[MotionModel, ...], dt: float) -> tuple[Array, Array]:
    """Phi and Q (n, 9, 9) of all models; they are the same in most frames."""
    return np.array([m.transition(dt) for m in models]), np.array([m.noise(dt) for m in models])


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
    x, P = propagate(x, P, transition(dt, 3), (1 - gamma) * np.eye(6) if measured else np.zeros((6, 6)))
    return update(x, P, z, gamma * np.eye(3)) if measured and z is not None else (x, P)
