"""How a rigid body moves: pose, velocities and accelerations, with white jerk; one compiled step of the filter.

State: world_from_body (R, t), and m (12,): velocity (m/s, world), rate (rad/s, body), acceleration (m/s^2, world),
angular acceleration (rad/s^2, body). Error state (18): [dt, dtheta, dvelocity, drate, dacceleration, dangular], the
first six as in the files' contract. Source: ours; error state after Sola (2017), "Quaternion kinematics for the
error-state Kalman filter", sec. 5; white jerk after Bar-Shalom, Li & Kirubarajan (2001), sec. 6.2.3.
"""

from __future__ import annotations

import numpy as np

from geometry import small
from geometry.arrays import Array
from geometry.compiled import compiled

POSE, VELOCITY, ACCELERATION = slice(0, 6), slice(6, 12), slice(12, 18)
STATE = 18

_multiply, _exp, _right_jacobian, _symmetrise = small.multiply, small.exp, small.right_jacobian, small.symmetrise
_apply, _solve, _moved = small.apply, small.solve, small.moved
_block, _column, _beside = small.block, small.column, small.beside


@compiled
def predicted(
    R: Array, t: Array, m: Array, P: Array, dt: float, jerk: Array, jump: Array, unsteady: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """One step of dt (s) on: R, t, m, P and the transition matrix F (18, 18) of the error state.

    jerk (2,): spectral densities of the white jerk, (m/s^3)^2/Hz and (rad/s^3)^2/Hz, of translation and rotation.
    jump (2,): variances by which the velocities may jump at the step's beginning, (m/s)^2 and (rad/s)^2.
    unsteady (2,): the same of the accelerations.
    """
    h = 0.5 * dt * dt
    turn, back = np.empty(3), np.empty(3)
    for i in range(3):
        turn[i] = dt * m[3 + i] + h * m[9 + i]
        back[i] = -turn[i]
    E = _exp(back)
    G = _right_jacobian(turn)
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
    start = P.copy()
    for i in range(STATE):
        if 6 <= i < 12:
            start[i, i] += jump[(i - 6) // 3]
        elif i >= 12:
            start[i, i] += unsteady[(i - 12) // 3]
    out = _transformed(F, start)
    for i in range(6):
        q = jerk[i // 3]
        out[i, i] += q * dt**5 / 20
        out[i, i + 6] += q * dt**4 / 8
        out[i + 6, i] += q * dt**4 / 8
        out[i, i + 12] += q * dt**3 / 6
        out[i + 12, i] += q * dt**3 / 6
        out[i + 6, i + 6] += q * dt**3 / 3
        out[i + 6, i + 12] += q * dt**2 / 2
        out[i + 12, i + 6] += q * dt**2 / 2
        out[i + 12, i + 12] += q * dt
    _symmetrise(out)
    t_new, m_new = t.copy(), m.copy()
    for i in range(3):
        t_new[i] = t[i] + dt * m[i] + h * m[6 + i]
    for i in range(6):
        m_new[i] += dt * m[6 + i]
    return _multiply(R, _exp(turn)), t_new, m_new, out, F


@compiled
def _transformed(F: Array, P: Array) -> Array:
    """F P F^T, where each row of F has few entries."""
    half = _multiply(F, P)
    n = F.shape[0]
    out = np.zeros((n, n))
    for j in range(n):
        for k in range(n):
            f = F[j, k]
            if f != 0.0:
                for i in range(n):
                    out[i, j] += half[i, k] * f
    return out


@compiled
def updated(
    R: Array, t: Array, m: Array, P: Array, information: Array, r: Array
) -> tuple[Array, Array, Array, Array, float, Array]:
    """After a measurement of the pose with information matrix (6, 6), which may lack rank, and vector r (6,).

    r = J^T C^-1 (measured - expected), J and C of the measurement, at this pose. Returns R, t, m, P, then
    log det(I + P information), which with the whitened misfit makes the likelihood, and w (6,) = S^-1 (innovation) in
    pose space: w^T P w is the part of the misfit that the motion takes.
    """
    A = _multiply(information, _block(P, 6))
    for i in range(6):
        A[i, i] += 1.0
    x, log_det = _solve(A, _beside(information, r))  # (I + L P)^-1 [L, r]
    w = _column(x, 6)
    half = np.zeros((STATE, 6))
    step = np.zeros(STATE)
    for i in range(STATE):
        for j in range(6):
            p = P[i, j]
            step[i] += p * w[j]
            for k in range(6):
                half[i, k] += p * x[j, k]
    out = P.copy()
    for i in range(STATE):
        for j in range(i + 1):
            s = 0.0
            for k in range(6):
                s += half[i, k] * P[j, k]
            out[i, j] -= s
            out[j, i] = out[i, j]
    R_new, t_new = _moved(R, t, step)
    m_new = m.copy()
    for i in range(12):
        m_new[i] += step[6 + i]
    return R_new, t_new, m_new, out, log_det, w
