"""Process noise of one axis: its root, and its effect on information about the state; compiled."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array
from geometry.compilation.jit import compiled
from geometry.compiled_linalg import cholesky
from tracking.rigid_body.models.motion import process_noise


@compiled
def noise_root(dt: float, jerk: float, velocity_jump: float, acceleration_jump: float) -> Array:
    """Lower triangular root (3, 3) of one axis' process noise."""
    Q = np.empty((3, 3))
    Q[0, 0], Q[0, 1], Q[0, 2], Q[1, 1], Q[1, 2], Q[2, 2] = process_noise(dt, jerk, velocity_jump, acceleration_jump)
    Q[1, 0], Q[2, 0], Q[2, 1] = Q[0, 1], Q[0, 2], Q[1, 2]
    return cholesky(Q)


@compiled
def subtract_noise(Y: Array, y: Array, axis: int, root: Array) -> None:
    """Information about x - w from that about x, in place: (Y^-1 + Q)^-1, Q = root root^T of one axis of noise w."""
    n = Y.shape[0]
    Z, A, b = np.zeros((n, 3)), np.zeros((3, 3)), np.zeros((3, 1))
    for a in range(3):
        row = axis + 6 * a
        for c in range(a + 1):
            q = root[a, c]
            if q != 0.0:
                b[c, 0] += q * y[row]
                for i in range(n):
                    Z[i, c] += Y[i, row] * q
    for a in range(3):
        row = axis + 6 * a
        for c in range(a + 1):
            for e in range(3):
                A[c, e] += root[a, c] * Z[row, e]
    for c in range(3):
        A[c, c] += 1.0
        for e in range(c):
            A[c, e] = 0.5 * (A[c, e] + A[e, c])
            A[e, c] = A[c, e]
    # With W W^T = A, subtract Z W^-T (Z W^-T)^T.
    W = cholesky(A)
    for c in range(3):
        for e in range(c):
            w = W[c, e]
            for i in range(n):
                Z[i, c] -= Z[i, e] * w
            b[c, 0] -= b[e, 0] * w
        for i in range(n):
            Z[i, c] /= W[c, c]
        b[c, 0] /= W[c, c]
    for i in range(n):
        z0, z1, z2 = Z[i, 0], Z[i, 1], Z[i, 2]
        y[i] -= z0 * b[0, 0] + z1 * b[1, 0] + z2 * b[2, 0]
        for j in range(i + 1):
            Y[i, j] -= z0 * Z[j, 0] + z1 * Z[j, 1] + z2 * Z[j, 2]
            Y[j, i] = Y[i, j]
