"""What a frame's labelled spots say of the pose: an information matrix and vector, compiled.

Source: ours; Gauss-Newton's normal equations of the one forward model.
"""

from __future__ import annotations

import numpy as np

from geometry import compiled_linalg
from geometry.arrays import Array, Bools
from geometry.compilation.jit import compiled
from geometry.compiled_projection import Views, project_view

_apply = compiled_linalg.apply
_moved, _solve, _column, _dot = (
    compiled_linalg.pose_plus,
    compiled_linalg.solve,
    compiled_linalg.column,
    compiled_linalg.dot,
)
_posterior = compiled_linalg.posterior


DETECTABLE_PX = 5.0  # a false point so far from a spot's place is found out by the frame's other spots
SAME_FOR_LONG = 10.0  # the root of the frames over which a curvature keeps its sign
NARROW = 0.005  # m, rad: over a sigma smaller than this the paths of spots are straight to some hundredths of a px


@compiled
def inverse2(a: float, b: float, c: float) -> tuple[float, float, float, float]:
    """The inverse's entries and the determinant of [[a, b], [b, c]]."""
    det = a * c - b * b
    return c / det, -b / det, a / det, det


@compiled
def frame_information(
    views: Views, R: Array, t: Array, use: Bools, uv: Array, cov: Array
) -> tuple[Array, Array, float, int, float]:
    """Of spots use (n,) at uv (n, 2), px, with covariances (n, 2, 2): the normal matrix (6, 6), vector (6,), misfit.

    Both at the pose (R, t): J^T C^-1 J, J^T C^-1 (uv - projected) and the squared whitened residual. Also how many
    spots were used, and the sum of log det(2 pi C). A spot that the pose does not project is left out.
    """
    L, g = np.zeros((6, 6)), np.zeros(6)
    chi2 = log_det = 0.0
    count = 0
    at, J = np.empty(2), np.empty((2, 6))
    for i in range(use.shape[0]):
        if not use[i] or not project_view(views, i, R, t, at, J):
            continue
        a, b, c, det = inverse2(cov[i, 0, 0], cov[i, 0, 1], cov[i, 1, 1])
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
def fit_alone(
    views: Views, R: Array, t: Array, use: Bools, uv: Array, cov: Array
) -> tuple[Array, Array, Array, float, int]:
    """The pose of one frame by itself, from a near start: R, t, the normal matrix, misfit and number of spots.

    A few steps of Gauss-Newton, steadied by a millionth of the trace; whether the pose is observable is for the caller
    to see from the normal matrix.
    """
    L, g, chi2, count, _ = frame_information(views, R, t, use, uv, cov)
    for _ in range(4):
        A, right = L.copy(), np.empty((6, 1))
        for i in range(6):
            A[i, i] += 1e-9 * L[i, i] + 1e-12
            right[i, 0] = g[i]
        x, _ = _solve(A, right)
        step = _column(x, 0)
        size = np.sqrt(_dot(step, step))
        if not size < 0.5:
            break
        R_new, t_new = _moved(R, t, step)
        L_new, g_new, chi2_new, count_new, _ = frame_information(views, R_new, t_new, use, uv, cov)
        if not (count_new == count and chi2_new <= chi2 * (1 + 1e-9) + 1e-9):
            break
        R, t, L, g, chi2 = R_new, t_new, L_new, g_new, chi2_new
        if size < 1e-9:
            break
    return R, t, L, chi2, count


@compiled
def controlled(views: Views, R: Array, t: Array, use: Bools, cov: Array) -> Bools:
    """(n,): which of the spots use (n,), with covariances (n, 2, 2), px^2, the others check at a pose (R, t).

    A spot's redundancy, r = 1 - tr(J P J^T C^-1) / 2, is the share of its coordinates that the pose does not take up: a
    gross error of that spot, a false point, shows in its residual by that share only. Checked means that an error of
    DETECTABLE_PX shows. Three spots of one screen on a line check each other although they leave the pose open.
    Source: Baarda (1968), "A testing procedure for use in geodetic networks": reliability.
    """
    n = use.shape[0]
    out, nothing = np.zeros(n, np.bool_), np.zeros((n, 2))
    L, _, _, count, _ = frame_information(views, R, t, use, nothing, cov)
    if count < 3:
        return out
    vague = np.zeros((6, 6))
    for i in range(6):
        vague[i, i] = 100.0
    P, _ = _posterior(vague, L)
    at, J = np.empty(2), np.empty((2, 6))
    for i in range(n):
        if not use[i] or not project_view(views, i, R, t, at, J):
            continue
        a, b, c, _ = inverse2(cov[i, 0, 0], cov[i, 0, 1], cov[i, 1, 1])
        taken = 0.0
        for j in range(6):
            for k in range(6):
                taken += P[j, k] * (J[0, j] * (a * J[0, k] + b * J[1, k]) + J[1, j] * (b * J[0, k] + c * J[1, k]))
        # The least error that shows, at five sigmas of the residual.
        least = 25.0 * 0.5 * (cov[i, 0, 0] + cov[i, 1, 1])
        out[i] = least <= DETECTABLE_PX * DETECTABLE_PX * max(0.5 * (2.0 - taken), 0.0)
    return out


@compiled
def widen_by_curvature(views: Views, use: Bools, cov: Array, R: Array, t: Array, P: Array) -> float:
    """Add to the covariances (n, 2, 2) of the used spots what a straight line misses along P's widest direction.

    It is much the same from frame to frame, so it weighs as much more as a mean of many frames would make of it.

    In place. Returns the sigma in that direction; 0 where P (6, 6), of the pose (R, t), is so narrow that nothing is
    missed. Half the second difference
    over one sigma, as a covariance. Ours: with one camera missing for 60 frames the filter claimed 30 times too much.
    """
    e = np.empty(6)
    for i in range(6):
        e[i] = np.sqrt(max(P[i, i], 0.0))
    length2 = 0.0
    for i in range(6):
        length2 += e[i] * e[i]
    if not length2 > NARROW**2:
        return 0.0
    size = 0.0
    for _ in range(6):  # power iteration
        e = _apply(P, e)
        size = 0.0
        for i in range(6):
            size += e[i] * e[i]
        size = np.sqrt(size)
        for i in range(6):
            e[i] /= size
    sigma = np.sqrt(size_of(P, e))
    if not sigma > NARROW:
        return 0.0
    for i in range(6):
        e[i] *= sigma
    R_up, t_up = _moved(R, t, e)
    for i in range(6):
        e[i] = -e[i]
    R_down, t_down = _moved(R, t, e)
    here, up, down, J = np.empty(2), np.empty(2), np.empty(2), np.empty((2, 6))
    for i in range(use.shape[0]):
        if not use[i] or not project_view(views, i, R, t, here, J):
            continue
        if not project_view(views, i, R_up, t_up, up, J) or not project_view(views, i, R_down, t_down, down, J):
            continue
        a, b = SAME_FOR_LONG * (0.5 * (up[0] + down[0]) - here[0]), SAME_FOR_LONG * (0.5 * (up[1] + down[1]) - here[1])
        cov[i, 0, 0] += a * a
        cov[i, 0, 1] += a * b
        cov[i, 1, 0] += a * b
        cov[i, 1, 1] += b * b
    return sigma


@compiled
def size_of(P: Array, e: Array) -> float:
    """e^T P e."""
    out = 0.0
    for i in range(e.shape[0]):
        for j in range(e.shape[0]):
            out += e[i] * P[i, j] * e[j]
    return out
