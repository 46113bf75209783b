"""Two measures of a motion: the cost of its process noise, and its leave-one-out likelihood; compiled."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array
from geometry.compilation.jit import compiled
from geometry.compiled_linalg import apply, block, column, hstack, multiply, pose_minus, solve
from tracking.rigid_body.models.motion import propagated, transition
from tracking.smoothing.motion.axis_noise import noise_root
from tracking.smoothing.motion.fixed_interval import RunInformation
from tracking.smoothing.motion.reference import Reference


@compiled
def motion_cost(ref: Reference, info: RunInformation, jerk: Array) -> float:
    """Half the squared Mahalanobis length of the process noise that a reference motion needs, nats."""
    total = 0.0
    w = np.empty(3)
    for k in range(1, info.dt.shape[0]):
        _, turn = transition(ref.m[k - 1], info.dt[k])
        R, t, m = propagated(ref.R[k - 1], ref.t[k - 1], ref.m[k - 1], info.dt[k], turn)
        d = pose_minus(ref.R[k], ref.t[k], R, t)
        for i in range(6):
            root = noise_root(info.dt[k], jerk[k, i], info.velocity_jump[k, i // 3], info.acceleration_jump[k, i // 3])
            w[0], w[1], w[2] = d[i], ref.m[k, i] - m[i], ref.m[k, 6 + i] - m[6 + i]
            for a in range(3):
                s = w[a]
                for b in range(a):
                    s -= root[a, b] * w[b]
                w[a] = s / root[a, a]
                total += 0.5 * w[a] * w[a]
    return total


@compiled
def leave_one_out_log_likelihood(x: Array, P: Array, info: RunInformation) -> float:
    """Sum of the log-likelihoods of each frame's measurement given all other frames, nats, up to a constant.

    x (T, 18), P (T, 6, 6): smoothed deviations and their poses' covariances. The leave-one-out predictive likelihood
    (Geisser & Eddy 1979) measures how well the motion between frames is known, which is the purpose of a smoother.
    """
    total = 0.0
    r = np.empty((6, 1))
    for k in range(info.dt.shape[0]):
        L, g = info.information[k], info.vector[k]
        if L[0, 0] == 0.0:
            continue
        # Remove the frame's own information: (I - P L)^-1 of P and of the deviation.
        A, d = multiply(P[k], L), apply(P[k], g)
        for i in range(6):
            for j in range(6):
                A[i, j] = (1.0 if i == j else 0.0) - A[i, j]
            d[i] = x[k, i] - d[i]
        alone, _ = solve(A, hstack(P[k], d))
        d, P_alone = column(alone, 6), block(alone, 6)
        Ld, B = apply(L, d), multiply(L, P_alone)
        for i in range(6):
            r[i, 0] = g[i] - Ld[i]
            B[i, i] += 1.0
        w, log_det = solve(B, r)
        step = multiply(P_alone, w)
        misfit = 0.0
        for i in range(6):
            misfit += d[i] * (Ld[i] - 2 * g[i]) - r[i, 0] * step[i, 0]
        total -= 0.5 * (log_det + misfit)
    return total
