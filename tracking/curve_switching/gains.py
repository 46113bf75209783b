"""The gains g1, g2, g3 that rate how well a detection continues a track.

Source: Huo, Yang & Yang 2015, eqs. (7), (8), (9); g2 after Sethi & Jain 1987. The well-defined forms: vector lengths
have a floor (at zero displacement (8) and (9) are 0/0), and g1 may be divided by the search radius (over the picture's
diagonal it changes by 0.006 in 10 px and decides nothing).
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array


def nearness(predicted: Array, candidates: Array, scale_px: Array | float, p_norm: float = 2.0) -> Array:
    """g1, eq. (7): 1 - |candidate - predicted|_p / scale, (...). Points (..., 2), px. 1 on the prediction."""
    gap = np.sum(np.abs(candidates - predicted) ** p_norm, axis=-1) ** (1 / p_norm)
    return 1 - gap / np.asarray(scale_px)


def picture_scale(image_size_px: Array, p_norm: float = 2.0) -> Array:
    """The paper's denominator of eq. (7): the p-norm of (Sx, Sy), px. Its sqrt(Sx^p + Sy^p) is that for p = 2 only."""
    return np.asarray(np.sum(np.abs(image_size_px) ** p_norm, axis=-1) ** (1 / p_norm))


def direction_and_speed(last: Array, predicted: Array, candidates: Array, min_vector_px: float) -> tuple[Array, Array]:
    """The two halves of eq. (8) for points (..., 2), px: likeness of direction, and of speed, each in [0, 1].

    1/2 + cos/2 of the angle between the predicted and the observed displacement, and the ratio of the geometric to the
    arithmetic mean of their lengths. Below `min_vector_px` a displacement has no direction: 1 for two such.
    """
    ahead, seen = predicted - last, candidates - last
    long_a = np.linalg.norm(ahead, axis=-1)
    long_s = np.linalg.norm(seen, axis=-1)
    floor_a, floor_s = np.maximum(long_a, min_vector_px), np.maximum(long_s, min_vector_px)
    # Shorter than the floor, the vector counts as partly along the other one: the cosine goes to 1, not to 0.
    cosine = np.sum(ahead * seen, axis=-1) / (floor_a * floor_s)
    cosine = cosine + (1 - long_a / floor_a) + (1 - long_s / floor_s)
    direction = 0.5 + 0.5 * np.clip(cosine, -1.0, 1.0)
    speed = 2 * np.sqrt(floor_a * floor_s) / (floor_a + floor_s)
    return direction, speed


def smoothness(last: Array, predicted: Array, candidates: Array, alpha: float, min_vector_px: float) -> Array:
    """g2, eq. (8), (...): alpha of the direction, 1 - alpha of the speed."""
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
    """g3, eq. (9), (...), with the weights divided by their sum: step 2 sets the first to 0, then they do not add up.

    last, predicted, candidates (..., 2), px: where the spot was, should be, and might be.
    """
    w1, w2, w3 = np.asarray(weights, dtype=float) / sum(weights)
    direction, speed = direction_and_speed(last, predicted, candidates, min_vector_px)
    g = w2 * direction + w3 * speed
    if w1:
        g = g + w1 * nearness(predicted, candidates, scale_px, p_norm)
    return g
