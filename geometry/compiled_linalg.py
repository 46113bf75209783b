"""Linear algebra of small matrices and single rotations, compiled: for the trackers, which process frame by frame.

The rotations are those of geometry/rotations.py, which computes stacks with numpy and serves everything else;
tests/geometry/test_compiled_linalg.py compares the two. Matrices are C-ordered float64.

Loops replace array expressions on purpose: each array expression, assignment to a slice, sum or sort makes numba
compile a kernel of its own, 0.1 to 3 s on the user's first run, and runs no faster.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compilation.jit import compiled


@compiled
def copy_into(out: Array | Ints, x: Array | Ints) -> None:
    """out[:] = x, for vectors (n,)."""
    for i in range(x.shape[0]):
        out[i] = x[i]


@compiled
def copy_matrix_into(out: Array, a: Array) -> None:
    """out[:] = a, for matrices (n, m)."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[i, j] = a[i, j]


@compiled
def block(a: Array, n: int) -> Array:
    """A copy (n, n) of the first n rows and columns of a matrix."""
    out = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            out[i, j] = a[i, j]
    return out


@compiled
def column(a: Array, j: int) -> Array:
    """A copy (n,) of column j of a matrix (n, m)."""
    out = np.empty(a.shape[0])
    for i in range(a.shape[0]):
        out[i] = a[i, j]
    return out


@compiled
def hstack(a: Array, x: Array) -> Array:
    """[a, x] (n, m + 1): a matrix (n, m) with a vector (n,) as its last column."""
    n, m = a.shape
    out = np.empty((n, m + 1))
    for i in range(n):
        for j in range(m):
            out[i, j] = a[i, j]
        out[i, m] = x[i]
    return out


@compiled
def best_first(score: Array) -> Ints:
    """Indices (n,) that sort scores in descending order; equal scores keep their order."""
    n = score.shape[0]
    order = np.empty(n, np.int64)
    for i in range(n):
        place = i
        while place > 0 and score[order[place - 1]] < score[i]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = i
    return order


@compiled
def dot(x: Array, y: Array) -> float:
    """The scalar product of two vectors (n,)."""
    s = 0.0
    for i in range(x.shape[0]):
        s += x[i] * y[i]
    return s


@compiled
def multiply(a: Array, b: Array) -> Array:
    """a @ b of small matrices, for which a plain loop is faster than a library call."""
    n, m, k = a.shape[0], b.shape[1], a.shape[1]
    out = np.zeros((n, m))
    for i in range(n):
        for j in range(k):
            s = a[i, j]
            if s != 0.0:
                for c in range(m):
                    out[i, c] += s * b[j, c]
    return out


@compiled
def transposed_multiply(a: Array, b: Array) -> Array:
    """a^T @ b of small matrices."""
    n, m, k = a.shape[1], b.shape[1], a.shape[0]
    out = np.zeros((n, m))
    for i in range(n):
        for j in range(k):
            s = a[j, i]
            if s != 0.0:
                for c in range(m):
                    out[i, c] += s * b[j, c]
    return out


@compiled
def apply(a: Array, x: Array) -> Array:
    """a @ x of a small matrix and a vector."""
    out = np.zeros(a.shape[0])
    for i in range(a.shape[0]):
        s = 0.0
        for j in range(a.shape[1]):
            s += a[i, j] * x[j]
        out[i] = s
    return out


@compiled
def transposed_apply(a: Array, x: Array) -> Array:
    """a^T @ x of a small matrix and a vector."""
    out = np.zeros(a.shape[1])
    for i in range(a.shape[1]):
        s = 0.0
        for j in range(a.shape[0]):
            s += a[j, i] * x[j]
        out[i] = s
    return out


