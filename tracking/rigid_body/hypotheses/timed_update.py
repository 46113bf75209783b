"""Update of a predicted state by spots that each have an instant of their own; compiled.

As iterated_update.py, over the whole state (18 numbers): a spot that is exposed before or after the frame's instant
measures the velocities too. Source: ours.
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
from tracking.rigid_body.association.frame_detections import BLENDED, FrameDetections, Observation
from tracking.rigid_body.hypotheses.hypothesis_set import State
from tracking.rigid_body.models.information import add_curvature_covariance
from tracking.rigid_body.models.motion import STATE
from tracking.rigid_body.models.picture_shifts import timed_information

MAX_STEPS, MAX_HALVINGS = 8, 5  # of Gauss-Newton, and of one step
MAX_UPDATE_SIGMA = 0.06  # m, rad: a frame that leaves its widest direction less certain does not update the state


class Update(NamedTuple):
    """A state after an update by one assignment."""

    state: State
    log_likelihood: float  # its Gaussian part, nats
    chi2: float  # misfit of the spots and of the prior at the optimum
    spots: int  # number of spots in the update


class _TimedMode(NamedTuple):
    """Mode of the posterior of a state."""

    state: State
    log_likelihood: float
    chi2: float
    converged: bool


@compiled
def chosen_points(frame: FrameDetections, assigned: Ints, calibration_cov: Array) -> tuple[Bools, Array, Array]:
    """Detections of one assignment (n,): views used in the pose (n,), pixels (n, 2) and covariances (n, 2, 2)."""
    n = assigned.shape[0]
    use, uv, cov = np.zeros(n, np.bool_), np.empty((n, 2)), np.empty((n, 2, 2))
    for i in range(n):
        d = assigned[i]
        if 0 <= d < BLENDED:
            use[i] = True
            for a in range(2):
                uv[i, a] = frame.uv[d, a]
                for b in range(2):
                    cov[i, a, b] = frame.cov[d, a, b] + calibration_cov[i, a, b]
    return use, uv, cov


@compiled
def timed_update(obs: Observation, prior: State, assigned: Ints, R: Array, t: Array) -> Update:
    """As `iterated_update`, of an observation whose pictures have clocks of their own."""
    use, uv, cov = chosen_points(obs.frame, assigned, obs.calibration_cov - obs.shift_cov)
    count = 0
    for i in range(use.shape[0]):
        count += 1 if use[i] else 0
    unchanged = State(prior.R, prior.t, prior.m.copy(), prior.P.copy())
    if count == 0:
        return Update(unchanged, 0.0, 0.0, 0)
    mode = _timed_mode(obs, prior, use, uv, cov, State(R, t, prior.m, prior.P))
    if mode.log_likelihood == -np.inf:
        return Update(unchanged, mode.log_likelihood, mode.chi2, count)
    reached = mode.state
    sigma = add_curvature_covariance(obs.views, use, cov, reached.R, reached.t, block(reached.P, 6))
    if sigma > 0.0:
        mode = _timed_mode(obs, prior, use, uv, cov, reached)
    if not mode.converged or sigma > MAX_UPDATE_SIGMA:
        return Update(unchanged, mode.log_likelihood, mode.chi2, count)
    return Update(mode.state, mode.log_likelihood, mode.chi2, count)


@compiled
def _timed_mode(obs: Observation, prior: State, use: Bools, uv: Array, cov: Array, start: State) -> _TimedMode:
    """Most probable state given a prior and the used spots: Gauss-Newton with halved steps.

    use (n,), uv (n, 2), px, cov (n, 2, 2), px^2.
    """
    camera = obs.view_table.camera
    spots = 0
    for i in range(use.shape[0]):
        spots += 1 if use[i] else 0
    root = cholesky(prior.P)
    R, t, m = start.R, start.t, start.m.copy()
    delta = np.empty(STATE)
    d = pose_minus(R, t, prior.R, prior.t)
    for i in range(6):
        delta[i] = d[i]
    for i in range(12):
        delta[6 + i] = m[i] - prior.m[i]
    L, g, chi2, count, log_norm = timed_information(obs.views, camera, obs.clocks, (R, t, m), use, uv, cov)
    cost = chi2 + _squared_length(root, delta) if count == spots else np.inf
    log_det, converged = 0.0, False
    for _ in range(MAX_STEPS):
        A, b = _in_tangent(L, g, delta)
        P, log_det = posterior(prior.P, A)
        right = apply(A, delta)
        for i in range(STATE):
            right[i] += b[i]
        step = apply(P, right)
        for i in range(STATE):
            step[i] -= delta[i]
        # A hundredth of the state's own sigma is accurate enough.
        converged = count == spots and dot(step, apply(A, step)) < 1e-4
        better = False
        for _ in range(MAX_HALVINGS):
            if converged:
                break
            delta_new, m_new = np.empty(STATE), np.empty(12)
            for i in range(STATE):
                delta_new[i] = delta[i] + step[i]
                step[i] *= 0.5
            R_new, t_new = pose_plus(prior.R, prior.t, delta_new)
            for i in range(12):
                m_new[i] = prior.m[i] + delta_new[6 + i]
            L_new, g_new, chi2_new, count_new, norm_new = timed_information(
                obs.views, camera, obs.clocks, (R_new, t_new, m_new), use, uv, cov
            )
            cost_new = chi2_new + _squared_length(root, delta_new)
            if count_new == spots and cost_new < cost:
                R, t, m, delta, cost, better = R_new, t_new, m_new, delta_new, cost_new, True
                L, g, chi2, count, log_norm = L_new, g_new, chi2_new, count_new, norm_new
                break
        if not better:
            break
    misfit = max(cost, 0.0)
    log_likelihood = -0.5 * (log_norm + log_det + misfit) if np.isfinite(misfit) else -np.inf
    # The covariance refers to the tangent of the pose.
    P, _ = posterior(prior.P, L)
    return _TimedMode(State(R, t, m, P), log_likelihood, misfit, converged)


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
def _in_tangent(L: Array, g: Array, delta: Array) -> tuple[Array, Array]:
    """Normal matrix (18, 18) and vector (18,) by delta (18,), the state minus the prior's, from those by the state."""
    T, turn = np.zeros((STATE, STATE)), np.empty(3)
    for i in range(3):
        turn[i] = delta[3 + i]
    J = right_jacobian(turn)
    for i in range(STATE):
        T[i, i] = 1.0
    for i in range(3):
        for j in range(3):
            T[3 + i, 3 + j] = J[i, j]
    return transposed_multiply(T, multiply(L, T)), transposed_apply(T, g)
