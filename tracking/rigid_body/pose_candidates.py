"""Children of the hypotheses from given poses: answers of a search, and mirror solutions of three spots.

They are scored like all other children.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compiled_projection import project_all
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.alternative_poses import alternative_poses
from tracking.rigid_body.association.frame_detections import BLENDED, NOT_SEARCHED, Observation, distinct_spots
from tracking.rigid_body.association.likelihood import detection_log_likelihood, log_clutter_ratio
from tracking.rigid_body.hypotheses.hypothesis_set import Children, Dynamics, Hypotheses, State, add_child
from tracking.rigid_body.hypotheses.iterated_update import iterated_update
from tracking.rigid_body.hypotheses.prediction_checks import MIN_CONFIRMING_SPOTS
from tracking.rigid_body.models.motion import predicted
from tracking.rigid_body.models.occlusion import joint_log_likelihood, marginal, predict, update

MAX_LINKED = 3  # hypotheses that a search's answers continue, and children whose mirror solutions are added
ALTERNATIVE_NATS = 8.0  # mirror solutions are added to children that are at most this much less likely than the best


class Start(NamedTuple):
    """A predicted state that a pose is to update."""

    state: State
    p_visible: Array  # (n + groups,)
    log_weight: float
    parent: int  # index of the hypothesis of the frame before; -1: none


def predicted_hypothesis(h: Hypotheses, k: int, dt_s: float, dynamics: Dynamics, manoeuvre: bool) -> State:
    """Hypothesis k of the frame before, predicted over dt_s."""
    none = np.zeros(2)
    jumps = (dynamics.velocity_jump, dynamics.acceleration_jump) if manoeuvre else (none, none)
    R, t, m, P, _ = predicted(h.R[k], h.t[k], h.m[k], h.P[k], dt_s, dynamics.jerk, *jumps)
    return State(R, t, m, P)


def continued_hypotheses(h: Hypotheses, dt_s: float, dynamics: Dynamics, n: int) -> list[Start]:
    """The likeliest hypotheses of the frame before, predicted with a manoeuvre; n: number of views."""
    out = []
    for k in np.argsort(-h.log_weight)[:MAX_LINKED].tolist():
        log_weight = float(h.log_weight[k]) + np.log(dynamics.p_manoeuvre)
        state = predicted_hypothesis(h, k, dt_s, dynamics, manoeuvre=True)
        out.append(Start(state, predict(h.p_visible[k], n), log_weight, k))
    return out


def add_pose(
    children: Children, count: int, obs: Observation, model: SpotModel, start: Start, assigned: Ints, pose: Pose
) -> tuple[int, int]:
    """Add the update of a state by an assignment (n,) near a pose; see `add_child` for the result."""
    group, p_detect = obs.view_table.group, obs.detection_model.p_detect
    state, log_likelihood, _, _ = iterated_update(
        obs, start.state, assigned, np.array(pose.rotation, order="C"), np.array(pose.translation)
    )
    uv, _ = project_all(obs.views, state.R[None], state.t[None])
    inside = model.in_picture(uv[0]) & obs.frame.has_image[model.camera_of]
    assigned = np.where((assigned < 0) & ~inside, NOT_SEARCHED, assigned)
    log_weight = start.log_weight
    log_weight += log_likelihood + log_clutter_ratio(obs, state.R, state.t, state.P)
    log_weight += detection_log_likelihood(obs, marginal(start.p_visible, group), assigned, state.R, state.t)
    log_weight += joint_log_likelihood(start.p_visible, group, assigned, p_detect)
    if not np.isfinite(log_weight):
        return count, -1
    after = update(start.p_visible, group, assigned, p_detect)
    return add_child(children, count, state, log_weight, after, assigned, False, start.parent)


def add_mirror_solutions(
    children: Children,
    count: int,
    obs: Observation,
    model: SpotModel,
    old: Hypotheses,
    dynamics: Dynamics,
    dt_s: float,
) -> int:
    """Add the other poses that three labelled spots allow to the children; returns the number of children.

    Three spots determine a pose up to a few solutions, and only the motion can distinguish them. Each solution gets
    children of its own, so that one to which the vehicle may have changed remains among the hypotheses.
    """
    w = children.hypotheses.log_weight[:count]
    for c in np.argsort(-w)[:MAX_LINKED].tolist():
        assigned = children.assigned[c].copy()
        exact = (assigned >= 0) & (assigned < BLENDED)
        parent = int(children.parent[c])
        if (
            w[c] < w.max() - ALTERNATIVE_NATS
            or parent < 0
            or distinct_spots(exact, model.spot_of) != MIN_CONFIRMING_SPOTS
        ):
            continue
        pose = Pose(children.hypotheses.R[c].copy(), children.hypotheses.t[c].copy())
        others = alternative_poses(model, pose, np.flatnonzero(exact))
        manoeuvre = bool(children.manoeuvre[c])
        p = dynamics.p_manoeuvre
        log_weight = float(old.log_weight[parent]) + float(np.log(p if manoeuvre else 1 - p))
        state = predicted_hypothesis(old, parent, dt_s, dynamics, manoeuvre)
        for i in range(len(others.translation)):
            start = Start(state, predict(old.p_visible[parent], len(model)), log_weight, parent)
            count, _ = add_pose(children, count, obs, model, start, assigned, others[i])
    return count
