"""The fixed-interval smoother, compiled: what a whole run says of the motion at each of its frames.

Deviations (18) from a reference motion are filtered forward and smoothed backward; a new reference and again, which is
Gauss-Newton on the whole run at the cost of a filter. Sources: the backward pass is the modified Bryson-Frazier form
(Bierman 1973, "Fixed interval smoothing with discrete measurements"), which inverts nothing but the (6, 6) of the
measurement; the iteration Bell (1994), "The iterated Kalman smoother as a Gauss-Newton method". On a manifold, and with
measurements as information: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry import small
from geometry.arrays import Array
from geometry.compiled import compiled
from tracking.motion import STATE, predicted

CHUNK = 512  # frames whose covariances are in memory at once; the filter is run twice instead

_apart, _multiply, _apply, _solve = small.apart, small.multiply, small.apply, small.solve
_symmetrise, _moved = small.symmetrise, small.moved
_transposed_multiply, _transposed_apply = small.transposed_multiply, small.transposed_apply
_block, _column, _beside = small.block, small.column, small.beside
_put, _put_matrix = small.put, small.put_matrix


class Reference(NamedTuple):
    """A motion, T frames, about which everything is linear; as in tracking/motion.py."""

    R: Array  # (T, 3, 3)
    t: Array  # (T, 3), m
    m: Array  # (T, 12)


class Evidence(NamedTuple):
    """What the spots of each frame say of its pose at the reference, and how the vehicle may move before it."""

    information: Array  # (T, 6, 6) J^T C^-1 J; 0 without spots
    vector: Array  # (T, 6) J^T C^-1 (measured - expected)
    dt: Array  # (T,) s since the frame before
    jump: Array  # (T, 2) variances of jumps of the velocities, (m/s)^2 and (rad/s)^2, in that step
    unsteady: Array  # (T, 2) and of the accelerations
    first: Array  # (18,) variances of the first frame's deviation


@compiled
def _step(ref: Reference, ev: Evidence, jerk: Array, k: int, x: Array, P: Array) -> tuple[Array, Array, Array]:
    """From frame k - 1 to frame k: deviation, covariance and transition matrix."""
    R, t, m, P_new, F = predicted(
        ref.R[k - 1], ref.t[k - 1], ref.m[k - 1], P, ev.dt[k], jerk[k], ev.jump[k], ev.unsteady[k]
    )
    x_new = _apply(F, x)
    d = _apart(R, t, ref.R[k], ref.t[k])
    for i in range(6):
        x_new[i] += d[i]
    for i in range(12):
        x_new[6 + i] += m[i] - ref.m[k, i]
    return x_new, P_new, F


@compiled
def _update(ev: Evidence, k: int, x: Array, P: Array) -> tuple[Array, Array, Array, Array, float]:
    """Frame k's measurement: deviation and covariance after it, w (6,) and M (6, 6), and its log-likelihood.

    w = S^-1 innovation and M = S^-1 in pose space. The likelihood is up to what does not depend on the motion.
    """
    L, g = ev.information[k], ev.vector[k]
    Lx, r = _apply(L, x[:6]), np.empty(6)
    A = _multiply(L, _block(P, 6))
    for i in range(6):
        r[i] = g[i] - Lx[i]
        A[i, i] += 1.0
    y, log_det = _solve(A, _beside(L, r))
    w, M = _column(y, 6), _block(y, 6)
    _symmetrise(M)
    step = np.zeros(STATE)
    half = np.zeros((STATE, 6))
    for i in range(STATE):
        for j in range(6):
            step[i] += P[i, j] * w[j]
            for c in range(6):
                half[i, c] += P[i, j] * M[j, c]
    out = P.copy()
    for i in range(STATE):
        for j in range(i + 1):
            s = 0.0
            for c in range(6):
                s += half[i, c] * P[j, c]
            out[i, j] -= s
            out[j, i] = out[i, j]
    misfit = 0.0
    for i in range(6):
        misfit += x[i] * (Lx[i] - 2 * g[i]) - r[i] * step[i]
    for i in range(STATE):
        step[i] += x[i]
    return step, out, w, M, -0.5 * (log_det + misfit)


@compiled
def _before_all(ev: Evidence) -> tuple[Array, Array]:
    """The first frame's deviation (18,) and its covariance (18, 18) before anything was seen."""
    P = np.zeros((STATE, STATE))
    for i in range(STATE):
        P[i, i] = ev.first[i]
    return np.zeros(STATE), P


@compiled
def log_likelihood(ref: Reference, ev: Evidence, jerk: Array) -> float:
    """How likely the evidence is for a motion with this jerk (T, 2), nats, up to a constant."""
    x, P = _before_all(ev)
    total = 0.0
    for k in range(ev.dt.shape[0]):
        if k > 0:
            x, P, _ = _step(ref, ev, jerk, k, x, P)
        x, P, _, _, gained = _update(ev, k, x, P)
        total += gained
    return total


