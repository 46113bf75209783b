"""The best hypothesis of a frame in numbers; one compiled call, since a dozen small ones would cost more."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_linalg import block, hstack, multiply, pose_plus, solve
from geometry.compiled_projection import Views, project_view
from tracking.rigid_body.association.frame_detections import BLENDED, CLUTTER_RADIUS_PX, Observation
from tracking.rigid_body.association.likelihood import predicted_pixel
from tracking.rigid_body.hypotheses.hypothesis_set import Hypotheses
from tracking.rigid_body.models.information import frame_information, single_frame_pose
from tracking.rigid_body.models.motion import predicted

# Pivot of a scaled normal matrix below which the pose is not observable; exact degeneracies give 1e-16.
RANK_TOLERANCE = 1e-12


class FrameSummary(NamedTuple):
    """Numbers of one frame with n views and c cameras."""

    labelled: Bools  # (n,) the label is probable enough to be given
    use: Bools  # (n,) the label is given and its detection takes part in the pose
    uv: Array  # (n, 2) px, of the labelled detections; nan without a label
    cov: Array  # (n, 2, 2) px^2
    chi2: float  # of the pose of this frame by itself
    rms_px: float  # of the same, per axis
    single_frame_cov: Array  # (6, 6) covariance of the same; inf where it is not observable
    expected_px: Array  # (n, 2) pixels of all spots at the hypothesis' pose; nan without a projection
    jacobian: Array  # (n, 2, 6)
    inside: Bools  # (n,) the expected pixel lies in the picture
    false_points: Array  # (c,) number of false points within CLUTTER_RADIUS_PX of the expected spots
    discs: Array  # (c,) number of these spots


@compiled
def summarise(
    obs: Observation, R: Array, t: Array, assigned: Ints, probability: Array, min_probability: float
) -> FrameSummary:
    """Summary of a hypothesis: its pose (R, t), its assignment (n,), and the probabilities of the labels (n,).

    Labels less probable than `min_probability` are not given.
    """
    frame, views = obs.frame, obs.views
    n, cameras = assigned.shape[0], frame.has_image.shape[0]
    labelled, use = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    uv, cov = np.empty((n, 2)), np.empty((n, 2, 2))
    for i in range(n):
        labelled[i] = assigned[i] >= 0 and probability[i] >= min_probability
        use[i] = labelled[i] and assigned[i] < BLENDED
        d = assigned[i] % BLENDED
        for a in range(2):
            uv[i, a] = frame.uv[d, a] if labelled[i] else np.nan
            for b in range(2):
                cov[i, a, b] = frame.cov[d, a, b] + obs.shift_cov[i, a, b] if labelled[i] else np.nan
    R1, t1, L, chi2, count = single_frame_pose(views, R, t, use, uv, cov)
    single_frame_cov = inverse(L) if count >= 3 else _infinite(6)
    expected, J, inside = np.empty((n, 2)), np.empty((n, 2, 6)), np.zeros(n, np.bool_)
    false_points, discs = np.zeros(cameras), np.zeros(cameras)
    square, at, J1 = 0.0, np.empty(2), np.empty((2, 6))
    for i in range(n):
        if use[i] and project_view(views, i, R1, t1, at, J1):
            square += (uv[i, 0] - at[0]) ** 2 + (uv[i, 1] - at[1]) ** 2
        if not project_view(views, i, R, t, expected[i], J[i]):
            continue
        u, v = expected[i, 0], expected[i, 1]
        inside[i] = -0.5 <= u < obs.view_table.size[i, 0] - 0.5 and -0.5 <= v < obs.view_table.size[i, 1] - 0.5
        c = obs.view_table.camera[i]
        if not inside[i] or not frame.has_image[c]:
            continue
        discs[c] += 1
        false_points[c] += _false_points_near(obs, c, u, v, assigned)
    rms = np.sqrt(square / (2 * count)) if count > 0 else np.nan
    return FrameSummary(labelled, use, uv, cov, chi2, rms, single_frame_cov, expected, J, inside, false_points, discs)


@compiled
def _false_points_near(obs: Observation, camera: int, u: float, v: float, assigned: Ints) -> int:
    """Number of a camera's unlabelled detections within CLUTTER_RADIUS_PX of a pixel (u, v)."""
    frame = obs.frame
    out = 0
    for d in range(frame.first[camera], frame.first[camera + 1]):
        if (frame.uv[d, 0] - u) ** 2 + (frame.uv[d, 1] - v) ** 2 < CLUTTER_RADIUS_PX * CLUTTER_RADIUS_PX:
            taken = False
            for j in range(assigned.shape[0]):
                taken |= assigned[j] >= 0 and assigned[j] % BLENDED == d
            if not taken:
                out += 1
    return out


