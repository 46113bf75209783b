"""The constant-velocity Kalman filter of one spot in its picture, for many spots at once.

State (..., 4): u, v, px, and their rates, px/s. Source: Huo, Yang & Yang 2015, eqs. (1) to (6). The paper calls the
transition H and the observation F; here they have their usual letters, F and (implicitly, [I 0]) H.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, symmetric


def transition(dt_s: float) -> Array:
    """F (4, 4) of eq. (1) for a step of dt_s."""
    F = np.eye(4)
    F[0, 2] = F[1, 3] = dt_s
    return F


def process_noise(sigma_a_px_s2: Array, dt_s: float) -> Array:
    """Q (..., 4, 4) of eq. (2): accelerations (...), px/s^2, that are constant within a frame and new in each."""
    a2 = np.asarray(sigma_a_px_s2, dtype=float)[..., None, None] ** 2
    pp, pv, vv = dt_s**4 / 4, dt_s**3 / 2, dt_s**2
    shape = np.array([[pp, 0, pv, 0], [0, pp, 0, pv], [pv, 0, vv, 0], [0, pv, 0, vv]])
    return a2 * shape


def predict(x: Array, P: Array, dt_s: float, sigma_a_px_s2: Array) -> tuple[Array, Array]:
    """Eqs. (1) and (2): states (..., 4) and covariances (..., 4, 4) one step on."""
    F = transition(dt_s)
    return x @ F.T, F @ P @ F.T + process_noise(sigma_a_px_s2, dt_s)


def innovation(x: Array, P: Array, z: Array, R: Array) -> tuple[Array, Array, Array]:
    """What positions z (..., 2), px, with covariances R (..., 2, 2) add: y = z - Hx, its covariance S, and y S^-1 y."""
    y = z - x[..., :2]
    S = P[..., :2, :2] + R
    nis = np.sum(y * np.linalg.solve(S, y[..., None])[..., 0], axis=-1)
    return y, S, nis


def update(x: Array, P: Array, z: Array, R: Array) -> tuple[Array, Array]:
    """Eqs. (3) to (5), the covariance in Joseph's form, which rounding cannot make negative."""
    y, S, _ = innovation(x, P, z, R)
    K = P[..., :, :2] @ np.linalg.inv(S)
    keep = np.broadcast_to(np.eye(4), P.shape).copy()
    keep[..., :, :2] -= K
    P_new = keep @ P @ np.swapaxes(keep, -1, -2) + K @ R @ np.swapaxes(K, -1, -2)
    return x + (K @ y[..., None])[..., 0], symmetric(P_new)


def restart(z: Array, R: Array, last: Array, R_last: Array, dt_s: Array | float) -> tuple[Array, Array]:
    """Eq. (6) at a bend: position z and velocity from the last position, both (..., 2), with covariances (..., 2, 2).

    The paper leaves the rate and the covariance open; here the rate is (z - last) / dt, with dt the time between the
    two, and the covariance follows: R, R/dt, (R + R_last)/dt^2.
    """
    dt = np.asarray(dt_s, dtype=float)
    x = np.concatenate([z, (z - last) / dt[..., None]], axis=-1)
    P = np.empty((*z.shape[:-1], 4, 4))
    step = dt[..., None, None]
    P[..., :2, :2] = R
    P[..., :2, 2:] = P[..., 2:, :2] = R / step
    P[..., 2:, 2:] = (R + R_last) / step**2
    return x, P
