"""Pruning and merging of hypotheses, label probabilities, and the spread between the hypotheses' poses; compiled."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_linalg import best_first, pose_minus
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.rigid_body.hypotheses.hypothesis_set import (
    Children,
    Hypotheses,
    empty_hypotheses,
    set_hypothesis,
    state_of,
)

MAX_HYPOTHESES = 8  # kept from frame to frame
PRUNE_NATS = 12.0  # a hypothesis that is this much less likely than the best is dropped
MERGE_SIGMAS = 0.7  # hypotheses with one assignment are merged if their states differ by less than this
MIN_SPREAD_PROBABILITY = 1e-3  # less probable hypotheses do not widen the covariance, however far away they are


@compiled
def prune_and_merge(children: Children, count: int) -> tuple[Hypotheses, Ints, Array, Array]:
    """Prune and merge the children: the hypotheses that remain, best first.

    Also returns their indices (h,) among the children, the probability (n,) of the best child's choice for each view,
    and the spread (6, 6) of the other children's poses about the best child's, which is to be added to its covariance.
    """
    w = children.hypotheses.log_weight[:count]
    n = children.assigned.shape[1]
    order = best_first(w)
    best = order[0]
    share = np.empty(count)
    total = 0.0
    for k in range(count):
        share[k] = np.exp(w[k] - w[best])
        total += share[k]
    probability, spread = np.zeros(n), np.zeros((6, 6))
    a = children.hypotheses
    for k in range(count):
        p = share[k] / total
        for i in range(n):
            if children.assigned[k, i] % BLENDED == children.assigned[best, i] % BLENDED:
                probability[i] += p
        if k != best and p > MIN_SPREAD_PROBABILITY:
            d = pose_minus(a.R[k], a.t[k], a.R[best], a.t[best])
            for i in range(6):
                for j in range(6):
                    spread[i, j] += p * d[i] * d[j]
    kept, log_weight = np.empty(MAX_HYPOTHESES, np.int64), np.empty(MAX_HYPOTHESES)
    h = 0
    for place in range(count):
        k = order[place]
        if w[k] < w[best] - PRUNE_NATS:
            break
        twin = -1
        for other in range(h):
            if _equivalent(children, k, kept[other]):
                twin = other
                break
        if twin >= 0:
            log_weight[twin] = np.log(np.exp(log_weight[twin]) + share[k] / total)
        elif h < MAX_HYPOTHESES:
            kept[h], log_weight[h] = k, w[k] - w[best] - np.log(total)
            h += 1
    largest = -np.inf
    for i in range(h):
        largest = max(largest, log_weight[i])
    out = empty_hypotheses(h, a.p_visible.shape[1])
    for i in range(h):
        k = kept[i]
        set_hypothesis(out, i, state_of(a, k), log_weight[i] - largest, a.p_visible[k])
    return out, kept[:h], probability, spread


@compiled
def unweighted_spread(children: Children, kept: Ints) -> Array:
    """Spread (6, 6) of the kept children's poses about the best one's, as if all were equally likely.

    For a pose whose labels are not confirmed: with it the covariance covers all hypotheses.
    """
    out = np.zeros((6, 6))
    a, best = children.hypotheses, kept[0]
    for place in range(1, kept.shape[0]):
        k = kept[place]
        d = pose_minus(a.R[k], a.t[k], a.R[best], a.t[best])
        for i in range(6):
            for j in range(6):
                out[i, j] += d[i] * d[j]
    return out


@compiled
def _equivalent(children: Children, k: int, o: int) -> bool:
    """Whether two children have the same assignment and nearly the same state."""
    for i in range(children.assigned.shape[1]):
        if children.assigned[k, i] != children.assigned[o, i]:
            return False
    a = children.hypotheses
    d = pose_minus(a.R[k], a.t[k], a.R[o], a.t[o])
    for i in range(6):
        if abs(d[i]) > MERGE_SIGMAS * np.sqrt(a.P[o, i, i]):
            return False
        if abs(a.m[k, i] - a.m[o, i]) > MERGE_SIGMAS * np.sqrt(a.P[o, 6 + i, 6 + i]):
            return False
    return True
