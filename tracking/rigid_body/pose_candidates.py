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
from geometry.pose_prior import PosePrior
from geometry.pose_solver.alternative_poses import alternative_poses
from tracking.rigid_body.acquisition import (
    FIRST_ACCELERATION,
    FIRST_ANGULAR_ACCELERATION,
    FIRST_RATE,
    FIRST_SPEED,
)
from tracking.rigid_body.association.frame_detections import BLENDED, NOT_SEARCHED, Observation, distinct_spots
from tracking.rigid_body.association.likelihood import detection_log_likelihood, log_clutter_ratio
from tracking.rigid_body.hypotheses.hypothesis_set import Children, Dynamics, Hypotheses, State, add_child
from tracking.rigid_body.hypotheses.iterated_update import iterated_update
from tracking.rigid_body.hypotheses.prediction_checks import MIN_CONFIRMING_SPOTS
from tracking.rigid_body.models.motion import predicted
from tracking.rigid_body.models.occlusion import MISSED, joint_log_likelihood, marginal, predict, update

P_VISIBLE_AT_START = 0.95  # of each spot and each screen
MAX_LINKED = 3  # hypotheses that a search's answers continue, and children whose mirror solutions are added
DOUBT_NATS = 7.0  # by so much an answer must explain a frame better than a doubted track, both without their history
ALTERNATIVE_NATS = 8.0  # mirror solutions are added to children that are at most this much less likely than the best


class Start(NamedTuple):
    """A predicted state that a pose is to update."""

    state: State
    p_visible: Array  # (n + groups,)
    log_weight: float
    parent: int  # index of the hypothesis of the frame before; -1: none
    manoeuvre: bool  # the state may have jumped, or is unknown


def unknown_vehicle(prior: PosePrior, log_weight: float, visibilities: int) -> Start:
    """A vehicle that is somewhere in the search region and of whose motion nothing is known."""
    where = (min(prior.within_m, 10.0) / np.sqrt(3), prior.within_rad / np.sqrt(3))
    sigmas = [*where, FIRST_SPEED, FIRST_RATE, FIRST_ACCELERATION, FIRST_ANGULAR_ACCELERATION]
    R, t = np.ascontiguousarray(prior.centre.rotation), np.array(prior.centre.translation)
    state = State(R, t, np.zeros(12), np.diag(np.repeat(sigmas, 3) ** 2))
    return Start(state, np.full(visibilities, P_VISIBLE_AT_START), log_weight, -1, True)


def predicted_hypothesis(h: Hypotheses, k: int, dt_s: float, dynamics: Dynamics, manoeuvre: bool) -> State:
    """Hypothesis k of the frame before, predicted over dt_s."""
    none = np.zeros(2)
    jumps = (dynamics.velocity_jump, dynamics.acceleration_jump) if manoeuvre else (none, none)
    R, t, m, P, _ = predicted(h.R[k], h.t[k], h.m[k], h.P[k], dt_s, dynamics.jerk, *jumps)
    return State(R, t, m, P)


def continued_hypotheses(h: Hypotheses, dt_s: float, dynamics: Dynamics, n: int, manoeuvre: bool) -> list[Start]:
    """The likeliest hypotheses of the frame before, predicted with or without a manoeuvre; n: number of views."""
    out = []
    for k in np.argsort(-h.log_weight)[:MAX_LINKED].tolist():
        p = dynamics.p_manoeuvre if manoeuvre else 1 - dynamics.p_manoeuvre
        state = predicted_hypothesis(h, k, dt_s, dynamics, manoeuvre)
        out.append(Start(state, predict(h.p_visible[k], n), float(h.log_weight[k] + np.log(p)), k, manoeuvre))
    return out


def without_history(
    children: Children, count: int, obs: Observation, model: SpotModel, start: Start
) -> tuple[int, Start]:
    """An unknown vehicle's start whose answers compete with the best child as if that had no history either.

    Where the track itself is doubted, its narrow prediction must not count for it: a wrong pose that has been followed
    for some frames predicts its few points better than an unknown vehicle predicts all of its spots. Also returns the
    number of children, to which the best child's labels of this start are added.
    """
    if count == 0:
        return count, start
    best = int(np.argmax(children.hypotheses.log_weight[:count]))
    pose = Pose(children.hypotheses.R[best].copy(), children.hypotheses.t[best].copy())
    weight = float(children.hypotheses.log_weight[best])
    count, place = add_pose(children, count, obs, model, start, children.assigned[best].copy(), pose)
    if place < 0:
        return count, start
    history = weight - float(children.hypotheses.log_weight[place]) - DOUBT_NATS
    return count, start._replace(log_weight=start.log_weight + max(history, 0.0))


def continues(children: Children, count: int, parent: int, assigned: Ints) -> bool:
    """Whether one of the first `count` children continues a hypothesis steadily with the same labels (n,)."""
    labels = np.maximum(children.assigned[:count], MISSED) == np.maximum(assigned, MISSED)
    steady = (children.parent[:count] == parent) & ~children.manoeuvre[:count]
    return bool((labels.all(axis=1) & steady).any())


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
            start = Start(state, predict(old.p_visible[parent], len(model)), log_weight, parent, manoeuvre)
            count, _ = add_pose(children, count, obs, model, start, assigned, others[i])
    return count
