"""Update of a predicted state by one assignment, linearised at its own optimum (iterated Kalman filter); compiled.

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
    dot,
    multiply,
    pose_minus,
    pose_plus,
    posterior,
    right_jacobian,
    solve,
    transposed_apply,
    transposed_multiply,
)
from geometry.compiled_projection import Views
from tracking.rigid_body.association.frame_detections import Observation
from tracking.rigid_body.hypotheses.hypothesis_set import State
from tracking.rigid_body.hypotheses.timed_update import (
    MAX_HALVINGS,
    MAX_STEPS,
    MAX_UPDATE_SIGMA,
    Update,
    chosen_points,
    timed_update,
)
from tracking.rigid_body.models.information import add_curvature_covariance, frame_information, quadratic_form
from tracking.rigid_body.models.motion import updated


class _Mode(NamedTuple):
    """Mode of the posterior of a pose."""

    R: Array  # (3, 3)
    t: Array  # (3,)
    P: Array  # (6, 6)
    information: Array  # (6, 6) the spots' normal matrix at the mode
    vector: Array  # (6,) the spots' vector, about the prior's pose
    log_likelihood: float
    chi2: float
    converged: bool


@compiled
def iterated_update(obs: Observation, prior: State, assigned: Ints, R: Array, t: Array) -> Update:
    """Update a predicted state by one assignment (n,); the iteration starts at the pose (R, t).

    A spot that the resulting pose does not project makes the likelihood 0. An update that does not converge leaves the
    state as it was, with the misfit that was reached.
    """
    if obs.timed:
        return timed_update(obs, prior, assigned, R, t)
    use, uv, cov = chosen_points(obs.frame, assigned, obs.calibration_cov)
    count = 0
    for i in range(use.shape[0]):
        count += 1 if use[i] else 0
    if count == 0:
        return Update(State(prior.R, prior.t, prior.m.copy(), prior.P.copy()), 0.0, 0.0, 0)
    pose_P = block(prior.P, 6)
    mode = _posterior_mode(obs.views, (prior.R, prior.t, pose_P), use, uv, cov, (R, t))
    if mode.log_likelihood == -np.inf:
        unchanged = State(prior.R, prior.t, prior.m.copy(), prior.P.copy())
        return Update(unchanged, mode.log_likelihood, mode.chi2, count)
    # Along a poorly observed direction the spots' paths are not straight. Their linearisation error must not make that
    # direction look observed: it is added to their covariances, and the update is repeated.
    sigma = add_curvature_covariance(obs.views, use, cov, mode.R, mode.t, mode.P)
    if sigma > 0.0:
        mode = _posterior_mode(obs.views, (prior.R, prior.t, pose_P), use, uv, cov, (mode.R, mode.t))
    if not mode.converged or sigma > MAX_UPDATE_SIGMA:
        # Few spots of a vehicle that may be anywhere: nothing that a linearisation could represent.
        unchanged = State(prior.R, prior.t, prior.m.copy(), prior.P.copy())
        return Update(unchanged, mode.log_likelihood, mode.chi2, count)
    out_R, out_t, out_m, out_P, _, _ = updated(prior.R, prior.t, prior.m, prior.P, mode.information, mode.vector)
    return Update(State(out_R, out_t, out_m, out_P), mode.log_likelihood, mode.chi2, count)


@compiled
def _posterior_mode(
    views: Views, prior: tuple[Array, Array, Array], use: Bools, uv: Array, cov: Array, start: tuple[Array, Array]
) -> _Mode:
    """Most probable pose given a prior (R, t, P of the pose) and the used spots: Gauss-Newton with halved steps.

    use (n,), uv (n, 2), px, cov (n, 2, 2), px^2; start: R, t.
    """
    R0, t0, P0 = prior
    R, t = start
    spots = 0
    for i in range(use.shape[0]):
        spots += 1 if use[i] else 0
    eye = np.zeros((6, 6))
    for i in range(6):
        eye[i, i] = 1.0
    prior_information, _ = solve(P0, eye)
    delta = pose_minus(R, t, R0, t0)
    L, g, chi2, count, log_norm = frame_information(views, R, t, use, uv, cov)
    cost = chi2 + quadratic_form(prior_information, delta) if count == spots else np.inf
    P, b, log_det, converged = P0, np.zeros(6), 0.0, False
    for _ in range(MAX_STEPS):
        # The prior's tangent differs from that of the pose: without this the steps converge slowly where the two are
        # far apart, and not to the mode (beyond 0.3 rad not within the steps that there are).
        A, b = _in_tangent_of_prior(L, g, delta)
        P, log_det = posterior(P0, A)
        step = apply(P, _sum(apply(A, delta), b))
        for i in range(6):
            step[i] -= delta[i]
        # A hundredth of the pose's own sigma is accurate enough.
        converged = count == spots and dot(step, apply(A, step)) < 1e-4
        better = False
        for _ in range(MAX_HALVINGS):
            if converged:
                break
            delta_new = np.empty(6)
            for i in range(6):
                delta_new[i] = delta[i] + step[i]
                step[i] *= 0.5
            R_new, t_new = pose_plus(R0, t0, delta_new)
            L_new, g_new, chi2_new, count_new, norm_new = frame_information(views, R_new, t_new, use, uv, cov)
            cost_new = chi2_new + quadratic_form(prior_information, delta_new)
            if count_new == spots and cost_new < cost:
                R, t, delta, cost, better = R_new, t_new, delta_new, cost_new, True
                L, g, chi2, count, log_norm = L_new, g_new, chi2_new, count_new, norm_new
                break
        if not better:
            break
    # Rounding can make the misfit negative where the prior is wide; a likelihood must not exceed that of a perfect fit.
    misfit = max(cost, 0.0)
    log_likelihood = -0.5 * (log_norm + log_det + misfit) if np.isfinite(misfit) else -np.inf
    # The update's covariance refers to the tangent of the pose.
    return _Mode(R, t, P, L, _sum(apply(L, delta), b), log_likelihood, misfit, converged)


@compiled
def _in_tangent_of_prior(L: Array, g: Array, delta: Array) -> tuple[Array, Array]:
    """Normal matrix (6, 6) and vector (6,) by delta (6,), the pose minus the prior's, from those by the pose."""
    T, turn = np.zeros((6, 6)), np.empty(3)
    for i in range(3):
        turn[i] = delta[3 + i]
    J = right_jacobian(turn)
    for i in range(3):
        T[i, i] = 1.0
        for j in range(3):
            T[3 + i, 3 + j] = J[i, j]
    return transposed_multiply(T, multiply(L, T)), transposed_apply(T, g)


@compiled
def _sum(x: Array, y: Array) -> Array:
    """x + y, for vectors (n,)."""
    out = np.empty(x.shape[0])
    for i in range(x.shape[0]):
        out[i] = x[i] + y[i]
    return out