@compiled
def solve(a: Array, b: Array) -> tuple[Array, float]:
    """x (n, m) with a x = b, and log |det a|, by elimination with row pivoting; not finite where det a is 0."""
    n, m = a.shape[0], b.shape[1]
    lu, x = a.copy(), b.copy()
    log_det = 0.0
    for i in range(n):
        p = i
        for r in range(i + 1, n):
            if abs(lu[r, i]) > abs(lu[p, i]):
                p = r
        if p != i:
            for c in range(n):
                lu[i, c], lu[p, c] = lu[p, c], lu[i, c]
            for c in range(m):
                x[i, c], x[p, c] = x[p, c], x[i, c]
        log_det += np.log(abs(lu[i, i]))
        for r in range(i + 1, n):
            f = lu[r, i] / lu[i, i]
            if f != 0.0:
                for c in range(i + 1, n):
                    lu[r, c] -= f * lu[i, c]
                for c in range(m):
                    x[r, c] -= f * x[i, c]
    for i in range(n - 1, -1, -1):
        for c in range(m):
            s = x[i, c]
            for r in range(i + 1, n):
                s -= lu[i, r] * x[r, c]
            x[i, c] = s / lu[i, i]
    return x, log_det


MIN_PIVOT = 1e-15  # smallest pivot of a Cholesky factor relative to the diagonal entry; rounding can make it negative


@compiled
def cholesky(a: Array, least_pivot: float = 0.0) -> Array:
    """The lower triangular L (n, n) with L L^T = a, of a symmetric, positive semidefinite matrix.

    least_pivot: that no pivot is below but by rounding; 1 for I + B with a semidefinite B.
    """
    n = a.shape[0]
    out = np.zeros((n, n))
    for j in range(n):
        s = a[j, j]
        for k in range(j):
            s -= out[j, k] * out[j, k]
        least = max(MIN_PIVOT * a[j, j], least_pivot)
        known = s > least
        if not known:
            s = least
        if not s > 0.0:
            continue  # zero variance: the column stays 0
        root = np.sqrt(s)
        out[j, j] = root
        if not known:
            continue  # the rest of the column is rounding, too: over so small a pivot it would grow from row to row
        for i in range(j + 1, n):
            s = a[i, j]
            for k in range(j):
                s -= out[i, k] * out[j, k]
            out[i, j] = s / root
    return out


@compiled
def posterior(P: Array, information: Array) -> tuple[Array, float]:
    """(P^-1 + Y)^-1 of a covariance P (n, n), and log det(I + P Y); positive definite in spite of rounding.

    information (k, k), k <= n: Y of the first k numbers, 0 of the others; it may be singular. With P = S S^T the result
    is S (I + S^T Y S)^-1 S^T, a square. Nothing is subtracted, so a vague P and a precise Y lose no digits.
    """
    n, k = P.shape[0], information.shape[0]
    S = cholesky(P)
    half = np.zeros((k, k))  # Y S
    for i in range(k):
        for j in range(k):
            y = information[i, j]
            if y != 0.0:
                for c in range(j + 1):  # S is lower triangular
                    half[i, c] += y * S[j, c]
    M = np.zeros((k, k))  # of I + S^T Y S; the rest of it is that of I, and so is that of its factor
    for i in range(k):
        for a in range(i, k):
            s = S[a, i]
            if s != 0.0:
                for c in range(i + 1):
                    M[i, c] += s * half[a, c]
        for c in range(i):
            M[c, i] = M[i, c]
        M[i, i] += 1.0
    W = cholesky(M, 1.0)
    log_det = 0.0
    for i in range(k):
        log_det += 2 * np.log(W[i, i])
    # Z = W^-1 S^T
    Z = np.zeros((n, n))
    for i in range(n):
        for c in range(n):
            Z[i, c] = S[c, i]
    for i in range(k):
        for a in range(i):
            w = W[i, a]
            if w != 0.0:
                for c in range(n):
                    Z[i, c] -= w * Z[a, c]
        for c in range(n):
            Z[i, c] /= W[i, i]
    out = np.zeros((n, n))
    for a in range(n):
        for i in range(n):
            z = Z[a, i]
            if z != 0.0:
                for j in range(i + 1):
                    out[i, j] += z * Z[a, j]
    for i in range(n):
        for j in range(i):
            out[j, i] = out[i, j]
    return out, log_det


