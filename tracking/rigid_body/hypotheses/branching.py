"""Branching of the hypotheses over motion models and assignments, compiled.

A multiple hypothesis tracker (Reid 1979) whose only target is the vehicle. Each hypothesis is predicted with the steady
motion and, where the frame suggests it, with a manoeuvre, that is a jump of the velocities. For each prediction the
frame's detections are assigned jointly (association/joint_search.py). Each assignment gives one child, with an exact
update of its own; the children of all hypotheses compete by their likelihood. Source: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compilation.jit import compiled, compiled_in_caller
from geometry.compiled_linalg import block, copy_into, copy_matrix_into
from tracking.rigid_body.association.frame_detections import (
    BLENDED,
    Observation,
    detection_log_likelihood,
    in_picture,
    log_clutter_ratio,
)
from tracking.rigid_body.association.joint_search import associate, complete, explainable, is_taken
from tracking.rigid_body.hypotheses.hypothesis_set import (
    MAX_CHECKING_SIGMA_PX,
    MAX_THREE_SPOT_SIGMA_PX,
    MAX_TRACKING_SIGMA_PX,
    MIN_CONFIRMING_SPOTS,
    MIN_REDUNDANT_SPOTS,
    PRUNE_NATS,
    Children,
    Dynamics,
    Hypotheses,
    State,
    Update,
    add_child,
    empty_children,
    iterated_update,
    largest_spot_sigma,
)
from tracking.rigid_body.models.motion import predicted
from tracking.rigid_body.models.occlusion import MISSED, marginal, predict, update

MANOEUVRE_PRUNE_NATS = 6.0  # a hypothesis that is this much less likely than the best is not tried with a manoeuvre
MAX_COMPLETED = 8  # assignments of one prediction that are completed after their update
# Excess of the chi-square over its expectation, in its standard deviations, from which on a manoeuvre is tried although
# every spot is found.
UNEXPECTED_SIGMAS = 3.5
# Probability of a manoeuvre in a frame that does not determine the pose:
P_MANOEUVRE_SUDDEN = 0.5  # if visible spots are suddenly not where they are expected
P_MANOEUVRE_OCCLUDED = 0.05  # at least, else: occlusions and manoeuvres often coincide


class _Assignments(NamedTuple):
    """Assignments of a frame's n views, as from `associate`, with room for MAX_COMPLETED more; c in all."""

    assigned: Ints  # (c, n)
    score: Array  # (c,) nats
    p_in: Array  # (c, n)
    R: Array  # (c, 3, 3)
    t: Array  # (c, 3)


class _Step(NamedTuple):
    """The hypotheses of the frame before and the step that leads to this frame."""

    old: Hypotheses
    dynamics: Dynamics
    dt: float  # s


@compiled
def branch(
    obs: Observation, after_jump: Observation, dynamics: Dynamics, dt: float, old: Hypotheses
) -> tuple[Children, int]:
    """The children of all hypotheses after a frame that comes dt (s) later, and their number.

    after_jump: the observation for manoeuvres. It differs where pictures were not taken at the frame's instant: how far
    the spots have moved until then is less certain if the velocities have just jumped.
    """
    n = obs.view_table.camera.shape[0]
    step = _Step(old, dynamics, dt)
    children = empty_children(n, old.p_visible.shape[1] - n)
    count = 0
    best = -np.inf
    for h in range(old.t.shape[0]):
        if old.log_weight[h] < -PRUNE_NATS:
            continue
        p_visible = predict(old.p_visible[h], n) if dt > 0.0 else old.p_visible[h]
        for manoeuvre in (False, True):  # one call, since the function is compiled into this place
            seen = after_jump if manoeuvre else obs
            count, best, suspected = _branch_motion(seen, step, h, manoeuvre, p_visible, children, count, best)
            if not suspected:
                break
    return children, count


@compiled
def _predicted_state(step: _Step, h: int, manoeuvre: bool) -> State:
    """Hypothesis h predicted with the steady motion or with a manoeuvre."""
    old, dynamics = step.old, step.dynamics
    if step.dt > 0.0:
        none = np.zeros(2)
        R, t, m, P, _ = predicted(
            old.R[h], old.t[h], old.m[h], old.P[h], step.dt, dynamics.jerk,
            dynamics.velocity_jump if manoeuvre else none, dynamics.acceleration_jump if manoeuvre else none,
        )  # fmt: skip
        return State(R, t, m, P)
    return State(old.R[h], old.t[h], old.m[h], old.P[h])


@compiled
def _max_clutter_ratio(obs: Observation) -> float:
    """Upper bound of `log_clutter_ratio`: no child is dropped before its likelihood is known."""
    out = 0.0
    for i in range(obs.frame.log_clutter_excess.shape[0]):
        out += obs.frame.log_clutter_excess[i]
    return out


