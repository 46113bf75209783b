"""Kalman filters of positions with white acceleration, for many filters at once: of spots (u, v), circles (u, v, r).

State (..., n): m positions, m rates, and what else a filter has. Measured are the m positions: H = [I 0].
Source: Huo, Yang & Yang 2015, eqs. (1) to (6). The paper calls the transition matrix H and the observation matrix F;
here they have their usual letters, F and (implicitly) H.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, symmetric


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
    keep = np.broadcast_to(np.eye(x.shape[-1]), P.shape).copy()
    keep[..., :, :m] -= K
    P_new = keep @ P @ np.swapaxes(keep, -1, -2) + K @ R @ np.swapaxes(K, -1, -2)
    return x + (K @ y[..., None])[..., 0], symmetric(P_new)


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
