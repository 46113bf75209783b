"""Information about the pose from a frame's labelled spots, also of pictures taken at other instants; compiled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled, compiled_in_caller
from geometry.compiled_linalg import apply, column, dot, pose_plus, posterior, solve
from geometry.compiled_projection import Views, project_view
from tracking.detections import AT_THE_FRAME, Detections
from tracking.rigid_body.models.motion import STATE, state_after, transition

# Information about the pose from one frame's labelled spots, compiled.
#
# Normal matrix and vector of the forward model (Gauss-Newton), the pose of a frame by itself, and the reliability of
# the labels. Source: ours, except where a function says otherwise.

MAX_DETECTABLE_BIAS_PX = 5.0  # a spot is checked by the others if they reveal a false point this far from its place
# Root of the number of frames over which a linearisation error keeps its sign.
CURVATURE_CORRELATION = 10.0
NEGLIGIBLE_SIGMA = 0.005  # m, rad: over a smaller sigma the paths of spots are straight to some hundredths of a px


@compiled
def inverse_2x2(a: float, b: float, c: float) -> tuple[float, float, float, float]:
    """Entries (uu, uv, vv) of the inverse of [[a, b], [b, c]], and its determinant."""
    det = a * c - b * b
    return c / det, -b / det, a / det, det


@compiled
def frame_information(
    views: Views, R: Array, t: Array, use: Bools, uv: Array, cov: Array
) -> tuple[Array, Array, float, int, float]:
    """Normal matrix and vector of one frame's spots at a pose (R, t), and their misfit.

    use (n,): the views that count; uv (n, 2), px: their detections; cov (n, 2, 2), px^2. Returns J^T C^-1 J (6, 6),
    J^T C^-1 (uv - projected) (6,), the chi-square of the residuals, the number of spots used, and the sum of
    log det(2 pi C). A spot without a projection at this pose is left out.
    """
    L, g = np.zeros((6, 6)), np.zeros(6)
    chi2 = log_det = 0.0
    count = 0
    at, J = np.empty(2), np.empty((2, 6))
    for i in range(use.shape[0]):
        if not use[i] or not project_view(views, i, R, t, at, J):
            continue
        a, b, c, det = inverse_2x2(cov[i, 0, 0], cov[i, 0, 1], cov[i, 1, 1])
        y0, y1 = uv[i, 0] - at[0], uv[i, 1] - at[1]
        z0, z1 = a * y0 + b * y1, b * y0 + c * y1
        chi2 += y0 * z0 + y1 * z1
        log_det += np.log(det) + 2 * np.log(2 * np.pi)
        count += 1
        for j in range(6):
            w0, w1 = a * J[0, j] + b * J[1, j], b * J[0, j] + c * J[1, j]
            g[j] += J[0, j] * z0 + J[1, j] * z1
            for k in range(6):
                L[j, k] += w0 * J[0, k] + w1 * J[1, k]
    return L, g, chi2, count, log_det


@compiled
def single_frame_pose(
    views: Views, R: Array, t: Array, use: Bools, uv: Array, cov: Array
) -> tuple[Array, Array, Array, float, int]:
    """The pose of one frame by itself, from a start (R, t) near it.

    Arguments as in `frame_information`. A few Gauss-Newton steps, regularised by 1e-9 of the diagonal. Returns R, t,
    the normal matrix (6, 6), the chi-square and the number of spots; the normal matrix shows whether the pose is
    observable.
    """
    L, g, chi2, count, _ = frame_information(views, R, t, use, uv, cov)
    for _ in range(4):
        A, right = L.copy(), np.empty((6, 1))
        for i in range(6):
            A[i, i] += 1e-9 * L[i, i] + 1e-12
            right[i, 0] = g[i]
        x, _ = solve(A, right)
        step = column(x, 0)
        length = np.sqrt(dot(step, step))
        if not length < 0.5:
            break
        R_new, t_new = pose_plus(R, t, step)
        L_new, g_new, chi2_new, count_new, _ = frame_information(views, R_new, t_new, use, uv, cov)
        if not (count_new == count and chi2_new <= chi2 * (1 + 1e-9) + 1e-9):
            break
        R, t, L, g, chi2 = R_new, t_new, L_new, g_new, chi2_new
        if length < 1e-9:
            break
    return R, t, L, chi2, count


@compiled
def well_controlled(views: Views, R: Array, t: Array, use: Bools, cov: Array) -> Bools:
    """(n,): spots whose gross errors the other spots of the frame reveal, at a pose (R, t).

    use (n,): the labelled spots; cov (n, 2, 2), px^2. A spot's redundancy number r = 1 - tr(J P J^T C^-1) / 2 is the
    share of its error that remains in its residual; the rest is absorbed by the pose. Its minimal detectable bias is
    that error which makes the residual five sigmas. A spot is well controlled if this is at most
    MAX_DETECTABLE_BIAS_PX. Three spots of one screen on a line control each other although they leave the pose open.
    Source: Baarda (1968), "A testing procedure for use in geodetic networks": reliability.
    """
    n = use.shape[0]
    out, any_uv = np.zeros(n, np.bool_), np.zeros((n, 2))
    L, _, _, count, _ = frame_information(views, R, t, use, any_uv, cov)
    if count < 3:
        return out
    prior = np.zeros((6, 6))  # so wide that it does not matter, but regular
    for i in range(6):
        prior[i, i] = 100.0
    P, _ = posterior(prior, L)
    at, J = np.empty(2), np.empty((2, 6))
    for i in range(n):
        if not use[i] or not project_view(views, i, R, t, at, J):
            continue
        a, b, c, _ = inverse_2x2(cov[i, 0, 0], cov[i, 0, 1], cov[i, 1, 1])
        absorbed = 0.0
        for j in range(6):
            for k in range(6):
                absorbed += P[j, k] * (J[0, j] * (a * J[0, k] + b * J[1, k]) + J[1, j] * (b * J[0, k] + c * J[1, k]))
        # The squared minimal detectable bias, times the redundancy number.
        bias2 = 25.0 * 0.5 * (cov[i, 0, 0] + cov[i, 1, 1])
        out[i] = bias2 <= MAX_DETECTABLE_BIAS_PX * MAX_DETECTABLE_BIAS_PX * max(0.5 * (2.0 - absorbed), 0.0)
    return out


@compiled_in_caller
def add_curvature_covariance(views: Views, use: Bools, cov: Array, R: Array, t: Array, P: Array) -> float:
    """Add the linearisation error along the widest direction of P to the used spots' covariances, in place.

    use (n,), cov (n, 2, 2), px^2; P (6, 6): covariance of the pose (R, t). The error of a spot is half the second
    difference of its path over one sigma in that direction. It is much the same from frame to frame, so that a mean
    over many frames does not reduce it; CURVATURE_CORRELATION makes up for that. Returns the sigma in the widest
    direction; 0 where it is so small that the error is negligible.

    Source: ours. Without it, with one camera missing for 60 frames, the filter overstated its accuracy 30 times.
    """
    e = np.empty(6)
    for i in range(6):
        e[i] = np.sqrt(max(P[i, i], 0.0))
    length2 = 0.0
    for i in range(6):
        length2 += e[i] * e[i]
    if not length2 > NEGLIGIBLE_SIGMA**2:
        return 0.0
    size = 0.0
    for _ in range(6):  # power iteration
        e = apply(P, e)
        size = 0.0
        for i in range(6):
            size += e[i] * e[i]
        size = np.sqrt(size)
        for i in range(6):
            e[i] /= size
    sigma = np.sqrt(quadratic_form(P, e))
    if not sigma > NEGLIGIBLE_SIGMA:
        return 0.0
    for i in range(6):
        e[i] *= sigma
    R_up, t_up = pose_plus(R, t, e)
    for i in range(6):
        e[i] = -e[i]
    R_down, t_down = pose_plus(R, t, e)
    here, up, down, J = np.empty(2), np.empty(2), np.empty(2), np.empty((2, 6))
    for i in range(use.shape[0]):
        if not use[i] or not project_view(views, i, R, t, here, J):
            continue
        if not project_view(views, i, R_up, t_up, up, J) or not project_view(views, i, R_down, t_down, down, J):
            continue
        a, b = (
            CURVATURE_CORRELATION * (0.5 * (up[0] + down[0]) - here[0]),
            CURVATURE_CORRELATION * (0.5 * (up[1] + down[1]) - here[1]),
        )
        cov[i, 0, 0] += a * a
        cov[i, 0, 1] += a * b
        cov[i, 1, 0] += a * b
        cov[i, 1, 1] += b * b
    return sigma


@compiled_in_caller
def quadratic_form(P: Array, e: Array) -> float:
    """e^T P e of a matrix P (n, n) and a vector e (n,)."""
    out = 0.0
    for i in range(e.shape[0]):
        for j in range(e.shape[0]):
            out += e[i] * P[i, j] * e[j]
    return out


# How far the spots move between the instant of a frame and that at which a picture shows them; compiled.
#
# A camera with a clock of its own takes its picture before or after the frame's instant, and a rolling shutter exposes
# each row at another time. The pixel of a spot is then that of the pose at the spot's own instant: the pixel at the
# frame's instant plus a shift, which follows from the velocities. Source: ours.

ROW_STEPS = 4  # of the search for the row in which a spot is exposed: each gains a factor of its speed in rows per row


def has_clocks(found: Sequence[Detections | None]) -> bool:
    """Whether some picture of a frame was not taken at the frame's instant, or row by row."""
    return any(f is not None and f.clock is not None for f in found)