@compiled_in_caller
def _branch_motion(
    obs: Observation, step: _Step, h: int, manoeuvre: bool, p_visible: Array, children: Children, count: int,
    best: float,
) -> tuple[int, float, bool]:  # fmt: skip
    """Add the children of hypothesis h that moves steadily, or with a manoeuvre.

    p_visible (n + groups,): predicted. best: largest log-weight so far. Returns the number of children, the largest
    log-weight, and whether the likeliest assignment to a steady motion suggests a manoeuvre.

    Assignments with fewer than MIN_CONFIRMING_SPOTS are left out with a manoeuvre: they would fit it wherever the spots
    lie, and the mixture of both motions covers them, which belongs to the steady one.
    """
    old, group = step.old, obs.view_table.group
    expected = _predicted_state(step, h, manoeuvre)
    p_unoccluded = marginal(p_visible, group)
    p_motion = step.dynamics.p_manoeuvre if manoeuvre else 1 - step.dynamics.p_manoeuvre
    log_prior = old.log_weight[h] + np.log(p_motion)
    mixes = step.dt > 0.0 and not manoeuvre
    found, b = _assignments(obs, expected, p_unoccluded)
    assigned, score = found.assigned, found.score
    bound = _max_clutter_ratio(obs)
    suspected, likeliest, highest, k = False, -np.inf, score[0], -1
    while k < b - 1:
        k += 1
        most = log_prior + score[k] + bound + explainable(obs, assigned[k])
        if most < best - PRUNE_NATS or score[k] < highest - PRUNE_NATS:
            continue
        labelled = _labelled(assigned[k])
        if manoeuvre and labelled < MIN_CONFIRMING_SPOTS:
            continue
        # Visible spots that are not found have become occluded, or the vehicle has turned.
        sudden = _misses_expected_spot(assigned[k], p_unoccluded)
        prior = expected
        if mixes and labelled < MIN_CONFIRMING_SPOTS:
            prior = _with_either_motion(step, h, expected, sudden)
        result = iterated_update(obs, prior, assigned[k], found.R[k], found.t[k])
        b = _add_completed(obs, found, k, b, result.state, p_unoccluded)
        log_likelihood, chi2 = result.log_likelihood, result.chi2
        if mixes and 0 < labelled < MIN_CONFIRMING_SPOTS:
            # The mixture is at least as likely as its steady part; otherwise a false third spot would seem likelier.
            narrow = iterated_update(obs, expected, assigned[k], found.R[k], found.t[k])
            chi2 = narrow.chi2
            p_steady = 1.0 - (P_MANOEUVRE_SUDDEN if sudden else P_MANOEUVRE_OCCLUDED)
            log_likelihood = max(log_likelihood, narrow.log_likelihood + np.log(p_steady))
        if mixes and MIN_CONFIRMING_SPOTS <= labelled < MIN_REDUNDANT_SPOTS:
            prior = _with_either_motion(step, h, expected, sudden)
        state = _state_if_determined(obs, prior, result, assigned[k], labelled)
        log_weight = log_prior + log_likelihood + log_clutter_ratio(obs, state.R, state.t, state.P)
        log_weight += detection_log_likelihood(obs, p_visible, assigned[k], found.p_in[k])
        if mixes and log_weight >= likeliest and old.log_weight[h] > -MANOEUVRE_PRUNE_NATS:
            likeliest, dof = log_weight, 2 * result.spots
            suspected = (
                chi2 > dof + UNEXPECTED_SIGMAS * np.sqrt(2.0 * max(dof, 1))
                or (labelled < MIN_CONFIRMING_SPOTS and sudden)
                or _misses_whole_screen(assigned[k], p_unoccluded, group)
                or _leaves_points(obs, expected, assigned[k], p_unoccluded)
            )
        if np.isfinite(log_weight):
            best = max(best, log_weight)
            after = update(p_visible, group, assigned[k], obs.detection_model.p_detect * found.p_in[k])
            count, _ = add_child(children, count, state, log_weight, after, assigned[k], manoeuvre, h)
    return count, best, suspected


@compiled_in_caller
def _assignments(obs: Observation, predicted: State, p_unoccluded: Array) -> tuple[_Assignments, int]:
    """The assignments of a joint search from a predicted state, with room for completed ones, and their number."""
    assigned, score, p_in, R, t, b = associate(obs, predicted.R, predicted.t, block(predicted.P, 6), p_unoccluded)
    n, room = assigned.shape[1], b + MAX_COMPLETED
    out = _Assignments(
        np.empty((room, n), np.int64), np.empty(room), np.empty((room, n)), np.empty((room, 3, 3)), np.empty((room, 3))
    )
    for k in range(b):
        copy_into(out.assigned[k], assigned[k])
        out.score[k] = score[k]
        copy_into(out.p_in[k], p_in[k])
        copy_matrix_into(out.R[k], R[k])
        copy_into(out.t[k], t[k])
    return out, b


