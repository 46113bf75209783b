"""Update of a predicted state by one assignment, linearised at its own optimum (iterated Kalman filter); compiled.

Spots that are exposed at the frame's instant measure the pose, 6 numbers; those of pictures with clocks of their own
measure the velocities too, so the optimum is sought over the whole state, 18 numbers.

Source: Bell & Cathey (1993), "The iterated Kalman filter update as a Gauss-Newton method"; with halved steps and with
the linearisation error of poorly observed directions: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_linalg import (
    apply,
    block,
    cholesky,
    dot,
    multiply,
    pose_minus,
    pose_plus,
    posterior,
    right_jacobian,
    transposed_apply,
    transposed_multiply,
)
from tracking.rigid_body.association.frame_detections import Observation, chosen_points
from tracking.rigid_body.hypotheses.hypothesis_set import State
from tracking.rigid_body.models.information import add_curvature_covariance, frame_information, timed_information
from tracking.rigid_body.models.motion import STATE, updated

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
    out = np.empty(size)
    out[:6] = pose_minus(state[0], state[1], prior.R, prior.t)
    for i in range(6, size):
        out[i] = state[2][i - 6] - prior.m[i - 6]
    return out


@compiled
def _plus(prior: State, delta: Array) -> tuple[Array, Array, Array]:
    """The prior plus the first numbers (s,) of a state: R, t, m."""
    R, t = pose_plus(prior.R, prior.t, delta)
    m = prior.m.copy()
    for i in range(6, delta.shape[0]):
        m[i - 6] += delta[i]
    return R, t, m


@compiled
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
