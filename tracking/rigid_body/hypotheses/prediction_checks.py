"""How well a predicted pose places the spots, and the limits up to which the prediction checks labels; compiled."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_projection import Views
from tracking.rigid_body.association.likelihood import predicted_pixel

MIN_REDUNDANT_SPOTS = 4  # fewer cannot contradict a pose: a lost vehicle looks like one that is mostly occluded
MIN_CONFIRMING_SPOTS = 3  # if so many lie in their narrow gates, the velocities have not jumped
# Limits of the 1-sigma prediction of a spot, px:
MAX_CHECKING_SIGMA_PX = 8.0  # up to here the prediction checks a label
MAX_TRACKING_SIGMA_PX = 15.0  # beyond it the whole picture is searched at once
MAX_THREE_SPOT_SIGMA_PX = 45.0  # beyond it three false points fit anywhere, too
SURE_PROBABILITY = 1 - 2.5e-3  # label probability (6 nats) that is required where nothing else checks a label


@compiled
def largest_spot_sigma(views: Views, R: Array, t: Array, P: Array, assigned: Ints) -> float:
    """Largest 1-sigma prediction, px, of the labelled spots at a pose (R, t) with its P (6 or more, square)."""
    uv, J = np.empty(2), np.empty((2, 6))
    largest = 0.0
    for i in range(assigned.shape[0]):
        if assigned[i] >= 0:
            projected, a, _, c = predicted_pixel(views, i, R, t, P, uv, J)
            largest = max(largest, 0.5 * (a + c)) if projected else np.inf
    return np.sqrt(largest)


@compiled
def unchecked_by_prediction(views: Views, R: Array, t: Array, P: Array, assigned: Ints) -> Bools:
    """(n,): labelled spots that a pose (R, t) with its P (6 or more) predicts worse than MAX_CHECKING_SIGMA_PX."""
    uv, J = np.empty(2), np.empty((2, 6))
    out = np.zeros(assigned.shape[0], np.bool_)
    for i in range(assigned.shape[0]):
        if assigned[i] >= 0:
            projected, a, _, c = predicted_pixel(views, i, R, t, P, uv, J)
            out[i] = not projected or 0.5 * (a + c) > MAX_CHECKING_SIGMA_PX * MAX_CHECKING_SIGMA_PX
    return out
