"""The hypotheses of a frame and their children: types, checks of predictions, pruning, exact updates; compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled, compiled_in_caller
from geometry.compiled_linalg import (
    apply,
    best_first,
    block,
    cholesky,
    copy_into,
    copy_matrix_into,
    dot,
    multiply,
    pose_minus,
    pose_plus,
    posterior,
    right_jacobian,
    transposed_apply,
    transposed_multiply,
)
from geometry.compiled_projection import Views
from tracking.rigid_body.association.frame_detections import BLENDED, Observation, chosen_points, predicted_pixel
from tracking.rigid_body.models.information import add_curvature_covariance, frame_information, timed_information
from tracking.rigid_body.models.motion import STATE, updated

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


@compiled_in_caller
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


# Update of a predicted state by one assignment, linearised at its own optimum (iterated Kalman filter); compiled.
#
# Spots that are exposed at the frame's instant measure the pose, 6 numbers; those of pictures with clocks of their own
# measure the velocities too, so the optimum is sought over the whole state, 18 numbers.
#
# Source: Bell & Cathey (1993), "The iterated Kalman filter update as a Gauss-Newton method"; with halved steps and with
# the linearisation error of poorly observed directions: ours.

MAX_STEPS, MAX_HALVINGS = 8, 5  # of Gauss-Newton, and of one step
MAX_UPDATE_SIGMA = 0.06  # m, rad: a frame that leaves its widest direction less certain does not update the state


class Update(NamedTuple):
    """A state after an update by one assignment."""

    state: State
    log_likelihood: float  # its Gaussian part, nats
    chi2: float  # misfit of the spots and of the prior at the optimum
    spots: int  # number of spots in the update


class _Mode(NamedTuple):
    """Mode of the posterior of the first s numbers of a state: 6, or all 18 where the spots measure them."""

    R: Array  # (3, 3)
    t: Array  # (3,)
    m: Array  # (12,)
    P: Array  # (s, s)
    information: Array  # (s, s) the spots' normal matrix at the mode
    vector: Array  # (s,) the spots' vector, about the prior's state
    log_likelihood: float
    chi2: float
    converged: bool


@compiled
def iterated_update(obs: Observation, prior: State, assigned: Ints, R: Array, t: Array) -> Update:
    """Update a predicted state by one assignment (n,); the iteration starts at the pose (R, t).

    A spot that the resulting pose does not project makes the likelihood 0. An update that does not converge leaves the
    state as it was, with the misfit that was reached.
    """
    frame = obs.frame
    fixed_cov = obs.calibration_cov - obs.shift_cov if obs.timed else obs.calibration_cov
    use, uv, cov = chosen_points(frame.uv, frame.cov, 0, assigned, fixed_cov)
    count = _number_of(use)
    unchanged = State(prior.R, prior.t, prior.m.copy(), prior.P.copy())
    if count == 0:
        return Update(unchanged, 0.0, 0.0, 0)
    mode = _posterior_mode(obs, prior, use, uv, cov, (R, t, prior.m))
    if mode.log_likelihood == -np.inf:
        return Update(unchanged, mode.log_likelihood, mode.chi2, count)
    # Along a poorly observed direction the spots' paths are not straight. Their linearisation error must not make that
    # direction look observed: it is added to their covariances, and the update is repeated.
    sigma = add_curvature_covariance(obs.views, use, cov, mode.R, mode.t, block(mode.P, 6))
    if sigma > 0.0:
        mode = _posterior_mode(obs, prior, use, uv, cov, (mode.R, mode.t, mode.m))
    if not mode.converged or sigma > MAX_UPDATE_SIGMA:
        # Few spots of a vehicle that may be anywhere: nothing that a linearisation could represent.
        return Update(unchanged, mode.log_likelihood, mode.chi2, count)
    if obs.timed:
        # The covariance refers to the tangent of the pose.
        P, _ = posterior(prior.P, mode.information)
        return Update(State(mode.R, mode.t, mode.m, P), mode.log_likelihood, mode.chi2, count)
    out_R, out_t, out_m, out_P, _, _ = updated(prior.R, prior.t, prior.m, prior.P, mode.information, mode.vector)
    return Update(State(out_R, out_t, out_m, out_P), mode.log_likelihood, mode.chi2, count)


@compiled
def _posterior_mode(
    obs: Observation, prior: State, use: Bools, uv: Array, cov: Array, start: tuple[Array, Array, Array]
) -> _Mode:
    """Most probable state given a prior and the used spots: Gauss-Newton with halved steps.

    use (n,), uv (n, 2), px, cov (n, 2, 2), px^2; start: R, t, m.
    """
    spots = _number_of(use)
    P0 = block(prior.P, STATE if obs.timed else 6)
    root = cholesky(P0)
    state = start
    delta = _difference(state, prior, P0.shape[0])
    L, g, chi2, count, log_norm = _information(obs, state, use, uv, cov)
    cost = chi2 + _squared_length(root, delta) if count == spots else np.inf
    P, b, log_det, converged = P0, np.zeros(P0.shape[0]), 0.0, False
    for _ in range(MAX_STEPS):
        # The prior's tangent differs from that of the pose: without this the steps converge slowly where the two are
        # far apart, and not to the mode (beyond 0.3 rad not within the steps that there are).
        A, b = _in_tangent_of_prior(L, g, delta)
        P, log_det = posterior(P0, A)
        step = apply(P, _sum(apply(A, delta), b))
        for i in range(step.shape[0]):
            step[i] -= delta[i]
        # A hundredth of the state's own sigma is accurate enough.
        converged = count == spots and dot(step, apply(A, step)) < 1e-4
        better = False
        for _ in range(MAX_HALVINGS):
            if converged:
                break
            delta_new = _sum(delta, step)
            for i in range(step.shape[0]):
                step[i] *= 0.5
            state_new = _plus(prior, delta_new)
            L_new, g_new, chi2_new, count_new, norm_new = _information(obs, state_new, use, uv, cov)
            cost_new = chi2_new + _squared_length(root, delta_new)
            if count_new == spots and cost_new < cost:
                state, delta, cost, better = state_new, delta_new, cost_new, True
                L, g, chi2, count, log_norm = L_new, g_new, chi2_new, count_new, norm_new
                break
        if not better:
            break
    # Rounding can make the misfit negative where the prior is wide; a likelihood must not exceed that of a perfect fit.
    misfit = max(cost, 0.0)
    log_likelihood = -0.5 * (log_norm + log_det + misfit) if np.isfinite(misfit) else -np.inf
    # The update's covariance refers to the tangent of the pose.
    R, t, m = state
    return _Mode(R, t, m, P, L, _sum(apply(L, delta), b), log_likelihood, misfit, converged)


@compiled
def _information(
    obs: Observation, state: tuple[Array, Array, Array], use: Bools, uv: Array, cov: Array
) -> tuple[Array, Array, float, int, float]:
    """What the spots measure: `timed_information` of the state, or `frame_information` of its pose."""
    if obs.timed:
        return timed_information(obs.views, obs.view_table.camera, obs.clocks, state, use, uv, cov)
    return frame_information(obs.views, state[0], state[1], use, uv, cov)


@compiled
def _difference(state: tuple[Array, Array, Array], prior: State, size: int) -> Array:
    """The first numbers (size,) of a state (R, t, m) minus the prior."""
    out, pose = np.empty(size), pose_minus(state[0], state[1], prior.R, prior.t)
    for i in range(6):
        out[i] = pose[i]
    for i in range(6, size):
        out[i] = state[2][i - 6] - prior.m[i - 6]
    return out


@compiled_in_caller
def _plus(prior: State, delta: Array) -> tuple[Array, Array, Array]:
    """The prior plus the first numbers (s,) of a state: R, t, m."""
    R, t = pose_plus(prior.R, prior.t, delta)
    m = prior.m.copy()
    for i in range(6, delta.shape[0]):
        m[i - 6] += delta[i]
    return R, t, m


@compiled_in_caller
def _in_tangent_of_prior(L: Array, g: Array, delta: Array) -> tuple[Array, Array]:
    """Normal matrix (s, s) and vector (s,) by delta (s,), the state minus the prior, from those by the state."""
    size = delta.shape[0]
    T, turn = np.zeros((size, size)), np.empty(3)
    for i in range(3):
        turn[i] = delta[3 + i]
    J = right_jacobian(turn)
    for i in range(size):
        T[i, i] = 1.0
    for i in range(3):
        for j in range(3):
            T[3 + i, 3 + j] = J[i, j]
    return transposed_multiply(T, multiply(L, T)), transposed_apply(T, g)


@compiled
def _squared_length(root: Array, delta: Array) -> float:
    """delta^T P^-1 delta of a vector (n,), with the lower Cholesky factor (n, n) of P."""
    n = delta.shape[0]
    w = np.empty(n)
    total = 0.0
    for i in range(n):
        s = delta[i]
        for j in range(i):
            s -= root[i, j] * w[j]
        w[i] = s / root[i, i]
        total += w[i] * w[i]
    return total


@compiled
def _number_of(chosen: Bools) -> int:
    """How many of (n,) are true."""
    count = 0
    for i in range(chosen.shape[0]):
        count += 1 if chosen[i] else 0
    return count


@compiled
def _sum(x: Array, y: Array) -> Array:
    """x + y, for vectors (n,)."""
    out = np.empty(x.shape[0])
    for i in range(x.shape[0]):
        out[i] = x[i] + y[i]
    return out
