"""Labels given the whole run: each frame's detections against where all other frames put the vehicle; compiled.

Source: ours; the pose without a frame's own spots is the smoothed one with their information taken away again.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry import compiled_linalg
from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_projection import Views, inside, project_view
from tracking.rigid_body.association import (
    BLENDED,
    DetectionModel,
    FrameDetections,
    ViewTable,
    associate,
    expected_at,
    log_chance,
)
from tracking.rigid_body.hypotheses import chosen_points, iterated_update
from tracking.rigid_body.information import fit_alone, frame_information
from tracking.rigid_body.motion import STATE
from tracking.rigid_body.occlusion import joint_log_likelihood, marginal
from tracking.smoothing.fixed_interval import Reference

# Probability that a spot is not hidden where its screen is lit, by what the frames beside it (those in which the screen
# was lit) show: it in none of them, in one of two, in all; and that a screen is lit, by how many of them show it so.
SHOWN = np.array([0.2, 0.6, 0.98])
LIT = np.array([0.01, 0.3, 0.995])
RIVAL = 9.0  # nats: assignments so far behind the best say nothing of its certainty
VAGUE_PX = 60.0  # a frame in which the others place a spot worse than this keeps its labels
P_BEND = 0.02  # probability that the motion bent at a frame although nothing was found of it
P_ANYWHERE = 1e-4  # ... that the other frames are wrong about it; then its pose is within
ANYWHERE_M, ANYWHERE_RAD = 0.3, 0.3  # of where they have it
ENOUGH = 5  # labelled spots whose own pose may contradict the other frames
KEEP = 3.0  # nats in favour of the labels that a frame has, where its spots do not give its pose
FINE = 3.5  # sigmas of a misfit's own scatter: below it nothing but the plain explanation is looked at

_apply, _multiply, _solve = compiled_linalg.apply, compiled_linalg.multiply, compiled_linalg.solve
_moved, _symmetrise, _block, _column, _beside = (
    compiled_linalg.pose_plus,
    compiled_linalg.symmetrise,
    compiled_linalg.block,
    compiled_linalg.column,
    compiled_linalg.hstack,
)
_put, _put_matrix = compiled_linalg.copy_into, compiled_linalg.copy_matrix_into


class AllDetections(NamedTuple):
    """A run's detections: m in all, T frames. Those of frame k are rows begin[k] to begin[k + 1], by camera."""

    uv: Array  # (m, 2) px
    cov: Array  # (m, 2, 2) px^2
    blend_px: Array  # (m,) as in association.Frame
    begin: Ints  # (T + 1,)
    first: Ints  # (T, cameras + 1) within the frame
    has_image: Bools  # (T, cameras)
    log_static: Array  # (m,) as in association.Frame
    size_px: Array  # (m,)
    usual_px: Array  # (n,)


@compiled
def labelled_points(
    all_of: AllDetections, k: int, assigned: Ints, calibration_cov: Array
) -> tuple[Bools, Array, Array]:
    """Of frame k: which views take part in the pose (n,), their pixels (n, 2) and covariances (n, 2, 2)."""
    n = assigned.shape[0]
    use, uv, cov = np.zeros(n, np.bool_), np.zeros((n, 2)), np.zeros((n, 2, 2))
    for i in range(n):
        if 0 <= assigned[i] < BLENDED:
            d = all_of.begin[k] + assigned[i]
            use[i] = True
            for a in range(2):
                uv[i, a] = all_of.uv[d, a]
                for b in range(2):
                    cov[i, a, b] = all_of.cov[d, a, b] + calibration_cov[i, a, b]
    return use, uv, cov


@compiled
def evidence_of(
    views: Views, all_of: AllDetections, assigned: Ints, calibration_cov: Array, ref: Reference, start: int
) -> tuple[Array, Array, Array, Ints]:
    """Information matrices (F, 6, 6), vectors (F, 6), misfits (F,) and numbers of spots (F,) at a reference motion.

    ref: of F frames from frame `start` on.
    """
    frames = ref.t.shape[0]
    L, g = np.empty((frames, 6, 6)), np.empty((frames, 6))
    chi2, spots = np.empty(frames), np.empty(frames, np.int64)
    for k in range(frames):
        use, uv, cov = labelled_points(all_of, start + k, assigned[start + k], calibration_cov)
        L_k, g_k, chi2[k], spots[k], _ = frame_information(views, ref.R[k], ref.t[k], use, uv, cov)
        _put_matrix(L[k], L_k)
        _put(g[k], g_k)
    return L, g, chi2, spots


