"""The gains g1, g2, g3: scores of how well a detection continues a track.

Source: Huo, Yang & Yang 2015, eqs. (7), (8), (9); g2 after Sethi & Jain 1987. Two changes make them well defined:
vector lengths have a floor, because (8) and (9) are 0/0 at zero displacement, and g1 may be divided by the search
radius, because divided by the image diagonal it changes by only 0.006 per 10 px and does not affect the result.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, symmetric


def nearness(predicted: Array, candidates: Array, scale_px: Array | float, p_norm: float = 2.0) -> Array:
    """g1, eq. (7): 1 - |candidate - predicted|_p / scale, (...); 1 at the prediction. Points (..., 2), px.

    scale_px: the denominator, the image diagonal (`picture_scale`, the paper) or the search radius r1 (ours).
    """
    gap = np.sum(np.abs(candidates - predicted) ** p_norm, axis=-1) ** (1 / p_norm)
    return 1 - gap / np.asarray(scale_px)


def picture_scale(image_size_px: Array, p_norm: float = 2.0) -> Array:
    """The denominator of eq. (7): the p-norm of the image size (Sx, Sy), px, (...).

    The paper prints sqrt(Sx^p + Sy^p), which is the p-norm for p = 2 only.
    """
    return np.asarray(np.sum(np.abs(image_size_px) ** p_norm, axis=-1) ** (1 / p_norm))


def direction_and_speed(last: Array, predicted: Array, candidates: Array, min_vector_px: float) -> tuple[Array, Array]:
    """The two terms of eq. (8), each (...) in [0, 1]: similarity of direction and similarity of speed.

    The direction term is 1/2 + cos/2 of the angle between the predicted and the observed displacement; the speed term
    is the ratio of the geometric to the arithmetic mean of their lengths. Points (..., 2), px. Displacements shorter
    than `min_vector_px` (ours) have no direction: two such displacements have a direction term of 1.
    """
    expected, observed = predicted - last, candidates - last
    length_e = np.linalg.norm(expected, axis=-1)
    length_o = np.linalg.norm(observed, axis=-1)
    floored_e, floored_o = np.maximum(length_e, min_vector_px), np.maximum(length_o, min_vector_px)
    # A vector shorter than the floor counts as partly parallel to the other one: the cosine tends to 1, not to 0.
    cosine = np.sum(expected * observed, axis=-1) / (floored_e * floored_o)
    cosine = cosine + (1 - length_e / floored_e) + (1 - length_o / floored_o)
    direction = 0.5 + 0.5 * np.clip(cosine, -1.0, 1.0)
    speed = 2 * np.sqrt(floored_e * floored_o) / (floored_e + floored_o)
    return direction, speed


def smoothness(last: Array, predicted: Array, candidates: Array, alpha: float, min_vector_px: float) -> Array:
    """g2, eq. (8), (...): the direction term weighted by alpha, the speed term by 1 - alpha. Points (..., 2), px."""
    direction, speed = direction_and_speed(last, predicted, candidates, min_vector_px)
    return alpha * direction + (1 - alpha) * speed


def combined(
    last: Array,
    predicted: Array,
    candidates: Array,
    weights: tuple[float, float, float],
    scale_px: Array | float,
    min_vector_px: float,
    p_norm: float = 2.0,
) -> Array:
    """g3, eq. (9), (...): the weighted sum of g1 and the two terms of eq. (8).

    last, predicted, candidates (..., 2), px: the spot's last position, its predicted position and the detections.
    weights: omega1, omega2, omega3. They are divided by their sum (ours): matching step 2 sets omega1 to 0, and the
    paper's weights then no longer add up to 1.
    """
    w1, w2, w3 = np.asarray(weights, dtype=float) / sum(weights)
    direction, speed = direction_and_speed(last, predicted, candidates, min_vector_px)
    g = w2 * direction + w3 * speed
    if w1:
        g = g + w1 * nearness(predicted, candidates, scale_px, p_norm)
    return g


# The constant-velocity Kalman filter of one spot in one image, for many spots at once.
#
# State (..., 4): u, v, px, and their rates, px/s. Source: Huo, Yang & Yang 2015, eqs. (1) to (6). The paper calls the
# transition matrix H and the observation matrix F; here they have their usual letters, F and (implicitly, [I 0]) H.


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
