"""The gains g1, g2, g3: scores of how well a detection continues a track.

Source: Huo, Yang & Yang 2015, eqs. (7), (8), (9); g2 after Sethi & Jain 1987. Two changes make them well defined:
vector lengths have a floor, because (8) and (9) are 0/0 at zero displacement, and g1 may be divided by the search
radius, because divided by the image diagonal it changes by only 0.006 per 10 px and does not affect the result.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array


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