@compiled
def clutter_density(
    views: Views,
    sights: ViewTable,
    all_of: AllDetections,
    assigned: Ints,
    ref: Reference,
    known: Bools,
    radius_px: float,
) -> Array:
    """(cameras,) false points per px^2 within a radius of where spots are expected, over a whole run."""
    cameras = all_of.has_image.shape[1]
    count, discs = np.zeros(cameras), np.zeros(cameras)
    uv, J = np.empty(2), np.empty((2, 6))
    for k in range(assigned.shape[0]):
        if not known[k]:
            continue
        for i in range(assigned.shape[1]):
            c = sights.camera[i]
            if not all_of.has_image[k, c] or not project_view(views, i, ref.R[k], ref.t[k], uv, J):
                continue
            if not inside(uv, sights.size[i]):
                continue
            discs[c] += 1
            for d in range(all_of.first[k, c], all_of.first[k, c + 1]):
                a, b = all_of.uv[all_of.begin[k] + d, 0] - uv[0], all_of.uv[all_of.begin[k] + d, 1] - uv[1]
                taken = False
                for j in range(assigned.shape[1]):
                    taken |= assigned[k, j] == d or assigned[k, j] == d + BLENDED
                if not taken and a * a + b * b < radius_px * radius_px:
                    count[c] += 1
    for c in range(cameras):
        count[c] /= max(discs[c], 1.0) * np.pi * radius_px**2
    return count


@compiled
def reassociated(
    views: Views,
    sights: ViewTable,
    chances: DetectionModel,
    all_of: AllDetections,
    assigned: Ints,
    calibration_cov: Array,
    ref: Reference,
    pose_P: Array,
    log_clutter: Array,
    bend_sigma: Array,
) -> tuple[Ints, Array, Array]:
    """Assignments (T, n) and their probabilities (T, n), from the smoothed poses and their covariances (T, 6, 6); and
    how well the other frames place the spots of each (T,): the largest sigma, px.

    assigned (T, n): those that the smoothing used. log_clutter (T, n). bend_sigma (T, 6): sigmas of the pose, m and
    rad, that a bend at the frame would add. Each frame is explained by where the others put the vehicle; where that
    leaves something open, also by a bend there, and its labels by its own pose: labels that agree with each other and
    with one of these stay. A frame of whose pose the others say too little keeps its labels.
    """
    frames, n = assigned.shape
    out, certain = assigned.copy(), np.ones((frames, n))
    sigma_px = np.zeros(frames)
    groups = 0
    for i in range(n):
        groups = max(groups, sights.group[i] + 1)
    anywhere, nowhere = np.empty(6), np.zeros(n)
    for i in range(6):
        anywhere[i] = ANYWHERE_M if i < 3 else ANYWHERE_RAD
    for k in range(frames):
        alone, R, t, sigma_px[k] = _by_the_others(views, sights, all_of, assigned, calibration_cov, ref, pose_P, k)
        if not sigma_px[k] < VAGUE_PX:
            continue
        a, b = all_of.begin[k], all_of.begin[k + 1]
        frame = FrameDetections(
            all_of.uv[a:b], all_of.cov[a:b], all_of.blend_px[a:b], all_of.first[k], all_of.has_image[k],
            log_clutter[k], all_of.log_static[a:b], all_of.size_px[a:b], all_of.usual_px, nowhere,
        )  # fmt: skip
        hidden = _hiding(assigned, sights.group, groups, k)
        now = np.empty(n, np.int64)
        labels = 0
        for i in range(n):
            now[i] = assigned[k, i]
            if now[i] < 0:
                now[i] = -1
            elif now[i] < BLENDED:
                labels += 1
        tried, score = _explanations(
            views, sights, frame, chances, calibration_cov, hidden, alone, R, t, now, labels, bend_sigma[k], anywhere
        )
        best = 0
        for j in range(score.shape[0]):
            if score[j] > score[best]:
                best = j
        total = 0.0
        share = np.zeros(n)
        for j in range(score.shape[0]):
            if score[j] > score[best] - RIVAL:
                p = np.exp(score[j] - score[best])
                total += p
                for i in range(n):
                    if _same(tried[j, i], tried[best, i]):
                        share[i] += p
        for i in range(n):
            out[k, i] = tried[best, i] if tried[best, i] >= 0 else -1
            certain[k, i] = share[i] / total
    return out, certain, sigma_px


@compiled
def _same(a: int, b: int) -> bool:
    """Whether two assignments of a view are the same point of light, or both none."""
    return (a < 0 and b < 0) or (a >= 0 and b >= 0 and a % BLENDED == b % BLENDED)


