"""The hypotheses of a frame and their children: types, checks of predictions, pruning and merging; compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_linalg import best_first, copy_into, copy_matrix_into, pose_minus
from geometry.compiled_projection import Views
from tracking.rigid_body.association.frame_detections import BLENDED, predicted_pixel
from tracking.rigid_body.models.motion import STATE

MAX_CHILDREN = 48  # of one frame, over all hypotheses


class State(NamedTuple):
    """A vehicle state with its covariance, as in tracking/rigid_body/models/motion.py."""

    R: Array  # (3, 3)
    t: Array  # (3,), m
    m: Array  # (12,)
    P: Array  # (18, 18)


class Hypotheses(NamedTuple):
    """h hypotheses, each a state with its weight and its occlusion probabilities."""

    R: Array  # (h, 3, 3)
    t: Array  # (h, 3), m
    m: Array  # (h, 12)
    P: Array  # (h, 18, 18)
    log_weight: Array  # (h,) nats
    p_visible: Array  # (h, n + groups) as in tracking/rigid_body/models/occlusion.py


class Children(NamedTuple):
    """The hypotheses after a frame, before pruning; room for MAX_CHILDREN of them, c."""

    hypotheses: Hypotheses
    assigned: Ints  # (c, n) as in frame_detections.py
    manoeuvre: Bools  # (c,) the velocities jumped in the step before
    parent: Ints  # (c,) index of the hypothesis of the frame before; -1: none


class Dynamics(NamedTuple):
    """How the vehicle may move; pairs are of translation and rotation."""

    jerk: Array  # (6,) spectral densities of the steady motion's white jerk, by axis as in motion.py
    velocity_jump: Array  # (2,) variances of the velocities' jump in a manoeuvre
    acceleration_jump: Array  # (2,) variances of the accelerations' jump in a manoeuvre
    p_manoeuvre: float  # probability of a manoeuvre per frame


@compiled
def empty_children(n: int, groups: int) -> Children:
    """An empty list of children for n views whose spots are on so many screens."""
    c = MAX_CHILDREN
    return Children(
        empty_hypotheses(c, n + groups), np.empty((c, n), np.int64), np.zeros(c, np.bool_), np.zeros(c, np.int64)
    )


@compiled
def empty_hypotheses(h: int, visibilities: int) -> Hypotheses:
    """Room for h hypotheses with so many occlusion probabilities each."""
    return Hypotheses(
        np.empty((h, 3, 3)),
        np.empty((h, 3)),
        np.empty((h, 12)),
        np.empty((h, STATE, STATE)),
        np.empty(h),
        np.empty((h, visibilities)),
    )


@compiled
def state_of(h: Hypotheses, k: int) -> State:
    """The state of hypothesis k."""
    return State(h.R[k], h.t[k], h.m[k], h.P[k])


@compiled
def set_hypothesis(out: Hypotheses, k: int, state: State, log_weight: float, p_visible: Array) -> None:
    """Write hypothesis k of a list."""
    copy_matrix_into(out.R[k], state.R)
    copy_into(out.t[k], state.t)
    copy_into(out.m[k], state.m)
    copy_matrix_into(out.P[k], state.P)
    out.log_weight[k] = log_weight
    copy_into(out.p_visible[k], p_visible)


@compiled
def add_child(
    children: Children,
    count: int,
    state: State,
    log_weight: float,
    p_visible: Array,
    assigned: Ints,
    manoeuvre: bool,
    parent: int,
) -> tuple[int, int]:
    """Add a child; where there is no room it replaces the least likely one, unless it is less likely itself.

    Returns the number of children and the new child's index, -1 if it was not added.
    """
    place = count
    if count == MAX_CHILDREN:
        place = 0
        for k in range(count):
            if children.hypotheses.log_weight[k] < children.hypotheses.log_weight[place]:
                place = k
        if children.hypotheses.log_weight[place] >= log_weight:
            return count, -1
    else:
        count += 1
    set_hypothesis(children.hypotheses, place, state, log_weight, p_visible)
    copy_into(children.assigned[place], assigned)
    children.manoeuvre[place], children.parent[place] = manoeuvre, parent
    return count, place


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