def clocks_of(found: Sequence[Detections | None]) -> Array:
    """(cameras, 3): the clocks of a frame's pictures, as PictureClock.numbers."""
    return np.array([AT_THE_FRAME if f is None or f.clock is None else f.clock.numbers for f in found])


@compiled
def exposed_after(clock: Array, v: float) -> float:
    """When row v is exposed, s after the frame's instant. clock (3,): as PictureClock.numbers."""
    return clock[0] + (min(max(v, -0.5), 2 * clock[2] + 0.5) - clock[2]) * clock[1]


@compiled
def picture_shifts(
    views: Views, camera: Ints, clocks: Array, R: Array, t: Array, m: Array, P: Array
) -> tuple[Array, Array]:
    """Shifts (n, 2), px, of the n views' spots from a frame's instant to that of their pictures, and their covariances.

    views: without a shift; camera (n,): of each view; clocks (cameras, 3): as PictureClock.numbers; R, t, m: the state
    at the frame's instant, as in motion.py; P (6, 6): the covariance of its velocities, which makes those of the shifts
    (n, 2, 2), px^2. 0 for spots without a projection.
    """
    n = views.shape[0]
    shift, cov = np.zeros((n, 2)), np.zeros((n, 2, 2))
    here, there, J = np.empty(2), np.empty(2), np.empty((2, 6))
    for i in range(n):
        clock = clocks[camera[i]]
        if (clock[0] == 0.0 and clock[1] == 0.0) or not project_view(views, i, R, t, here, J):
            continue
        v, after, known = here[1], 0.0, True
        for _ in range(ROW_STEPS if clock[1] != 0.0 else 1):
            after = exposed_after(clock, v)
            R_then, t_then, _ = state_after(R, t, m, after)
            known = project_view(views, i, R_then, t_then, there, J)
            if not known:
                break
            v = there[1]
        if not known:
            continue
        for a in range(2):
            shift[i, a] = there[a] - here[a]
            for b in range(2):
                for j in range(6):
                    for k in range(6):
                        cov[i, a, b] += after * after * J[a, j] * P[j, k] * J[b, k]
    return shift, cov