@compiled
def _by_the_others(
    views: Views,
    sights: ViewTable,
    all_of: AllDetections,
    assigned: Ints,
    calibration_cov: Array,
    ref: Reference,
    pose_P: Array,
    k: int,
) -> tuple[Array, Array, Array, float]:
    """Where all other frames put frame k: covariance (6, 6), R, t; and the largest sigma of a spot there, px."""
    use, uv, cov = labelled_points(all_of, k, assigned[k], calibration_cov)
    L, g, _, _, _ = frame_information(views, ref.R[k], ref.t[k], use, uv, cov)
    P = pose_P[k]
    A, step = _multiply(P, L), _apply(P, g)
    for i in range(6):
        step[i] = -step[i]
        for j in range(6):
            A[i, j] = -A[i, j]
        A[i, i] += 1.0
    x, _ = _solve(A, _beside(P, step))
    alone = _block(x, 6)
    _symmetrise(alone)
    nothing = False
    for i in range(6):
        nothing |= not 0.0 < alone[i, i] < 1.0
    if nothing:
        return alone, ref.R[k], ref.t[k], np.inf
    R, t = _moved(ref.R[k], ref.t[k], _column(x, 6))
    at, J = np.empty(2), np.empty((2, 6))
    worst = 0.0
    for i in range(assigned.shape[1]):
        if not all_of.has_image[k, sights.camera[i]]:
            continue
        there, a, _, c = expected_at(views, i, R, t, alone, at, J)
        if there and inside(at, sights.size[i]):
            worst = max(worst, 0.5 * (a + c))
    return alone, R, t, np.sqrt(worst)


@compiled
def _explanations(
    views: Views,
    sights: ViewTable,
    frame: FrameDetections,
    chances: DetectionModel,
    calibration_cov: Array,
    hidden: Array,
    alone: Array,
    R: Array,
    t: Array,
    now: Ints,
    labels: int,
    jump: Array,
    anywhere: Array,
) -> tuple[Ints, Array]:
    """Assignments (c, n) of one frame with their log-likelihoods (c,), nats; now (n,): the ones that it has."""
    n = now.shape[0]
    room = 300
    tried, score = np.empty((room, n), np.int64), np.empty(room)
    count = 0
    shining = marginal(hidden, sights.group)
    bonus = KEEP if labels < ENOUGH else 0.0
    whole, nothing = np.zeros((STATE, STATE)), np.zeros(12)
    for mode in range(3):
        P = alone.copy()
        prior = np.log(1.0 - P_BEND)
        if mode > 0:
            prior = np.log(P_BEND) if mode == 1 else np.log(P_ANYWHERE)
            add = jump if mode == 1 else anywhere
            for i in range(6):
                P[i, i] += add[i] * add[i]
        _put_matrix(whole, P)
        before = (R, t, nothing, whole)
        if mode < 2:
            found, rough, _, R_b, t_b, found_count = associate(
                views, sights, frame, chances, R, t, P, shining, calibration_cov
            )
            plain = False
            for j in range(found_count):
                if rough[j] < rough[0] - 2 * RIVAL or count == room - 4:
                    break
                R_j, t_j, _, _, gaussian, misfit, spots = iterated_update(
                    views, frame, calibration_cov, before, found[j], R_b[j], t_b[j]
                )
                same = True
                for i in range(n):
                    tried[count, i] = found[j, i]
                    same &= (found[j, i] < 0 and now[i] < 0) or found[j, i] == now[i]
                score[count] = (
                    prior
                    + gaussian
                    + log_chance(views, sights, frame, chances, shining, found[j], R_j, t_j)
                    + joint_log_likelihood(hidden, sights.group, found[j], chances.detect)
                    + (bonus if same else 0.0)
                )
                if j == 0:
                    plain = same and misfit <= 2 * spots + FINE * np.sqrt(4.0 * max(spots, 1))
                count += 1
            if mode == 0 and plain:
                break
        if labels == 0 or (mode == 2 and labels < ENOUGH):
            continue
        # The labels that the frame has, although they may lie outside the gates.
        own_R, own_t = R, t
        if mode == 2:
            use, uv, cov = chosen_points(frame, now, calibration_cov)
            own_R, own_t, _, _, _ = fit_alone(views, R, t, use, uv, cov)
        R_j, t_j, _, _, gaussian, _, _ = iterated_update(views, frame, calibration_cov, before, now, own_R, own_t)
        for i in range(n):
            tried[count, i] = now[i]
        score[count] = (
            prior
            + gaussian
            + log_chance(views, sights, frame, chances, shining, now, R_j, t_j)
            + joint_log_likelihood(hidden, sights.group, now, chances.detect)
            + bonus
        )
        count += 1
    return tried[:count], score[:count]


@compiled
def _hiding(assigned: Ints, group: Ints, groups: int, k: int) -> Array:
    """Probabilities (n + groups,), as in hiding.py, of frame k from the labels (T, n) of the frames beside it."""
    frames, n = assigned.shape
    out = np.empty(n + groups)
    asked, seen = np.zeros(n), np.zeros(n)
    for g in range(groups):
        lit_beside = 0
        for other in (k - 1, k + 1):
            if not 0 <= other < frames:
                lit_beside += 1
                continue
            lit = False
            for i in range(n):
                lit |= group[i] == g and assigned[other, i] >= 0
            lit_beside += 1 if lit else 0
            for i in range(n):
                if lit and group[i] == g:
                    asked[i] += 1
                    seen[i] += 1 if assigned[other, i] >= 0 else 0
        out[n + g] = LIT[lit_beside]
    for i in range(n):
        out[i] = SHOWN[2] if seen[i] == asked[i] else SHOWN[1 if seen[i] > 0 else 0]
    return out
