"""Types of the multiple hypothesis tracker: the hypotheses of a frame and their children; compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_linalg import copy_into, copy_matrix_into
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
