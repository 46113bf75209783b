"""Fixed-interval smoother, compiled: the motion at each frame given the whole run, its cost and its predictions.

A two-filter smoother. Deviations (18) from a reference motion are filtered forward; an information filter runs
backward; each frame's result combines the two. Every covariance is a product of triangular factors
(geometry/compiled_linalg.py: posterior), so that it is positive definite whatever the rounding. Repeated about the
resulting motion it is Gauss-Newton on the whole run at the cost of a filter. Sources: Fraser & Potter (1969), "The
optimum linear smoother as a combination of two optimum linear filters"; the iteration: Bell (1994), "The iterated
Kalman smoother as a Gauss-Newton method"; on a manifold, and with measurements as information: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array
from geometry.compilation.jit import compiled, compiled_in_caller
from geometry.compiled_linalg import (
    apply,
    block,
    cholesky,
    column,
    copy_into,
    copy_matrix_into,
    hstack,
    multiply,
    pose_minus,
    posterior,
    solve,
    symmetrise,
    transposed_apply,
    transposed_multiply,
)
from tracking.rigid_body.models.motion import STATE, predicted, process_noise, propagated, transition
from tracking.smoothing.motion.run_detections import Reference


@compiled
def noise_root(
    dt: float, jerk: float, velocity_jump: float, acceleration_jump: float, later: float = -1.0, spread: float = 0.0
) -> Array:
    """Lower triangular root (3, 3) of one axis' process noise."""
    Q = np.empty((3, 3))
    Q[0, 0], Q[0, 1], Q[0, 2], Q[1, 1], Q[1, 2], Q[2, 2] = process_noise(
        dt, jerk, velocity_jump, acceleration_jump, later, spread
    )
    Q[1, 0], Q[2, 0], Q[2, 1] = Q[0, 1], Q[0, 2], Q[1, 2]
    return cholesky(Q)


@compiled_in_caller
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
    W = cholesky(A, 1.0)
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


# Frames whose covariances are in memory at once, 2.7 kB each: the whole of a shorter run, else a chunk. With chunks the
# forward filter, a fifth of a pass, runs once more over those before the last one.
MOST_FRAMES_AT_ONCE, CHUNK = 8192, 1024


class RunInformation(NamedTuple):
    """Information of T frames' spots about the poses at a reference, and the process noise of the steps."""

    information: Array  # (T, 6, 6) normal matrices J^T C^-1 J; 0 without spots
    vector: Array  # (T, 6) J^T C^-1 (measured - expected)
    dt: Array  # (T,) s since the frame before
    velocity_jump: Array  # (T, 2) variances of the velocities' jump in that step, (m/s)^2 and (rad/s)^2
    acceleration_jump: Array  # (T, 2) variances of the accelerations' jump
    moment: Array  # (T, 2) s: how long before the end of the step the velocities jump, -1: unknown; and its sigma
    first_variance: Array  # (18,) variances of the first frame's deviation


class Interval(NamedTuple):
    """Result of the fixed-interval smoother for T frames."""

    x: Array  # (T, 18) deviations from the reference
    pose_P: Array  # (T, 6, 6)
    motion_P: Array  # (T, 6, 6) covariances of the velocities
    shock: Array  # (T,) chi-square (6 degrees) of a velocity jump in the step before, beyond the allowed noise
    energy: (
        Array  # (T, 6) by axis, of the step before: r^T Q r, where r is the score of the process noise, Q the jerk's
    )
    gamma: Array  # (T, 6) and its expectation tr(Q N): the number of noise components that the data determine
    jump_energy: Array  # (T, 2) and the same two where Q is the allowed jump's, of the three axes of translation,
    jump_gamma: Array  # (T, 2) and of rotation
    ends_P: Array  # (2, 18, 18) covariance of the whole state at the first and at the last frame