@compiled
def _infinite(n: int) -> Array:
    """The covariance (n, n) of a quantity that is not observable."""
    out = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            out[i, j] = np.inf
    return out


@compiled
def inverse(L: Array) -> Array:
    """Covariance (n, n) of a normal matrix; inf if it lacks rank."""
    n = L.shape[0]
    scaled, eye = np.empty((n, n)), np.zeros((n, n))
    for i in range(n):
        if not L[i, i] > 0.0:
            return _infinite(n)
        for j in range(n):
            scaled[i, j] = L[i, j] / np.sqrt(L[i, i] * L[j, j])
        eye[i, i] = 1.0
    # The pivots of the Cholesky factorisation show the rank.
    root = scaled.copy()
    for j in range(n):
        for k in range(j):
            root[j, j] -= root[j, k] * root[j, k]
        if not root[j, j] > RANK_TOLERANCE:
            return _infinite(n)
        root[j, j] = np.sqrt(root[j, j])
        for i in range(j + 1, n):
            for k in range(j):
                root[i, j] -= root[i, k] * root[j, k]
            root[i, j] /= root[j, j]
    out, _ = solve(scaled, eye)
    for i in range(n):
        for j in range(n):
            out[i, j] /= np.sqrt(L[i, i] * L[j, j])
    return out


@compiled
def innovation_score(
    views: Views, before: Hypotheses, h: int, dt: float, jerk: Array, use: Bools, uv: Array, cov: Array
) -> tuple[Array, Array]:
    """Innovation score (6,) of the steady motion's jerk, and the predicted covariance (n, 2, 2) of each spot, px^2.

    The score is the derivative of the innovation's log-likelihood by the log variance of each axis of the predicted
    pose, over (1 + the part of the innovation's information that this variance makes). With w = S^-1 y and P the
    predicted covariance: (w_i P_ii w_i - (S^-1)_ii P_ii) / (1 + (S^-1)_ii P_ii) / 2. Its mean is 0 where the jerk is
    right. h: index among the hypotheses of the frame before; jerk (6,). The second result leaves the noise of the
    detections out.
    """
    none = np.zeros(2)
    R, t, _, P, _ = predicted(before.R[h], before.t[h], before.m[h], before.P[h], dt, jerk, none, none)
    L, g, _, _, _ = frame_information(views, R, t, use, uv, cov)
    pose = block(P, 6)
    A = multiply(L, pose)
    for i in range(6):
        A[i, i] += 1.0
    x, _ = solve(A, hstack(L, g))
    out = np.empty(6)
    for i in range(6):
        expected = x[i, i] * pose[i, i]
        out[i] = 0.5 * (x[i, 6] * pose[i, i] * x[i, 6] - expected) / (1.0 + expected)
    n = use.shape[0]
    spread, at, J = np.empty((n, 2, 2)), np.empty(2), np.empty((2, 6))
    for i in range(n):
        projected, a, b, c = predicted_pixel(views, i, R, t, pose, at, J)
        if not projected:
            a = b = c = np.nan
        spread[i, 0, 0], spread[i, 0, 1], spread[i, 1, 0], spread[i, 1, 1] = a, b, b, c
    return out, spread


@compiled
def predicted_pixels(views: Views, h: Hypotheses, dt: float) -> Array:
    """Pixels (n, 2) that the first hypothesis predicts for a time dt (s) later."""
    step = np.empty(6)
    for i in range(6):
        step[i] = dt * h.m[0, i] + 0.5 * dt * dt * h.m[0, 6 + i]
    R, t = pose_plus(h.R[0], h.t[0], step)
    n = views.shape[0]
    uv, J = np.empty((n, 2)), np.empty((2, 6))
    for i in range(n):
        project_view(views, i, R, t, uv[i], J)
    return uv