@compiled_in_caller
def _add_completed(obs: Observation, of: _Assignments, k: int, b: int, state: State, p_unoccluded: Array) -> int:
    """Add assignment k with the further spots that its updated state explains to b assignments; returns their number.

    Where the prediction is far off, the joint search does not reach these spots.
    """
    if b == of.score.shape[0] or _labelled(of.assigned[k]) < MIN_CONFIRMING_SPOTS:
        return b
    new = of.assigned[b]
    copy_into(new, of.assigned[k])
    if not complete(obs, new, state.R, state.t, state.P, p_unoccluded):
        return b
    place = b
    for j in range(b):
        same = True
        for i in range(new.shape[0]):
            same &= max(of.assigned[j, i], MISSED) == max(new[i], MISSED)
        if same:
            place = j
    of.score[place] = np.inf  # its exact update decides, not the linearised search
    if place < b:
        return b
    copy_into(of.p_in[b], in_picture(obs, new, state.R, state.t))
    copy_matrix_into(of.R[b], state.R)
    copy_into(of.t[b], state.t)
    return b + 1


@compiled
def _labelled(assigned: Ints) -> int:
    """Number of labelled views of an assignment (n,), without blended detections."""
    out = 0
    for i in range(assigned.shape[0]):
        out += 1 if 0 <= assigned[i] < BLENDED else 0
    return out


@compiled_in_caller
def _state_if_determined(obs: Observation, prior: State, result: Update, assigned: Ints, labelled: int) -> State:
    """The updated state; the predicted one where so few labelled spots are predicted so badly that false points fit."""
    limit = MAX_TRACKING_SIGMA_PX if labelled < MIN_CONFIRMING_SPOTS else MAX_THREE_SPOT_SIGMA_PX
    if (
        0 < labelled < MIN_REDUNDANT_SPOTS
        and largest_spot_sigma(obs.views, prior.R, prior.t, prior.P, assigned) > limit
    ):
        return prior
    return result.state


@compiled
def _with_either_motion(step: _Step, h: int, steady: State, sudden: bool) -> State:
    """Hypothesis h predicted with the mixture of steady motion and manoeuvre, whose means are equal.

    For frames whose spots do not determine the pose and so cannot separate the two motions. sudden: visible spots are
    missing.
    """
    manoeuvre = _predicted_state(step, h, True)
    p = P_MANOEUVRE_SUDDEN if sudden else max(step.dynamics.p_manoeuvre, P_MANOEUVRE_OCCLUDED)
    return State(steady.R, steady.t, steady.m, _mixture(steady.P, manoeuvre.P, p))


@compiled_in_caller
def _mixture(P: Array, other: Array, p: float) -> Array:
    """(1 - p) P + p other, of matrices."""
    out = np.empty_like(P)
    for i in range(P.shape[0]):
        for j in range(P.shape[1]):
            out[i, j] = (1 - p) * P[i, j] + p * other[i, j]
    return out


@compiled
def _misses_expected_spot(assigned: Ints, p_unoccluded: Array) -> bool:
    """Whether a spot that is probably not occluded was not found, or only blended."""
    misses = False
    for i in range(assigned.shape[0]):
        misses |= (assigned[i] == MISSED or assigned[i] >= BLENDED) and p_unoccluded[i] > 0.5
    return misses


@compiled_in_caller
def _misses_whole_screen(assigned: Ints, p_unoccluded: Array, group: Ints) -> bool:
    """Whether none of the spots of a screen was found although one of them is probably not occluded.

    After frames with one screen only, the gates of its spots are narrow and those of the other screen's spots are not.
    Then a manoeuvre looks like an occlusion of the other screen, however many spots of the first are found.
    """
    for i in range(assigned.shape[0]):
        if assigned[i] != MISSED or p_unoccluded[i] <= 0.5:
            continue
        none = True
        for j in range(assigned.shape[0]):
            none = none and (group[j] != group[i] or assigned[j] < 0)
        if none:
            return True
    return False


@compiled_in_caller
def _leaves_points(obs: Observation, predicted: State, assigned: Ints, p_unoccluded: Array) -> bool:
    """Whether a spot that is probably not occluded has no label although its camera shows a point of no spot.

    Beams at equal angles look the same from a pose that is one of these angles off, except for the outermost spots.
    A spot outside the picture counts only if the prediction is too uncertain to check the labels.
    """
    frame, beyond = obs.frame, False
    for i in range(assigned.shape[0]):
        if assigned[i] >= 0 or p_unoccluded[i] <= 0.5:
            continue
        c, free = obs.view_table.camera[i], False
        for d in range(frame.first[c], frame.first[c + 1]):
            free |= frame.log_static[d] <= frame.log_clutter[i] and not is_taken(assigned, d)
        if free and assigned[i] == MISSED:
            return True
        beyond |= free
    return beyond and (
        largest_spot_sigma(obs.views, predicted.R, predicted.t, predicted.P, assigned) > MAX_CHECKING_SIGMA_PX
    )