@compiled
def smoothed(ref: Reference, ev: Evidence, jerk: Array) -> tuple[Array, Array, Array, Array]:
    """Of all frames given the whole run: deviations (T, 18), covariances (T, 6, 6) of pose and velocities, shocks (T,).

    A shock is the chi-square (6 degrees) of a jump of the velocities in the step before a frame, beyond what the motion
    allows there: de Jong & Penzer (1998), "Diagnosing shocks in time series".

    jerk (T, 2): spectral densities, as in motion.py, of the step before each frame.
    """
    frames = ev.dt.shape[0]
    out_x = np.empty((frames, STATE))
    pose_P, motion_P = np.empty((frames, 6, 6)), np.empty((frames, 6, 6))
    shock = np.zeros(frames)
    chunks = (frames + CHUNK - 1) // CHUNK
    start_x, start_P = np.zeros((chunks, STATE)), np.zeros((chunks, STATE, STATE))
    x, P = _before_all(ev)
    for k in range(frames):
        if k > 0:
            x, P, _ = _step(ref, ev, jerk, k, x, P)
        if k % CHUNK == 0:
            _put(start_x[k // CHUNK], x)
            _put_matrix(start_P[k // CHUNK], P)
        x, P, _, _, _ = _update(ev, k, x, P)
    later_x, later_L = np.zeros(STATE), np.zeros((STATE, STATE))  # what the frames after one say of it
    room = min(CHUNK, frames)
    xs, Ps, Fs = np.empty((room, STATE)), np.empty((room, STATE, STATE)), np.empty((room, STATE, STATE))
    ws, Ms, heads = np.empty((room, 6)), np.empty((room, 6, 6)), np.empty((room, STATE, 6))
    for chunk in range(chunks - 1, -1, -1):
        begin, end = chunk * CHUNK, min((chunk + 1) * CHUNK, frames)
        x, P = start_x[chunk].copy(), start_P[chunk].copy()
        for k in range(begin, end):
            if k > begin:
                x, P, F = _step(ref, ev, jerk, k, x, P)
                _put_matrix(Fs[k - begin], F)
            for a in range(STATE):
                for b in range(6):
                    heads[k - begin, a, b] = P[a, b]
            x, P, w, M, _ = _update(ev, k, x, P)
            _put(xs[k - begin], x)
            _put_matrix(Ps[k - begin], P)
            _put(ws[k - begin], w)
            _put_matrix(Ms[k - begin], M)
        if begin > 0:  # the step into the chunk, for the one before
            _, _, F = _step(ref, ev, jerk, begin, np.zeros(STATE), np.zeros((STATE, STATE)))
            _put_matrix(Fs[0], F)
        for k in range(end - 1, begin - 1, -1):
            j = k - begin
            P = Ps[j]
            change = _apply(P, later_x)
            for a in range(STATE):
                out_x[k, a] = xs[j, a] - change[a]
            S = _multiply(_multiply(P, later_L), P)
            for a in range(6):
                for b in range(6):
                    pose_P[k, a, b] = P[a, b] - 0.5 * (S[a, b] + S[b, a])
                    motion_P[k, a, b] = P[6 + a, 6 + b] - 0.5 * (S[6 + a, 6 + b] + S[6 + b, 6 + a])
            if k == 0:
                break
            # Back over the measurement: C = I - P[:, :6] M.
            C = np.zeros((STATE, STATE))
            gain = _multiply(heads[j], Ms[j])
            for a in range(STATE):
                for b in range(6):
                    C[a, b] = -gain[a, b]
                C[a, a] += 1.0
            back_L = _transposed_multiply(C, _multiply(later_L, C))
            back_x = _transposed_apply(C, later_x)
            for a in range(6):
                back_x[a] -= ws[j, a]
                for b in range(6):
                    back_L[a, b] += Ms[j, a, b]
            # And over the step before it.
            later_x = _transposed_apply(Fs[j], back_x)
            later_L = _transposed_multiply(Fs[j], _multiply(back_L, Fs[j]))
            _symmetrise(later_L)
            shock[k] = _chi_square(later_L, later_x)
    return out_x, pose_P, motion_P, shock


@compiled
def _chi_square(L: Array, x: Array) -> float:
    """x^T L^-1 x of the velocities' part, in units that make L's diagonal 1; 0 where nothing later tells of them."""
    A, b, scale = np.empty((6, 6)), np.empty((6, 1)), np.empty(6)
    for i in range(6):
        if not L[6 + i, 6 + i] > 1e-12:
            return 0.0
        scale[i] = np.sqrt(L[6 + i, 6 + i])
    for i in range(6):
        b[i, 0] = x[6 + i] / scale[i]
        for j in range(6):
            A[i, j] = L[6 + i, 6 + j] / (scale[i] * scale[j])
        A[i, i] += 1e-9
    y, _ = _solve(A, b)
    total = 0.0
    for i in range(6):
        total += b[i, 0] * y[i, 0]
    return total


def told_by_the_others(ref: Reference, ev: Evidence, jerk: Array) -> float:
    """How likely each frame's evidence is given that of all the others, summed, nats, up to a constant.

    The leave-one-out predictive likelihood (Geisser & Eddy 1979): it asks how well the motion between frames is known,
    which is what a smoother is for.
    """
    x, P, _, _ = smoothed(ref, ev, jerk)
    return float(_told_by_the_others(x, P, ev))


@compiled
def _told_by_the_others(x: Array, P: Array, ev: Evidence) -> float:
    """The same of smoothed deviations (T, 18) and their poses' covariances (T, 6, 6)."""
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