@compiled_in_caller
def _root_of_step(info: RunInformation, jerk: Array, k: int, axis: int) -> Array:
    """`noise_root` of an axis of the step before frame k, of which jerk (T, 6) is the density."""
    kind = axis // 3
    return noise_root(
        info.dt[k],
        jerk[k, axis],
        info.velocity_jump[k, kind],
        info.acceleration_jump[k, kind],
        info.moment[k, 0],
        info.moment[k, 1],
    )


@compiled
def _predict(ref: Reference, info: RunInformation, jerk: Array, k: int, x: Array, P: Array) -> tuple[Array, Array]:
    """Prediction from frame k - 1 to frame k: deviation (18,) and covariance (18, 18)."""
    R, t, m, P_new, F = predicted(
        ref.R[k - 1],
        ref.t[k - 1],
        ref.m[k - 1],
        P,
        info.dt[k],
        jerk[k],
        info.velocity_jump[k],
        info.acceleration_jump[k],
        info.moment[k, 0],
        info.moment[k, 1],
    )
    x_new = apply(F, x)
    d = pose_minus(R, t, ref.R[k], ref.t[k])
    for i in range(6):
        x_new[i] += d[i]
    for i in range(12):
        x_new[6 + i] += m[i] - ref.m[k, i]
    return x_new, P_new


@compiled
def _update(L: Array, g: Array, x: Array, P: Array) -> tuple[Array, Array, float]:
    """Update with information L (s, s), g (s,): deviation, covariance, and the log-likelihood up to a constant."""
    if L[0, 0] == 0.0 and L[3, 3] == 0.0:
        return x, P, 0.0
    out, log_det = posterior(P, L)
    size = L.shape[0]
    r = apply(L, x[:size])
    misfit = 0.0
    for i in range(size):
        misfit += x[i] * (r[i] - 2 * g[i])
        r[i] = g[i] - r[i]
    x_new = x.copy()
    for i in range(STATE):
        for j in range(size):
            x_new[i] += out[i, j] * r[j]
    for i in range(size):
        misfit -= r[i] * (x_new[i] - x[i])
    return x_new, out, -0.5 * (log_det + misfit)


@compiled
def _first_prior(info: RunInformation) -> tuple[Array, Array]:
    """Prior of the first frame's deviation (18,) and its covariance (18, 18)."""
    P = np.zeros((STATE, STATE))
    for i in range(STATE):
        P[i, i] = info.first_variance[i]
    return np.zeros(STATE), P


@compiled
def log_likelihood(ref: Reference, info: RunInformation, jerk: Array) -> float:
    """Log-likelihood of the run for a motion with this jerk (T, 6), nats, up to a constant."""
    x, P = _first_prior(info)
    total = 0.0
    for k in range(info.dt.shape[0]):
        if k > 0:
            x, P = _predict(ref, info, jerk, k, x, P)
        x, P, gained = _update(info.information[k], info.vector[k], x, P)
        total += gained
    return total


@compiled_in_caller
def _predict_backward(
    ref: Reference, info: RunInformation, jerk: Array, k: int, Y: Array, y: Array
) -> tuple[Array, Array]:
    """Information about frame k - 1 from all frames from k on, given that about frame k; overwrites Y and y."""
    for axis in range(6):
        subtract_noise(Y, y, axis, _root_of_step(info, jerk, k, axis))
    F, turn = transition(ref.m[k - 1], info.dt[k])
    R, t, m = propagated(ref.R[k - 1], ref.t[k - 1], ref.m[k - 1], info.dt[k], turn)
    away = np.empty(STATE)
    copy_into(away, pose_minus(R, t, ref.R[k], ref.t[k]))
    for i in range(12):
        away[6 + i] = m[i] - ref.m[k, i]
    shift = apply(Y, away)
    for i in range(STATE):
        y[i] -= shift[i]
    half = transposed_multiply(F, Y)  # skips the zeros of F, which are most of its entries; Y is symmetric
    out = transposed_multiply(F, half.T.copy())
    symmetrise(out)
    return out, transposed_apply(F, y)


