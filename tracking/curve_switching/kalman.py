"""The constant-velocity Kalman filter of one spot in one image, for many spots at once.

State (..., 4): u, v, px, and their rates, px/s. Source: Huo, Yang & Yang 2015, eqs. (1) to (6). The paper calls the
transition matrix H and the observation matrix F; here they have their usual letters, F and (implicitly, [I 0]) H.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, symmetric


def transition(dt_s: float) -> Array:
    """The transition matrix F (4, 4) of eq. (1) for a time step dt_s."""
    F = np.eye(4)
    F[0, 2] = F[1, 3] = dt_s
    return F


def process_noise(sigma_a_px_s2: Array, dt_s: float) -> Array:
    """The process noise Q (..., 4, 4) of eq. (2), with the 1-sigma acceleration (...), px/s^2.

    The acceleration is white noise that is constant within a frame and independent between frames.
    """
    a2 = np.asarray(sigma_a_px_s2, dtype=float)[..., None, None] ** 2
    pp, pv, vv = dt_s**4 / 4, dt_s**3 / 2, dt_s**2
    shape = np.array([[pp, 0, pv, 0], [0, pp, 0, pv], [pv, 0, vv, 0], [0, pv, 0, vv]])
    return a2 * shape


def predict(x: Array, P: Array, dt_s: float, sigma_a_px_s2: Array) -> tuple[Array, Array]:
    """Eqs. (1) and (2): states (..., 4) and covariances (..., 4, 4) predicted over one time step."""
    F = transition(dt_s)
    return x @ F.T, F @ P @ F.T + process_noise(sigma_a_px_s2, dt_s)


def innovation(x: Array, P: Array, z: Array, R: Array) -> tuple[Array, Array, Array]:
    """The innovation y = z - Hx (..., 2) of eq. (4), its covariance S (..., 2, 2) of eq. (3), and y^T S^-1 y (...).

    z (..., 2), px: measured positions; R (..., 2, 2), px^2: their covariances.
    """
    y = z - x[..., :2]
    S = P[..., :2, :2] + R
    nis = np.sum(y * np.linalg.solve(S, y[..., None])[..., 0], axis=-1)
    return y, S, nis


def update(x: Array, P: Array, z: Array, R: Array) -> tuple[Array, Array]:
    """Eqs. (3), gain, (4), state, and (5), covariance: the update with positions z (..., 2), px, covariances R, px^2.

    The covariance has Joseph's form instead of the paper's (I - KH) P: rounding errors cannot make it indefinite.
    """
    y, S, _ = innovation(x, P, z, R)
    K = P[..., :, :2] @ np.linalg.inv(S)
    keep = np.broadcast_to(np.eye(4), P.shape).copy()
    keep[..., :, :2] -= K
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
