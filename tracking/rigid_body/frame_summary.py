"""What a frame's best hypothesis means in numbers, all in one compiled call: a dozen small ones would cost more."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry import compiled_linalg
from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_projection import Views, project_view
from tracking.rigid_body.association import BLENDED, FrameDetections, ViewTable, expected_at
from tracking.rigid_body.hypotheses import Hypotheses
from tracking.rigid_body.information import fit_alone, frame_information
from tracking.rigid_body.motion import predicted

RANK = 1e-12  # pivot of a scaled normal matrix below which a pose is not observable; exact degeneracies give 1e-16

_multiply, _solve, _moved = compiled_linalg.multiply, compiled_linalg.solve, compiled_linalg.pose_plus
_block, _beside = compiled_linalg.block, compiled_linalg.hstack


class FrameSummary(NamedTuple):
    """Of n views and c cameras."""

    labelled: Bools  # (n,): the label is certain enough to be given
    use: Bools  # (n,): and takes part in the pose
    uv: Array  # (n, 2) px, of the labelled detections; nan without
    cov: Array  # (n, 2, 2) px^2
    chi2: float  # of the frame's own pose
    rms_px: float
    alone: Array  # (6, 6) covariance of the frame's own pose; inf where it is not observable
    expected_px: Array  # (n, 2) where the pose puts all spots; nan without a projection
    jacobian: Array  # (n, 2, 6)
    inside: Bools  # (n,): in the picture
    near: Array  # (c,) false points within the given radius of the expected spots, and ...
    discs: Array  # (c,) how many spots these are


@compiled
def summarise(
    views: Views,
    sights: ViewTable,
    frame: FrameDetections,
    R: Array,
    t: Array,
    assigned: Ints,
    certain: Array,
    least_probability: float,
    radius_px: float,
) -> FrameSummary:
    """The best hypothesis' pose (R, t), assignment (n,) and its probabilities (n,) in numbers."""
    n, cameras = assigned.shape[0], frame.has_image.shape[0]
    labelled, use = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    uv, cov = np.empty((n, 2)), np.empty((n, 2, 2))
    for i in range(n):
        labelled[i] = assigned[i] >= 0 and certain[i] >= least_probability
        use[i] = labelled[i] and assigned[i] < BLENDED
        d = assigned[i] % BLENDED
        for a in range(2):
            uv[i, a] = frame.uv[d, a] if labelled[i] else np.nan
            for b in range(2):
                cov[i, a, b] = frame.cov[d, a, b] if labelled[i] else np.nan
    R1, t1, L, chi2, count = fit_alone(views, R, t, use, uv, cov)
    alone = inverse(L) if count >= 3 else _unknown(6)
    expected, J, inside = np.empty((n, 2)), np.empty((n, 2, 6)), np.zeros(n, np.bool_)
    near, discs = np.zeros(cameras), np.zeros(cameras)
    square, at, J1 = 0.0, np.empty(2), np.empty((2, 6))
    for i in range(n):
        if use[i] and project_view(views, i, R1, t1, at, J1):
            square += (uv[i, 0] - at[0]) ** 2 + (uv[i, 1] - at[1]) ** 2
        if not project_view(views, i, R, t, expected[i], J[i]):
            continue
        u, v = expected[i, 0], expected[i, 1]
        inside[i] = -0.5 <= u < sights.size[i, 0] - 0.5 and -0.5 <= v < sights.size[i, 1] - 0.5
        c = sights.camera[i]
        if not inside[i] or not frame.has_image[c]:
            continue
        discs[c] += 1
        for d in range(frame.first[c], frame.first[c + 1]):
            if (frame.uv[d, 0] - u) ** 2 + (frame.uv[d, 1] - v) ** 2 < radius_px * radius_px:
                taken = False
                for j in range(n):
                    taken |= assigned[j] >= 0 and assigned[j] % BLENDED == d
                if not taken:
                    near[c] += 1
    rms = np.sqrt(square / (2 * count)) if count > 0 else np.nan
    return FrameSummary(labelled, use, uv, cov, chi2, rms, alone, expected, J, inside, near, discs)


@compiled
def _unknown(n: int) -> Array:
    """The covariance (n, n) of what nothing is known of."""
    out = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            out[i, j] = np.inf
    return out


@compiled
def inverse(L: Array) -> Array:
    """The covariance (6, 6) of a normal matrix; inf where it lacks rank."""
    n = L.shape[0]
    scaled, eye = np.empty((n, n)), np.zeros((n, n))
    for i in range(n):
        if not L[i, i] > 0.0:
            return _unknown(n)
        for j in range(n):
            scaled[i, j] = L[i, j] / np.sqrt(L[i, i] * L[j, j])
        eye[i, i] = 1.0
    # Cholesky's pivots tell the rank.
    root = scaled.copy()
    for j in range(n):
        for k in range(j):
            root[j, j] -= root[j, k] * root[j, k]
        if not root[j, j] > RANK:
            return _unknown(n)
        root[j, j] = np.sqrt(root[j, j])
        for i in range(j + 1, n):
            for k in range(j):
                root[i, j] -= root[i, k] * root[j, k]
            root[i, j] /= root[j, j]
    out, _ = _solve(scaled, eye)
    for i in range(n):
        for j in range(n):
            out[i, j] /= np.sqrt(L[i, i] * L[j, j])
    return out


@compiled
def innovation_score(
    views: Views, before: Hypotheses, h: int, dt: float, jerk: Array, use: Bools, uv: Array, cov: Array
) -> tuple[Array, Array]:
    """(6,) and (n, 2, 2). First: how the likelihood of a frame grows with the share of the prediction's covariance that
    each axis makes, per unit of its size: what the steady motion's jerk is learnt from.

    With w = S^-1 y: (w_i P_ii w_i - (S^-1)_ii P_ii) / (1 + (S^-1)_ii P_ii) / 2. 0 on average where the jerk is
    right. h: the hypothesis of the frame before. Second: the covariance of each spot's predicted place, px^2, without
    the detection's own.
    """
    none = np.zeros(2)
    R, t, _, P, _ = predicted(before.R[h], before.t[h], before.m[h], before.P[h], dt, jerk, none, none)
    L, g, _, _, _ = frame_information(views, R, t, use, uv, cov)
    pose = _block(P, 6)
    A = _multiply(L, pose)
    for i in range(6):
        A[i, i] += 1.0
    x, _ = _solve(A, _beside(L, g))
    out = np.empty(6)
    for i in range(6):
        expected = x[i, i] * pose[i, i]
        out[i] = 0.5 * (x[i, 6] * pose[i, i] * x[i, 6] - expected) / (1.0 + expected)
    n = use.shape[0]
    spread, at, J = np.empty((n, 2, 2)), np.empty(2), np.empty((2, 6))
    for i in range(n):
        there, a, b, c = expected_at(views, i, R, t, pose, at, J)
        if not there:
            a = b = c = np.nan
        spread[i, 0, 0], spread[i, 0, 1], spread[i, 1, 0], spread[i, 1, 1] = a, b, b, c
    return out, spread


@compiled
def ahead(views: Views, h: Hypotheses, dt: float) -> Array:
    """Where the best hypothesis expects each spot a time dt (s) later, (n, 2), px."""
    step = np.empty(6)
    for i in range(6):
        step[i] = dt * h.m[0, i] + 0.5 * dt * dt * h.m[0, 6 + i]
    R, t = _moved(h.R[0], h.t[0], step)
    n = views.shape[0]
    uv, J = np.empty((n, 2)), np.empty((2, 6))
    for i in range(n):
        project_view(views, i, R, t, uv[i], J)
    return uv
