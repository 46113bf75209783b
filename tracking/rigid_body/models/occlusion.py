"""Occlusion model, compiled: spots are occluded one by one, or all spots of a screen together.

A spot is visible if nothing occludes its screen (its group) and nothing occludes the spot itself. Each screen and each
spot has a two-state Markov chain; `p_visible` (n + groups,) holds the probabilities of the visible states, first of the
n views' spots, then of the groups. Multiplied by the probability of detection they predict whether a spot is detected.
Without the groups a false point during a blackout would be taken for one spot that reappears, frame after frame.
Source: ours.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compilation.jit import compiled

# Transition probabilities per frame. Occlusions last some frames.
P_OCCLUDE, P_REAPPEAR = 0.01, 0.15  # of one spot: visible to occluded, occluded to visible
P_SCREEN_OCCLUDE, P_SCREEN_REAPPEAR = 0.005, 0.15  # of a whole screen
P_BLACKOUT = 0.004  # all screens become occluded in the same frame
MISSED = -1  # in an assignment: the spot was searched for and not found


@compiled
def predict(p_visible: Array, n: int) -> Array:
    """Probabilities (n + groups,) one frame later: one step of the Markov chains."""
    out = np.empty_like(p_visible)
    for i in range(p_visible.shape[0]):
        p = p_visible[i]
        if i < n:
            out[i] = p * (1 - P_OCCLUDE) + (1 - p) * P_REAPPEAR
        else:
            out[i] = p * (1 - P_SCREEN_OCCLUDE) + (1 - p) * P_SCREEN_REAPPEAR
    return out


@compiled
def marginal(p_visible: Array, group: Ints) -> Array:
    """Marginal probability (n,) that each view's spot is not occluded; group (n,): index of its screen."""
    n = group.shape[0]
    out = np.empty(n)
    for i in range(n):
        out[i] = p_visible[i] * p_visible[n + group[i]]
    return out


@compiled
def joint_log_likelihood(p_visible: Array, group: Ints, assigned: Ints, p_detect: Array) -> float:
    """Log-likelihood of an assignment's detections and misses, nats, with the common occlusion of each screen's spots.

    assigned (n,): as in association; p_detect (n,): probability of detection of each spot if it is visible.
    """
    n = group.shape[0]
    joint_sum = 0.0
    for g in range(p_visible.shape[0] - n):
        p_screen = p_visible[n + g]
        joint, none = 1.0, True
        for i in range(n):
            if group[i] != g or assigned[i] < MISSED:
                continue
            p = p_detect[i] * p_visible[i]
            none = none and assigned[i] < 0
            joint *= p if assigned[i] >= 0 else 1 - p
        joint_sum += np.log(p_screen * joint + (1 - p_screen if none else 0.0))
    return np.log(np.exp(joint_sum) + P_BLACKOUT) if _nothing_found(assigned) else joint_sum


@compiled
def _nothing_found(assigned: Ints) -> bool:
    """Whether spots were searched for and none was found."""
    searched = False
    for a in assigned:
        if a >= 0:
            return False
        searched |= a == MISSED
    return searched


@compiled
def update(p_visible: Array, group: Ints, assigned: Ints, p_detect: Array) -> Array:
    """Posterior probabilities (n + groups,) after a frame with this assignment (n,): Bayes' rule.

    p_detect (n,): as in `joint_log_likelihood`.
    """
    n = group.shape[0]
    out = p_visible.copy()
    p_blackout = P_BLACKOUT if _nothing_found(assigned) else 0.0
    for g in range(p_visible.shape[0] - n):
        p_screen = p_visible[n + g]
        joint, searched, none = 1.0, False, True
        for i in range(n):
            if group[i] == g and assigned[i] >= MISSED:
                searched = True
                none = none and assigned[i] < 0
                joint *= p_detect[i] * p_visible[i] if assigned[i] >= 0 else 1 - p_detect[i] * p_visible[i]
        after = 1.0
        if none and searched:
            after = p_screen * joint / (p_screen * joint + 1 - p_screen + p_blackout)
        elif not searched:
            after = p_screen
        out[n + g] = min(max(after, 1e-6), 1 - 1e-6)
        for i in range(n):
            if group[i] != g or assigned[i] < MISSED:
                continue
            p = p_visible[i]
            if assigned[i] >= 0:
                out[i] = 1 - 1e-6
            else:  # missed although the screen is visible, or no information because the screen is occluded
                unseen = p * (1 - p_detect[i])
                out[i] = after * unseen / (unseen + 1 - p) + (1 - after) * p
    return out