class Filtered(NamedTuple):
    """T frames, filtered from both ends."""

    x: Array  # (T, 18) deviations given the spots up to those of each frame
    P: Array  # (T, 18, 18)
    nats: Array  # (T,) log-likelihood of those spots
    Y: Array  # (T, 18, 18) information of the later frames about each frame
    y: Array  # (T, 18)
    later: Array  # (T,) their log-likelihood, less that by Y and y


@compiled
def filtered(ref: Reference, info: RunInformation, jerk: Array) -> Filtered:
    """What `log_likelihood_with` needs of a run with this jerk (T, 6)."""
    frames = info.dt.shape[0]
    out = Filtered(
        np.empty((frames, STATE)),
        np.empty((frames, STATE, STATE)),
        np.empty(frames),
        np.zeros((frames, STATE, STATE)),
        np.zeros((frames, STATE)),
        np.zeros(frames),
    )
    x, P = _first_prior(info)
    total = 0.0
    for k in range(frames):
        if k > 0:
            x, P = _predict(ref, info, jerk, k, x, P)
        x, P, gained = _update(info.information[k], info.vector[k], x, P)
        total += gained
        copy_into(out.x[k], x)
        copy_matrix_into(out.P[k], P)
        out.nats[k] = total
    for k in range(frames - 1, 0, -1):
        Y, y = out.Y[k].copy(), out.y[k].copy()
        for a in range(6):
            y[a] += info.vector[k, a]
            for b in range(6):
                Y[a, b] += info.information[k, a, b]
        Y, y = _predict_backward(ref, info, jerk, k, Y, y)
        copy_into(out.y[k - 1], y)
        copy_matrix_into(out.Y[k - 1], Y)
        _, _, gained = _update(Y, y, out.x[k - 1], out.P[k - 1])
        out.later[k - 1] = total - out.nats[k - 1] - gained
    return out


@compiled
def log_likelihood_with(
    ref: Reference, info: RunInformation, jerk: Array, others: Filtered, first: int, end: int
) -> float:
    """`log_likelihood` of a run that is `others` but for the steps from first to before end."""
    x, P, total = others.x[first - 1], others.P[first - 1], others.nats[first - 1]
    for k in range(first, end):
        x, P = _predict(ref, info, jerk, k, x, P)
        x, P, gained = _update(info.information[k], info.vector[k], x, P)
        total += gained
    last = max(first, end) - 1
    _, _, gained = _update(others.Y[last], others.y[last], x, P)
    return total + gained + others.later[last]


@compiled
def smoothed(ref: Reference, info: RunInformation, jerk: Array, tested: bool = True) -> Interval:
    """Fixed-interval smoother: deviations and covariances of all frames, and test quantities of the process noise.

    tested: whether those are needed; without them a pass takes two thirds of the time.

    jerk (T, 6): spectral densities, as in motion.py, of the step before each frame. The shock is the test of de Jong &
    Penzer (1998), "Diagnosing shocks in time series", for an impulse in the middle of the step. energy and gamma are
    the two sides of the fixed point of MacKay (1992), "Bayesian interpolation", for the strength of the noise.
    """
    frames = info.dt.shape[0]
    out = _empty_interval(frames)
    size = frames if frames <= MOST_FRAMES_AT_ONCE else CHUNK
    chunks = (frames + size - 1) // size
    xs, Ps = np.empty((size, STATE)), np.empty((size, STATE, STATE))
    start_x, start_P = _filter_checkpoints(ref, info, jerk, size, xs, Ps)
    Y, y = np.zeros((STATE, STATE)), np.zeros(STATE)  # information about a frame from the frames after it
    for chunk in range(chunks - 1, -1, -1):
        begin, end = chunk * size, min((chunk + 1) * size, frames)
        if chunk < chunks - 1:
            _filter_chunk(ref, info, jerk, begin, end, start_x[chunk], start_P[chunk], xs, Ps)
        for k in range(end - 1, begin - 1, -1):
            P = _combine(out, k, xs[k - begin], Ps[k - begin], Y, y)
            if k == 0:
                break
            for a in range(6):
                y[a] += info.vector[k, a]
                for b in range(6):
                    Y[a, b] += info.information[k, a, b]
            if tested:
                _test_process_noise(info, jerk, k, Y, y, P, out)
            Y, y = _predict_backward(ref, info, jerk, k, Y, y)
    return out