@compiled
def symmetrise(a: Array) -> None:
    """Replaces a matrix (n, n) by its symmetric part, in place."""
    n = a.shape[0]
    for i in range(n):
        for j in range(i):
            s = 0.5 * (a[i, j] + a[j, i])
            a[i, j] = s
            a[j, i] = s


@compiled
def exp(w: Array) -> Array:
    """The rotation matrix (3, 3) of a rotation vector (3,), rad."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if angle2 < 1e-8:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = np.sqrt(angle2)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    out = np.empty((3, 3))
    x, y, z = w[0], w[1], w[2]
    out[0, 0], out[1, 1], out[2, 2] = 1 - b * (y * y + z * z), 1 - b * (x * x + z * z), 1 - b * (x * x + y * y)
    out[0, 1], out[1, 0] = b * x * y - a * z, b * x * y + a * z
    out[0, 2], out[2, 0] = b * x * z + a * y, b * x * z - a * y
    out[1, 2], out[2, 1] = b * y * z - a * x, b * y * z + a * x
    return out


@compiled
def log(R: Array) -> Array:
    """The rotation vector (3,), rad, of a rotation matrix (3, 3), by way of the best conditioned quaternion."""
    q = np.empty(4)
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    i = 0
    if R[1, 1] > R[0, 0]:
        i = 1
    if R[2, 2] > R[i, i]:
        i = 2
    if trace > R[i, i]:
        q[0] = 1 + trace
        q[1], q[2], q[3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[0] = R[k, j] - R[j, k]
        q[1 + i] = 1 + R[i, i] - R[j, j] - R[k, k]
        q[1 + j] = R[j, i] + R[i, j]
        q[1 + k] = R[k, i] + R[i, k]
    length = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[0] < 0:
        length = -length
    for c in range(4):
        q[c] /= length
    s = np.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    factor = 2.0 if s < 1e-8 else 2.0 * np.arctan2(s, q[0]) / s
    w = np.empty(3)
    for c in range(3):
        w[c] = factor * q[1 + c]
    return w


@compiled
def right_jacobian(w: Array) -> Array:
    """The right Jacobian J_r (3, 3) of a rotation vector (3,): Exp(w + d) = Exp(w) Exp(J_r d) to first order."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if angle2 < 1e-8:
        a, b = 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
    else:
        angle = np.sqrt(angle2)
        a, b = (1.0 - np.cos(angle)) / angle2, (angle - np.sin(angle)) / (angle2 * angle)
    x, y, z = w[0], w[1], w[2]
    out = np.empty((3, 3))
    out[0, 0], out[1, 1], out[2, 2] = 1 - b * (y * y + z * z), 1 - b * (x * x + z * z), 1 - b * (x * x + y * y)
    out[0, 1], out[1, 0] = b * x * y + a * z, b * x * y - a * z
    out[0, 2], out[2, 0] = b * x * z - a * y, b * x * z + a * y
    out[1, 2], out[2, 1] = b * y * z + a * x, b * y * z - a * x
    return out


@compiled
def pose_plus(R: Array, t: Array, d: Array) -> tuple[Array, Array]:
    """The pose (R, t) changed by d (6,): R Exp(dtheta) and t + dt, as `Pose.plus`."""
    t_new = np.empty(3)
    for i in range(3):
        t_new[i] = t[i] + d[i]
    return multiply(R, exp(d[3:6])), t_new


@compiled
def pose_minus(R: Array, t: Array, R0: Array, t0: Array) -> Array:
    """The delta (6,) from the pose (R0, t0) to the pose (R, t), as `Pose.minus`."""
    out = np.empty(6)
    turn = log(transposed_multiply(R0, R))
    for i in range(3):
        out[i], out[3 + i] = t[i] - t0[i], turn[i]
    return out