@compiled
def add_clock_errors(
    views: Views, camera: Ints, errors: Array, R: Array, t: Array, m: Array, P: Array, first: Ints, uv: Array,
    most_px: float, cov: Array,
) -> None:  # fmt: skip
    """Add the motion of points uv (d, 2) in the errors of their clocks to their covariances cov (d, 2, 2), px^2.

    Each moves as the spot of its camera that is nearest to it. errors (cameras, 3): sigmas, s, of the delay and of the
    row time, and the middle row; first (cameras + 1,): where the points of each camera begin; m, P: as of
    `picture_shifts`. What P leaves open moves a point by at most most_px.
    """
    n = camera.shape[0]
    at, J = np.empty((n, 2)), np.empty((n, 2, 6))
    for i in range(n):
        project_view(views, i, R, t, at[i], J[i])
    for c in range(errors.shape[0]):
        for d in range(first[c], first[c + 1]):
            nearest, least = -1, np.inf
            for i in range(n):
                away = (uv[d, 0] - at[i, 0]) ** 2 + (uv[d, 1] - at[i, 1]) ** 2
                if camera[i] == c and away < least:
                    nearest, least = i, away
            if nearest < 0:
                continue
            variance = errors[c, 0] ** 2 + ((uv[d, 1] - errors[c, 2]) * errors[c, 1]) ** 2
            speed, open2 = np.zeros(2), np.zeros((2, 2))
            for a in range(2):
                for j in range(6):
                    speed[a] += J[nearest, a, j] * m[j]
                    for b in range(2):
                        for k in range(6):
                            open2[a, b] += J[nearest, a, j] * P[j, k] * J[nearest, b, k]
            less = most_px**2 / (0.5 * (open2[0, 0] + open2[1, 1]) + 1e-12)
            for a in range(2):
                for b in range(2):
                    cov[d, a, b] += variance * speed[a] * speed[b] + min(variance, less) * open2[a, b]


