"""The fixed-interval smoother, compiled: what a whole run says of the motion at each of its frames.

Deviations (18) from a reference motion are filtered forward; an information filter runs backward; each frame's result
combines the two (the two-filter smoother). Every covariance is a product of triangular factors
(geometry/compiled_linalg.py: posterior), so it is positive definite whatever the rounding. A new reference and
again is Gauss-Newton on the whole run at the cost of a filter. Sources: Fraser & Potter (1969), "The optimum linear
smoother as a combination of two optimum linear filters"; the iteration: Bell (1994), "The iterated Kalman smoother as a
Gauss-Newton method"; on a manifold, and with measurements as information: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry import compiled_linalg
from geometry.arrays import Array
from geometry.compilation.jit import compiled
from tracking.rigid_body.motion import STATE, predicted, process_noise, propagated, transition

CHUNK = 512  # frames whose covariances are in memory at once; the filter is run twice instead

_apart, _multiply, _apply, _solve = (
    compiled_linalg.pose_minus,
    compiled_linalg.multiply,
    compiled_linalg.apply,
    compiled_linalg.solve,
)
_symmetrise, _moved, _posterior = compiled_linalg.symmetrise, compiled_linalg.pose_plus, compiled_linalg.posterior
_transposed_multiply, _transposed_apply = compiled_linalg.transposed_multiply, compiled_linalg.transposed_apply
_cholesky = compiled_linalg.cholesky
_block, _column, _beside = compiled_linalg.block, compiled_linalg.column, compiled_linalg.hstack
_put, _put_matrix = compiled_linalg.copy_into, compiled_linalg.copy_matrix_into


class Reference(NamedTuple):
    """A motion, T frames, about which everything is linear; as in tracking/rigid_body/motion.py."""

    R: Array  # (T, 3, 3)
    t: Array  # (T, 3), m
    m: Array  # (T, 12)


def speeds(m: Array) -> Array:
    """The sizes (..., 2) of velocity, m/s, and angular rate, rad/s, of motions (..., 12)."""
    return np.stack([np.linalg.norm(m[..., :3], axis=-1), np.linalg.norm(m[..., 3:6], axis=-1)], axis=-1)


class FrameInformation(NamedTuple):
    """What the spots of each frame say of its pose at the reference, and how the vehicle may move before it."""

    information: Array  # (T, 6, 6) J^T C^-1 J; 0 without spots
    vector: Array  # (T, 6) J^T C^-1 (measured - expected)
    dt: Array  # (T,) s since the frame before
    jump: Array  # (T, 2) variances of jumps of the velocities, (m/s)^2 and (rad/s)^2, in that step
    unsteady: Array  # (T, 2) and of the accelerations
    first: Array  # (18,) variances of the first frame's deviation


class Interval(NamedTuple):
    """The smoother's result, T frames."""

    x: Array  # (T, 18) deviations from the reference
    pose_P: Array  # (T, 6, 6)
    motion_P: Array  # (T, 6, 6) of the velocities
    shock: Array  # (T,) chi-square (6 degrees) of a jump of the velocities in the step before, beyond what is allowed
    energy: Array  # (T, 6) by axis, of the step before: r^T Q r, r the score of the process noise ...
    gamma: Array  # (T, 6) ... and tr(Q N), its expectation: how many numbers of the noise the evidence determines
    ends_P: Array  # (2, 18, 18) covariance of the whole state at the first frame and at the last


@compiled
def _step(ref: Reference, ev: FrameInformation, jerk: Array, k: int, x: Array, P: Array) -> tuple[Array, Array]:
    """From frame k - 1 to frame k: deviation and covariance."""
    R, t, m, P_new, F = predicted(
        ref.R[k - 1], ref.t[k - 1], ref.m[k - 1], P, ev.dt[k], jerk[k], ev.jump[k], ev.unsteady[k]
    )
    x_new = _apply(F, x)
    d = _apart(R, t, ref.R[k], ref.t[k])
    for i in range(6):
        x_new[i] += d[i]
    for i in range(12):
        x_new[6 + i] += m[i] - ref.m[k, i]
    return x_new, P_new


