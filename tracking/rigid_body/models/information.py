"""Information about the pose from one frame's labelled spots, compiled.

Normal matrix and vector of the forward model (Gauss-Newton), the pose of a frame by itself, and the reliability of the
labels. Source: ours, except where a function says otherwise.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools
from geometry.compilation.jit import compiled
from geometry.compiled_linalg import apply, column, dot, pose_plus, posterior, solve
from geometry.compiled_projection import Views, project_view

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


@compiled
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


@compiled
def quadratic_form(P: Array, e: Array) -> float:
    """e^T P e of a matrix P (n, n) and a vector e (n,)."""
    out = 0.0
    for i in range(e.shape[0]):
        for j in range(e.shape[0]):
            out += e[i] * P[i, j] * e[j]
    return out