@compiled_in_caller
def _empty_interval(frames: int) -> Interval:
    return Interval(
        np.empty((frames, STATE)),
        np.empty((frames, 6, 6)),
        np.empty((frames, 6, 6)),
        np.zeros(frames),
        np.zeros((frames, 6)),
        np.zeros((frames, 6)),
        np.zeros((frames, 2)),
        np.zeros((frames, 2)),
        np.empty((2, STATE, STATE)),
    )


@compiled
def _filter_chunk(
    ref: Reference, info: RunInformation, jerk: Array, begin: int, end: int, x: Array, P: Array, xs: Array, Ps: Array
) -> tuple[Array, Array]:
    """Filter the frames from `begin` to before `end`, given the prediction x (18,), P (18, 18) of the first of them.

    Writes the filtered states into xs (end - begin, 18) and Ps (end - begin, 18, 18); returns the last one.
    """
    for k in range(begin, end):
        if k > begin:
            x, P = _predict(ref, info, jerk, k, x, P)
        x, P, _ = _update(info.information[k], info.vector[k], x, P)
        copy_into(xs[k - begin], x)
        copy_matrix_into(Ps[k - begin], P)
    return x, P


@compiled_in_caller
def _filter_checkpoints(
    ref: Reference, info: RunInformation, jerk: Array, chunk: int, xs: Array, Ps: Array
) -> tuple[Array, Array]:
    """Forward filter: predicted deviations (c, 18) and covariances (c, 18, 18) at the start of each chunk of frames.

    xs and Ps, as in `_filter_chunk`, are those of the last chunk in the end.
    """
    frames = info.dt.shape[0]
    chunks = (frames + chunk - 1) // chunk
    start_x, start_P = np.zeros((chunks, STATE)), np.zeros((chunks, STATE, STATE))
    x, P = _first_prior(info)
    for i in range(chunks):
        begin, end = i * chunk, min((i + 1) * chunk, frames)
        if i > 0:
            x, P = _predict(ref, info, jerk, begin, x, P)
        copy_into(start_x[i], x)
        copy_matrix_into(start_P[i], P)
        x, P = _filter_chunk(ref, info, jerk, begin, end, x, P, xs, Ps)
    return start_x, start_P


@compiled_in_caller
def _combine(out: Interval, k: int, x: Array, filtered_P: Array, Y: Array, y: Array) -> Array:
    """Write frame k's result: its filtered state x, P combined with the information of the later frames Y, y.

    Returns the smoothed covariance (18, 18).
    """
    P, _ = posterior(filtered_P, Y)
    score = apply(Y, x)
    for i in range(STATE):
        score[i] = y[i] - score[i]
    change = apply(P, score)
    for i in range(STATE):
        out.x[k, i] = x[i] + change[i]
    for a in range(6):
        for b in range(6):
            out.pose_P[k, a, b] = P[a, b]
            out.motion_P[k, a, b] = P[6 + a, 6 + b]
    if k == out.x.shape[0] - 1:
        copy_matrix_into(out.ends_P[1], P)
    if k == 0:
        copy_matrix_into(out.ends_P[0], P)
    return P