@compiled
def _update(ev: FrameInformation, k: int, x: Array, P: Array) -> tuple[Array, Array, float]:
    """Frame k's measurement: deviation and covariance after it, and its log-likelihood up to a constant."""
    L, g = ev.information[k], ev.vector[k]
    if L[0, 0] == 0.0 and L[3, 3] == 0.0:
        return x, P, 0.0
    out, log_det = _posterior(P, L)
    r = _apply(L, x[:6])
    misfit = 0.0
    for i in range(6):
        misfit += x[i] * (r[i] - 2 * g[i])
        r[i] = g[i] - r[i]
    x_new = x.copy()
    for i in range(STATE):
        for j in range(6):
            x_new[i] += out[i, j] * r[j]
    for i in range(6):
        misfit -= r[i] * (x_new[i] - x[i])
    return x_new, out, -0.5 * (log_det + misfit)


@compiled
def _before_all(ev: FrameInformation) -> tuple[Array, Array]:
    """The first frame's deviation (18,) and its covariance (18, 18) before anything was seen."""
    P = np.zeros((STATE, STATE))
    for i in range(STATE):
        P[i, i] = ev.first[i]
    return np.zeros(STATE), P


@compiled
def log_likelihood(ref: Reference, ev: FrameInformation, jerk: Array) -> float:
    """How likely the evidence is for a motion with this jerk (T, 6), nats, up to a constant."""
    x, P = _before_all(ev)
    total = 0.0
    for k in range(ev.dt.shape[0]):
        if k > 0:
            x, P = _step(ref, ev, jerk, k, x, P)
        x, P, gained = _update(ev, k, x, P)
        total += gained
    return total


@compiled
def _noise_root(dt: float, jerk: float, jump: float, unsteady: float) -> Array:
    """The lower triangular root (3, 3) of one axis' process noise."""
    Q = np.empty((3, 3))
    Q[0, 0], Q[0, 1], Q[0, 2], Q[1, 1], Q[1, 2], Q[2, 2] = process_noise(dt, jerk, jump, unsteady)
    Q[1, 0], Q[2, 0], Q[2, 1] = Q[0, 1], Q[0, 2], Q[1, 2]
    return _cholesky(Q)


@compiled
def _without_noise(Y: Array, y: Array, axis: int, root: Array) -> None:
    """The information of x - w, in place, from that of x: (Y^-1 + Q)^-1 with Q = root root^T of one axis of w."""
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
    # With W W^T = A: subtract the square of Z W^-T.
    W = _cholesky(A)
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


