"""Motion model of a rigid body: pose, velocities and accelerations driven by white jerk; compiled filter steps.

State: world_from_body (R, t), and m (12,): velocity (m/s, world), angular rate (rad/s, body), acceleration (m/s^2,
world), angular acceleration (rad/s^2, body). Error state (18): [dt, dtheta, dvelocity, drate, dacceleration,
dangular acceleration], the first six as in the files' contract. Source: ours; error state after Sola (2017),
"Quaternion kinematics for the error-state Kalman filter", sec. 5; white jerk after Bar-Shalom, Li & Kirubarajan (2001),
sec. 6.2.3.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array
from geometry.compilation.jit import compiled, compiled_in_caller
from geometry.compiled_linalg import exp, multiply, pose_plus, posterior, right_jacobian, symmetrise

STATE = 18  # numbers of the error state
# `later` and `spread` of `process_noise` for a jump at any moment. Python code passes them: numba takes .07 ms for a
# call that leaves an argument to its default.
ANY_MOMENT = (-1.0, 0.0)


@compiled
def process_noise(
    dt: float, jerk: float, velocity_jump: float, acceleration_jump: float, later: float = -1.0, spread: float = 0.0
) -> tuple[float, float, float, float, float, float]:
    """Covariance that a step of dt (s) adds to one axis: entries pp, pv, pa, vv, va, aa.

    p is the pose, v the velocity, a the acceleration. jerk: spectral density of the white jerk. velocity_jump: variance
    of an impulse that changes the velocity; acceleration_jump: variance of a change of the acceleration, each at an
    unknown moment of the step. With the moment uniformly distributed a velocity jump of variance J adds
    J [[dt^2/3, dt/2], [dt/2, 1]] to pose and velocity: the same as white acceleration of density J/dt (at a corner
    between two frames the vehicle leaves the old direction before it reaches the new one). Likewise a jump of the
    acceleration is white jerk. later, spread: how long before the end of the step the velocity jumps, s, and its
    sigma; -1: unknown.

    Source: Bar-Shalom, Li & Kirubarajan (2001), sec. 6.2.3 (white jerk); the uniform moment: ours.
    """
    q = jerk + acceleration_jump / dt
    if later >= 0.0:
        v = velocity_jump
        return (
            q * dt**5 / 20 + v * (later * later + spread * spread),
            q * dt**4 / 8 + v * later,
            q * dt**3 / 6,
            q * dt**3 / 3 + v,
            q * dt**2 / 2,
            q * dt,
        )
    w = velocity_jump / dt
    return (
        q * dt**5 / 20 + w * dt**3 / 3,
        q * dt**4 / 8 + w * dt**2 / 2,
        q * dt**3 / 6,
        q * dt**3 / 3 + w * dt,
        q * dt**2 / 2,
        q * dt,
    )


@compiled
def transition(m: Array, dt: float) -> tuple[Array, Array]:
    """Transition matrix F (18, 18) of the error state over dt (s), and the step's rotation vector (3,), rad."""
    h = 0.5 * dt * dt
    turn, back = np.empty(3), np.empty(3)
    for i in range(3):
        turn[i] = dt * m[3 + i] + h * m[9 + i]
        back[i] = -turn[i]
    E = exp(back)
    G = right_jacobian(turn)
    F = np.zeros((STATE, STATE))
    for i in range(STATE):
        F[i, i] = 1.0
    for i in range(3):
        F[i, 6 + i], F[i, 12 + i] = dt, h
        F[6 + i, 12 + i] = dt
        F[9 + i, 15 + i] = dt
        for j in range(3):
            F[3 + i, 3 + j] = E[i, j]
            F[3 + i, 9 + j] = dt * G[i, j]
            F[3 + i, 15 + j] = h * G[i, j]
    return F, turn


@compiled
def state_after(R: Array, t: Array, m: Array, dt: float) -> tuple[Array, Array, Array]:
    """Pose and motion after dt (s), which may be negative, with constant accelerations."""
    turn = np.empty(3)
    for i in range(3):
        turn[i] = dt * m[3 + i] + 0.5 * dt * dt * m[9 + i]
    return propagated(R, t, m, dt, turn)


@compiled
def propagated(R: Array, t: Array, m: Array, dt: float, turn: Array) -> tuple[Array, Array, Array]:
    """Pose and motion after dt (s) with constant accelerations; turn (3,): the step's rotation vector, rad."""
    h = 0.5 * dt * dt
    t_new, m_new = t.copy(), m.copy()
    for i in range(3):
        t_new[i] = t[i] + dt * m[i] + h * m[6 + i]
    for i in range(6):
        m_new[i] += dt * m[6 + i]
    return multiply(R, exp(turn)), t_new, m_new


@compiled
def predicted(
    R: Array, t: Array, m: Array, P: Array, dt: float, jerk: Array, velocity_jump: Array, acceleration_jump: Array,
    later: float = -1.0, spread: float = 0.0,
) -> tuple[Array, Array, Array, Array, Array]:  # fmt: skip
    """Prediction over a step of dt (s): R, t, m, P and the transition matrix F (18, 18) of the error state.

    jerk (6,): spectral densities of the white jerk, (m/s^3)^2/Hz of the three axes of world, then (rad/s^3)^2/Hz of
    those of body. velocity_jump (2,): variances of a jump of the velocities at an unknown moment of the step, (m/s)^2
    of the translation and (rad/s)^2 of the rotation. acceleration_jump (2,): the same of the accelerations. later,
    spread: of `process_noise`.
    """
    F, turn = transition(m, dt)
    out = _transformed(F, P)
    if dt > 0.0:
        for i in range(6):
            pp, pv, pa, vv, va, aa = process_noise(
                dt, jerk[i], velocity_jump[i // 3], acceleration_jump[i // 3], later, spread
            )
            out[i, i] += pp
            out[i, i + 6] += pv
            out[i + 6, i] += pv
            out[i, i + 12] += pa
            out[i + 12, i] += pa
            out[i + 6, i + 6] += vv
            out[i + 6, i + 12] += va
            out[i + 12, i + 6] += va
            out[i + 12, i + 12] += aa
    symmetrise(out)
    R_new, t_new, m_new = propagated(R, t, m, dt, turn)
    return R_new, t_new, m_new, out, F


@compiled_in_caller
def _transformed(F: Array, P: Array) -> Array:
    """F P F^T; zeros of F, which are most of its entries, are skipped."""
    half = multiply(F, P)
    n = F.shape[0]
    out = np.zeros((n, n))
    for j in range(n):
        for k in range(n):
            f = F[j, k]
            if f != 0.0:
                for i in range(n):
                    out[i, j] += half[i, k] * f
    return out


@compiled_in_caller
def updated(
    R: Array, t: Array, m: Array, P: Array, information: Array, r: Array
) -> tuple[Array, Array, Array, Array, float, Array]:
    """Kalman update by a measurement of the pose, in information form.

    information (6, 6), which may lack rank: J^T C^-1 J; r (6,): J^T C^-1 (measured - expected) at this pose. Returns R,
    t, m, P, then log det(I + P information), which with the misfit makes the likelihood, and the step (6,) of the pose.
    """
    out, log_det = posterior(P, information)
    step = np.zeros(STATE)
    for i in range(STATE):
        for j in range(6):
            step[i] += out[i, j] * r[j]
    R_new, t_new = pose_plus(R, t, step)
    m_new = m.copy()
    for i in range(12):
        m_new[i] += step[6 + i]
    return R_new, t_new, m_new, out, log_det, step[:6]