@compiled
def _score_test(
    noise: tuple[float, float, float, float, float, float], r: Array, N: Array, N_aa: float, i: int
) -> tuple[float, float]:
    """r^T Q r and tr(Q N) of the noise Q of axis i, as `process_noise` gives it; N_aa: of its acceleration."""
    pp, pv, pa, vv, va, aa = noise
    p, v, a = r[i], r[6 + i], r[12 + i]
    energy = pp * p * p + vv * v * v + aa * a * a + 2 * (pv * p * v + pa * p * a + va * v * a)
    gamma = (
        pp * N[i, i]
        + vv * N[6 + i, 6 + i]
        + aa * N_aa
        + 2 * (pv * N[i, 6 + i] + pa * N[i, 12 + i] + va * N[6 + i, 12 + i])
    )
    return energy, gamma


@compiled_in_caller
def _test_process_noise(info: RunInformation, jerk: Array, k: int, Y: Array, y: Array, P: Array, out: Interval) -> None:
    """Write row k of `out.shock`, `out.energy` and `out.gamma`: tests of the process noise of the step before frame k.

    They follow from the score r = y - Y x of the noise and its covariance N = Y - Y P Y. Y, y: information of frame k
    and all later ones; x = out.x[k], P (18, 18): the smoothed state.
    """
    r, PY = apply(Y, out.x[k]), _product(P, Y)
    N = _product(Y[:12], PY)  # of the accelerations only the variances are needed
    for i in range(STATE):
        r[i] = y[i] - r[i]
    for i in range(12):
        for j in range(STATE):
            N[i, j] = Y[i, j] - N[i, j]
    dt = info.dt[k]
    B, b = np.empty((6, 6)), np.empty(6)
    h = 0.5 * dt
    for i in range(6):
        p, v = r[i], r[6 + i]
        N_aa = 0.0
        for j in range(STATE):
            N_aa += Y[12 + i, j] * PY[j, 12 + i]
        N_aa = Y[12 + i, 12 + i] - N_aa
        # Of the jerk alone: the variances of an allowed jump say nothing about the jerk's strength.
        out.energy[k, i], gamma = _score_test(process_noise(dt, jerk[k, i], 0.0, 0.0), r, N, N_aa, i)
        out.gamma[k, i] = max(gamma, 0.0)
        kind = i // 3
        if info.velocity_jump[k, kind] > 0:
            jump = process_noise(
                dt,
                0.0,
                info.velocity_jump[k, kind],
                info.acceleration_jump[k, kind],
                info.moment[k, 0],
                info.moment[k, 1],
            )
            energy, gamma = _score_test(jump, r, N, N_aa, i)
            out.jump_energy[k, kind] += energy
            out.jump_gamma[k, kind] += gamma
        b[i] = h * p + v
        for j in range(6):
            B[i, j] = h * h * N[i, j] + h * (N[6 + i, j] + N[i, 6 + j]) + N[6 + i, 6 + j]
    symmetrise(B)
    out.shock[k] = _chi_square(B, b)


@compiled
def _product(a: Array, b: Array) -> Array:
    """a (n, 6 k) @ b (6 k, m) of matrices without zeros.

    As `multiply`, with six terms in each inner loop: to begin such a loop takes as long as 20 of its terms.
    """
    n, m = a.shape[0], b.shape[1]
    out = np.zeros((n, m))
    for i in range(n):
        for j in range(0, a.shape[1], 6):
            s0, s1, s2, s3, s4, s5 = a[i, j], a[i, j + 1], a[i, j + 2], a[i, j + 3], a[i, j + 4], a[i, j + 5]
            for c in range(m):
                s = out[i, c] + s0 * b[j, c] + s1 * b[j + 1, c] + s2 * b[j + 2, c]
                out[i, c] = s + s3 * b[j + 3, c] + s4 * b[j + 4, c] + s5 * b[j + 5, c]
    return out


@compiled
def _chi_square(L: Array, x: Array) -> float:
    """x^T L^-1 x of information L (6, 6), scaled to a unit diagonal; 0 if some axis has no information."""
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
    z, _ = solve(A, b)
    total = 0.0
    for i in range(6):
        total += b[i, 0] * z[i, 0]
    return total


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
            root = _root_of_step(info, jerk, k, i)
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