@compiled
def _back(ref: Reference, ev: FrameInformation, jerk: Array, k: int, Y: Array, y: Array) -> tuple[Array, Array]:
    """The information about frame k - 1 that all frames from k on hold, from that about frame k; Y, y are spoiled."""
    for axis in range(6):
        _without_noise(
            Y, y, axis, _noise_root(ev.dt[k], jerk[k, axis], ev.jump[k, axis // 3], ev.unsteady[k, axis // 3])
        )
    F, turn = transition(ref.m[k - 1], ev.dt[k])
    R, t, m = propagated(ref.R[k - 1], ref.t[k - 1], ref.m[k - 1], ev.dt[k], turn)
    away = np.empty(STATE)
    _put(away, _apart(R, t, ref.R[k], ref.t[k]))
    for i in range(12):
        away[6 + i] = m[i] - ref.m[k, i]
    shift = _apply(Y, away)
    for i in range(STATE):
        y[i] -= shift[i]
    out = _transposed_multiply(F, _multiply(Y, F))
    _symmetrise(out)
    return out, _transposed_apply(F, y)


@compiled
def smoothed(ref: Reference, ev: FrameInformation, jerk: Array) -> Interval:
    """Of all frames given the whole run: deviations, covariances, and what the evidence says of the process noise.

    jerk (T, 6): spectral densities, as in motion.py, of the step before each frame. The shock is the test of de Jong &
    Penzer (1998), "Diagnosing shocks in time series", of an impulse in the middle of the step. energy and gamma are the
    two sides of MacKay's fixed point (1992), "Bayesian interpolation", for the strength of the noise.
    """
    frames = ev.dt.shape[0]
    out_x = np.empty((frames, STATE))
    pose_P, motion_P = np.empty((frames, 6, 6)), np.empty((frames, 6, 6))
    shock, energy, gamma = np.zeros(frames), np.zeros((frames, 6)), np.zeros((frames, 6))
    ends_P = np.empty((2, STATE, STATE))
    chunks = (frames + CHUNK - 1) // CHUNK
    start_x, start_P = np.zeros((chunks, STATE)), np.zeros((chunks, STATE, STATE))
    x, P = _before_all(ev)
    for k in range(frames):
        if k > 0:
            x, P = _step(ref, ev, jerk, k, x, P)
        if k % CHUNK == 0:
            _put(start_x[k // CHUNK], x)
            _put_matrix(start_P[k // CHUNK], P)
        x, P, _ = _update(ev, k, x, P)
    room = min(CHUNK, frames)
    xs, Ps = np.empty((room, STATE)), np.empty((room, STATE, STATE))
    Y, y = np.zeros((STATE, STATE)), np.zeros(STATE)  # what the frames after one say of it
    for chunk in range(chunks - 1, -1, -1):
        begin, end = chunk * CHUNK, min((chunk + 1) * CHUNK, frames)
        x, P = start_x[chunk].copy(), start_P[chunk].copy()
        for k in range(begin, end):
            if k > begin:
                x, P = _step(ref, ev, jerk, k, x, P)
            x, P, _ = _update(ev, k, x, P)
            _put(xs[k - begin], x)
            _put_matrix(Ps[k - begin], P)
        for k in range(end - 1, begin - 1, -1):
            x = xs[k - begin]
            P, _ = _posterior(Ps[k - begin], Y)
            score = _apply(Y, x)
            for i in range(STATE):
                score[i] = y[i] - score[i]
            change = _apply(P, score)
            for i in range(STATE):
                out_x[k, i] = x[i] + change[i]
            for a in range(6):
                for b in range(6):
                    pose_P[k, a, b] = P[a, b]
                    motion_P[k, a, b] = P[6 + a, 6 + b]
            if k == frames - 1:
                _put_matrix(ends_P[1], P)
            if k == 0:
                _put_matrix(ends_P[0], P)
                break
            for a in range(6):
                y[a] += ev.vector[k, a]
                for b in range(6):
                    Y[a, b] += ev.information[k, a, b]
            _process_noise_test(ev, jerk, k, Y, y, out_x[k], P, shock, energy, gamma)
            Y, y = _back(ref, ev, jerk, k, Y, y)
    return Interval(out_x, pose_P, motion_P, shock, energy, gamma, ends_P)


@compiled
def _process_noise_test(
    ev: FrameInformation,
    jerk: Array,
    k: int,
    Y: Array,
    y: Array,
    x: Array,
    P: Array,
    shock: Array,
    energy: Array,
    gamma: Array,
) -> None:
    """Fill in row k of shock, energy and gamma: the score r = y - Y x of the noise before frame k, N = Y - Y P Y its
    covariance; Y, y: information of frame k and all after it; x (18,), P (18, 18): the smoothed state.
    """
    r, N = _apply(Y, x), _multiply(Y, _multiply(P, Y))
    for i in range(STATE):
        r[i] = y[i] - r[i]
        for j in range(STATE):
            N[i, j] = Y[i, j] - N[i, j]
    dt = ev.dt[k]
    B, b = np.empty((6, 6)), np.empty(6)
    h = 0.5 * dt
    for i in range(6):
        pp, pv, pa, vv, va, aa = process_noise(dt, jerk[k, i], ev.jump[k, i // 3], ev.unsteady[k, i // 3])
        p, v, a = r[i], r[6 + i], r[12 + i]
        energy[k, i] = pp * p * p + vv * v * v + aa * a * a + 2 * (pv * p * v + pa * p * a + va * v * a)
        gamma[k, i] = max(
            pp * N[i, i]
            + vv * N[6 + i, 6 + i]
            + aa * N[12 + i, 12 + i]
            + 2 * (pv * N[i, 6 + i] + pa * N[i, 12 + i] + va * N[6 + i, 12 + i]),
            0.0,
        )
        b[i] = h * p + v
        for j in range(6):
            B[i, j] = h * h * N[i, j] + h * (N[6 + i, j] + N[i, 6 + j]) + N[6 + i, 6 + j]
    _symmetrise(B)
    shock[k] = _chi_square(B, b)


@compiled
def _chi_square(L: Array, x: Array) -> float:
    """x^T L^-1 x of information L (6, 6), in units that make its diagonal 1; 0 where it says nothing of some axis."""
    A, b, scale = np.empty((6, 6)), np.empty((6, 1)), np.empty(6)
    for i in range(6):
        if not L[i, i] > 1e-12:
            return 0.0
        scale[i] = np.sqrt(L[i, i])
    for i in range(6):
        b[i, 0] = x[i] / scale[i]
        for j in range(6):
            A[i, j] = L[i, j] / (scale[i] * scale[j])
        A[i, i] += 1e-6
    z, _ = _solve(A, b)
    total = 0.0
    for i in range(6):
        total += b[i, 0] * z[i, 0]
    return total


@compiled
def motion_cost(ref: Reference, ev: FrameInformation, jerk: Array) -> float:
    """Half the squared Mahalanobis length of the process noise that a reference motion needs, nats."""
    total = 0.0
    w = np.empty(3)
    for k in range(1, ev.dt.shape[0]):
        _, turn = transition(ref.m[k - 1], ev.dt[k])
        R, t, m = propagated(ref.R[k - 1], ref.t[k - 1], ref.m[k - 1], ev.dt[k], turn)
        d = _apart(ref.R[k], ref.t[k], R, t)
        for i in range(6):
            root = _noise_root(ev.dt[k], jerk[k, i], ev.jump[k, i // 3], ev.unsteady[k, i // 3])
            w[0], w[1], w[2] = d[i], ref.m[k, i] - m[i], ref.m[k, 6 + i] - m[6 + i]
            for a in range(3):
                s = w[a]
                for b in range(a):
                    s -= root[a, b] * w[b]
                w[a] = s / root[a, a]
                total += 0.5 * w[a] * w[a]
    return total


@compiled
def leave_one_out_log_likelihood(x: Array, P: Array, ev: FrameInformation) -> float:
    """How likely each frame's evidence is given that of all the others, summed, nats, up to a constant.

    x (T, 18), P (T, 6, 6): the smoothed deviations and their poses' covariances. The leave-one-out predictive
    likelihood (Geisser & Eddy 1979): it asks how well the motion between frames is known, which is what a smoother is
    for.
    """
    total = 0.0
    r = np.empty((6, 1))
    for k in range(ev.dt.shape[0]):
        L, g = ev.information[k], ev.vector[k]
        if L[0, 0] == 0.0:
            continue
        # Take the frame's own evidence away again: (I - P L)^-1 of P and of the deviation.
        A, d = _multiply(P[k], L), _apply(P[k], g)
        for i in range(6):
            for j in range(6):
                A[i, j] = (1.0 if i == j else 0.0) - A[i, j]
            d[i] = x[k, i] - d[i]
        alone, _ = _solve(A, _beside(P[k], d))
        d, P_alone = _column(alone, 6), _block(alone, 6)
        Ld, B = _apply(L, d), _multiply(L, P_alone)
        for i in range(6):
            r[i, 0] = g[i] - Ld[i]
            B[i, i] += 1.0
        w, log_det = _solve(B, r)
        step = _multiply(P_alone, w)
        misfit = 0.0
        for i in range(6):
            misfit += d[i] * (Ld[i] - 2 * g[i]) - r[i, 0] * step[i, 0]
        total -= 0.5 * (log_det + misfit)
    return total


@compiled
def shifted(ref: Reference, x: Array) -> Reference:
    """The reference moved by deviations (T, 18)."""
    R, t, m = ref.R.copy(), ref.t.copy(), ref.m.copy()
    for k in range(ref.t.shape[0]):
        R_k, t_k = _moved(ref.R[k], ref.t[k], x[k])
        _put_matrix(R[k], R_k)
        _put(t[k], t_k)
        for i in range(12):
            m[k, i] += x[k, 6 + i]
    return Reference(R, t, m)
