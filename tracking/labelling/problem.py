"""The labelling problem of one frame for compiled code: views, spots, points, limits, and the workspace of one pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_projection import Views
from tracking.labelling.points import NO_POINT, Points

GATE = 25.0  # squared sigmas: a point farther from a predicted spot is not this spot (p = 4e-6)
LOG_2PI = float(np.log(2 * np.pi))


class SpotGeometry(NamedTuple):
    """The n views and their spots, except for the projection."""

    camera: Ints  # (n,)
    spot: Ints  # (n,)
    size: Array  # (n, 2) px: width, height of the picture
    has_image: Bools  # (n,)
    model_cov: Array  # (n, 2, 2) px^2, covariance of the largest model error considered: the sum of ...
    known_cov: Array  # (n, 2, 2) px^2, the calibration's stated covariance ...
    allowance: float  # px^2, ... and the largest allowance for other model errors
    view_at: Ints  # (spots, cameras) the view of a spot in a camera, or -1
    spot_point: Array  # (spots, 3) m, in body
    spot_ray: Array  # (spots, 3) in body
    spot_screen: Ints  # (spots,) -1: observed by no camera that has a picture


class LabelLimits(NamedTuple):
    """The prior region of poses and the limits of a labelling."""

    R: Array  # (3, 3) centre of the prior
    t: Array  # (3,) m
    half_width_m: float
    least_trace: float  # of the rotation from R
    p_detect: float
    min_spots: int


class LabelProblem(NamedTuple):
    """All that the labels of one frame depend on."""

    views: Views  # (n,)
    spots: SpotGeometry
    points: Points
    limits: LabelLimits
    front: Array  # (n, 4) the screen of each view as a plane n . x = d, with the normal towards the camera


class PoseWorkspace(NamedTuple):
    """Quantities at one pose."""

    uv: Array  # (n, 2) px, the projected spots
    J: Array  # (n, 2, 6) their Jacobians
    H: Array  # (6, 6) information of the pose, or its Cholesky factor
    left: Array  # (2, 6) scratch


@compiled
def pose_workspace(views: int) -> PoseWorkspace:
    """The workspace for that number of views."""
    return PoseWorkspace(np.empty((views, 2)), np.empty((views, 2, 6)), np.empty((6, 6)), np.empty((2, 6)))


@compiled
def allowed(limits: LabelLimits, R: Array, t: Array) -> bool:
    """Whether a pose lies in the prior region."""
    trace = 0.0
    for a in range(3):
        if not abs(t[a] - limits.t[a]) <= limits.half_width_m:
            return False
        for b in range(3):
            trace += R[a, b] * limits.R[a, b]
    return trace >= limits.least_trace


@compiled
def distinct_spots(labels: Ints, spot: Ints) -> int:
    """The number of spots that have a point in any view."""
    count = 0
    for v in range(labels.shape[0]):
        if labels[v] == NO_POINT:
            continue
        new = 1
        for w in range(v):
            if labels[w] != NO_POINT and spot[w] == spot[v]:
                new = 0
        count += new
    return count


@compiled
def clear(H: Array) -> None:
    """Set a matrix (6, 6) to zero."""
    for i in range(6):
        for j in range(6):
            H[i, j] = 0.0


@compiled
def add_information(H: Array, J: Array, cov: Array, model_cov: Array) -> float:
    """H += J^T S^-1 J with S (2, 2) the sum of two covariances; returns det S."""
    a, b, c = cov[0, 0] + model_cov[0, 0], cov[0, 1] + model_cov[0, 1], cov[1, 1] + model_cov[1, 1]
    det = a * c - b * b
    for i in range(6):
        w0, w1 = (c * J[0, i] - b * J[1, i]) / det, (a * J[1, i] - b * J[0, i]) / det
        for j in range(6):
            H[i, j] += w0 * J[0, j] + w1 * J[1, j]
    return det


@compiled
def cholesky(H: Array) -> float:
    """Replace H (6, 6) by its lower Cholesky factor; returns log det H, or -inf if H is singular."""
    log_det = 0.0
    for i in range(6):
        full = H[i, i]
        for j in range(i + 1):
            s = H[i, j]
            for k in range(j):
                s -= H[i, k] * H[j, k]
            if i == j:
                if not s > 1e-13 * full:
                    return -np.inf
                H[i, i] = np.sqrt(s)
                log_det += np.log(s)
            else:
                H[i, j] = s / H[j, j]
    return log_det


@compiled
def solve_cholesky(L: Array, x: Array) -> None:
    """x = (L L^T)^-1 x, in place."""
    for i in range(6):
        s = x[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(5, -1, -1):
        s = x[i]
        for k in range(i + 1, 6):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]


@compiled
def predicted_spread(L: Array, J: Array, left: Array) -> tuple[float, float, float]:
    """J C J^T as (a, b, c) of [[a, b], [b, c]], px^2, with C the inverse of L L^T; left (2, 6) is scratch."""
    for row in range(2):
        for i in range(6):
            s = J[row, i]
            for k in range(i):
                s -= L[i, k] * left[row, k]
            left[row, i] = s / L[i, i]
    a = b = c = 0.0
    for i in range(6):
        a += left[0, i] * left[0, i]
        b += left[0, i] * left[1, i]
        c += left[1, i] * left[1, i]
    return a, b, c