@compiled
def run_shifts(views: Views, camera: Ints, clocks: Array, R: Array, t: Array, m: Array) -> Array:
    """Shifts (T, n, 2), px, as of `picture_shifts`, of T frames: clocks (T, cameras, 3), R (T, 3, 3), t, m (T, 12)."""
    frames, n = t.shape[0], views.shape[0]
    out, no_P = np.empty((frames, n, 2)), np.zeros((6, 6))
    for k in range(frames):
        shift, _ = picture_shifts(views, camera, clocks[k], R[k], t[k], m[k], no_P)
        for i in range(n):
            out[k, i, 0], out[k, i, 1] = shift[i, 0], shift[i, 1]
    return out


@compiled
def timed_spot(
    views: Views, i: int, R: Array, t: Array, m: Array, after: float, at: Array, J: Array, H: Array
) -> tuple[bool, Array]:
    """The pixel of view i `after` seconds from a state (R, t, m), and its Jacobian by that state.

    Writes the pixel, without the views' shift, to at (2,), the Jacobian by the pose at that time to J (2, 6), and that
    by the state's error (18) to H (2, 18). Returns whether there is a projection, and the motion (12,) at that time.
    """
    R_then, t_then, m_then = state_after(R, t, m, after)
    if not project_view(views, i, R_then, t_then, at, J):
        return False, m_then
    F, _ = transition(m, after)
    for a in range(2):
        at[a] -= views[i]["shift"][a]
        for j in range(STATE):
            H[a, j] = 0.0
            for c in range(6):
                H[a, j] += J[a, c] * F[c, j]
    return True, m_then


@compiled_in_caller
def timed_information(
    views: Views, camera: Ints, clocks: Array, state: tuple[Array, Array, Array], use: Bools, uv: Array, cov: Array
) -> tuple[Array, Array, float, int, float]:
    """As `frame_information`, about the state (R, t, m) of spots that each have an instant of their own.

    clocks (cameras, 3). Returns the normal matrix (18, 18), the vector (18,), the chi-square of the residuals, the
    number of spots, and the sum of log det(2 pi C).
    """
    R, t, m = state
    L, g = np.zeros((STATE, STATE)), np.zeros(STATE)
    chi2 = log_det = 0.0
    count = 0
    at, J, H = np.empty(2), np.empty((2, 6)), np.empty((2, STATE))
    for i in range(use.shape[0]):
        if not use[i]:
            continue
        projected, _ = timed_spot(views, i, R, t, m, exposed_after(clocks[camera[i]], uv[i, 1]), at, J, H)
        if not projected:
            continue
        a, b, c, det = inverse_2x2(cov[i, 0, 0], cov[i, 0, 1], cov[i, 1, 1])
        chi2 += add_spot(L, g, H, a, b, c, uv[i, 0] - at[0], uv[i, 1] - at[1])
        log_det += np.log(det) + 2 * np.log(2 * np.pi)
        count += 1
    return L, g, chi2, count, log_det


@compiled
def add_spot(L: Array, g: Array, H: Array, a: float, b: float, c: float, y0: float, y1: float) -> float:
    """Add a spot to the normal matrix L (s, s) and the vector g (s,), in place; returns its chi-square.

    H (2, s): its Jacobian; a, b, c: entries of the inverse of its covariance; y0, y1: its residual, px.
    """
    z0, z1 = a * y0 + b * y1, b * y0 + c * y1
    for j in range(H.shape[1]):
        x0, x1 = a * H[0, j] + b * H[1, j], b * H[0, j] + c * H[1, j]
        g[j] += H[0, j] * z0 + H[1, j] * z1
        for k in range(H.shape[1]):
            L[j, k] += x0 * H[0, k] + x1 * H[1, k]
    return y0 * z0 + y1 * z1
