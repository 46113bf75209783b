"""What a frame's labelled spots say of the pose: an information matrix and vector, compiled.

Source: ours; Gauss-Newton's normal equations of the one forward model.
"""

from __future__ import annotations

import numpy as np

from geometry import small
from geometry.arrays import Array, Bools
from geometry.compiled import compiled
from geometry.projection import Views, project_view

_moved, _solve, _column, _dot = small.moved, small.solve, small.column, small.dot


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
