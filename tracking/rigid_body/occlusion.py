"""Whether spots are hidden, compiled: each by itself, or a screen's spots together.

A spot shines on its screen if nothing stands before the screen (its group is lit) and nothing before the spot itself
(it is shown). Both are two-state Markov chains; their probabilities are carried from frame to frame and make the chance
that a spot is detected. Without the groups, a false point in a blackout would be one returning spot after the other.
Source: ours.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compilation.jit import compiled

HIDES, SHOWS = 0.01, 0.15  # per frame: a shown spot becomes hidden, a hidden one shows: hidings last some frames
DARKENS, LIGHTS = 0.005, 0.15  # the same of a whole screen
BLACKOUT = 0.004  # per frame: all screens go dark at once
MISSED = -1


@compiled
def predict(chances: Array, n: int) -> Array:
    """Probabilities (n + groups,) of being shown (the first n) and lit (the others) a frame later."""
    out = np.empty_like(chances)
    for i in range(chances.shape[0]):
        p = chances[i]
        out[i] = p * (1 - HIDES) + (1 - p) * SHOWS if i < n else p * (1 - DARKENS) + (1 - p) * LIGHTS
    return out


@compiled
def marginal(chances: Array, group: Ints) -> Array:
    """The probability (n,) of each spot to shine."""
    n = group.shape[0]
    out = np.empty(n)
    for i in range(n):
        out[i] = chances[i] * chances[n + group[i]]
    return out


@compiled
def joint_log_likelihood(chances: Array, group: Ints, assigned: Ints, detect: float) -> float:
    """What an assignment's log-likelihood gains because spots of a group go dark together, nats.

    Against the product of the single marginals, which the search takes.
    """
    n = group.shape[0]
    total = product = 0.0
    for g in range(chances.shape[0] - n):
        lit = chances[n + g]
        joint, apart, none = 1.0, 1.0, True
        for i in range(n):
            if group[i] != g or assigned[i] < MISSED:
                continue
            p = detect * chances[i]
            if assigned[i] >= 0:
                none = False
                joint *= p
                apart *= p * lit
            else:
                joint *= 1 - p
                apart *= 1 - p * lit
        total += np.log(lit * joint + (1 - lit if none else 0.0))
        product += np.log(apart)
    if _nothing(assigned):
        total = np.log(np.exp(total) + BLACKOUT)
    return total - product


@compiled
def _nothing(assigned: Ints) -> bool:
    """Whether spots were looked for and none was found."""
    looked_for = False
    for a in assigned:
        if a >= 0:
            return False
        looked_for |= a == MISSED
    return looked_for


@compiled
def update(chances: Array, group: Ints, assigned: Ints, detect: float) -> Array:
    """The probabilities (n + groups,) after a frame with this assignment (n,)."""
    n = group.shape[0]
    out = chances.copy()
    dark = BLACKOUT if _nothing(assigned) else 0.0
    for g in range(chances.shape[0] - n):
        lit = chances[n + g]
        joint, looked_for, none = 1.0, False, True
        for i in range(n):
            if group[i] == g and assigned[i] >= MISSED:
                looked_for = True
                none = none and assigned[i] < 0
                joint *= detect * chances[i] if assigned[i] >= 0 else 1 - detect * chances[i]
        after = 1.0
        if none and looked_for:
            after = lit * joint / (lit * joint + 1 - lit + dark)
        elif not looked_for:
            after = lit
        out[n + g] = min(max(after, 1e-6), 1 - 1e-6)
        for i in range(n):
            if group[i] != g or assigned[i] < MISSED:
                continue
            p = chances[i]
            if assigned[i] >= 0:
                out[i] = 1 - 1e-6
            else:  # missed in the light, or nothing learnt in the dark
                out[i] = after * p * (1 - detect) / (p * (1 - detect) + 1 - p) + (1 - after) * p
    return out
