"""Labels given the whole run: each frame's detections against where all other frames put the vehicle; compiled.

Source: ours; the pose without a frame's own spots is the smoothed one with their information taken away again.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry import small
from geometry.arrays import Array, Bools, Ints
from geometry.compiled import compiled
from geometry.projection import Views, project_view
from tracking.association import BLENDED, Chances, Frame, Sights, associate
from tracking.fixed_interval import Reference
from tracking.hiding import marginal, together
from tracking.hypotheses import concluded
from tracking.information import frame_information
from tracking.motion import STATE

# Probability that a spot is not hidden where its screen is lit, by what the frames beside it (those in which the screen
# was lit) show: it in none of them, in one of two, in all; and that a screen is lit, by how many of them show it so.
SHOWN = np.array([0.2, 0.6, 0.98])
LIT = np.array([0.01, 0.3, 0.995])
RIVAL = 9.0  # nats: assignments so far behind the best say nothing of its certainty
VAGUE_M, VAGUE_RAD = 0.1, 0.06  # a frame of which the others say less keeps its labels: a fan looks alike 20 deg on

_apply, _multiply, _solve = small.apply, small.multiply, small.solve
_moved, _symmetrise, _block, _column, _beside = small.moved, small.symmetrise, small.block, small.column, small.beside
_put, _put_matrix = small.put, small.put_matrix


class AllDetections(NamedTuple):
    """A run's detections: m in all, T frames. Those of frame k are rows begin[k] to begin[k + 1], by camera."""

    uv: Array  # (m, 2) px
    cov: Array  # (m, 2, 2) px^2
    blend_px: Array  # (m,) as in association.Frame
    begin: Ints  # (T + 1,)
    first: Ints  # (T, cameras + 1) within the frame
    has_image: Bools  # (T, cameras)


@compiled
def labelled_points(all_of: AllDetections, k: int, assigned: Ints, extra: Array) -> tuple[Bools, Array, Array]:
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
                    cov[i, a, b] = all_of.cov[d, a, b] + extra[i, a, b]
    return use, uv, cov


@compiled
def evidence_of(
    views: Views, all_of: AllDetections, assigned: Ints, extra: Array, ref: Reference
) -> tuple[Array, Array, Array, Ints]:
    """Information matrices (T, 6, 6), vectors (T, 6), misfits (T,) and numbers of spots (T,) at a reference motion."""
    frames = assigned.shape[0]
    L, g = np.empty((frames, 6, 6)), np.empty((frames, 6))
    chi2, spots = np.empty(frames), np.empty(frames, np.int64)
    for k in range(frames):
        use, uv, cov = labelled_points(all_of, k, assigned[k], extra)
        L_k, g_k, chi2[k], spots[k], _ = frame_information(views, ref.R[k], ref.t[k], use, uv, cov)
        _put_matrix(L[k], L_k)
        _put(g[k], g_k)
    return L, g, chi2, spots


@compiled
def clutter_density(
    views: Views, sights: Sights, all_of: AllDetections, assigned: Ints, ref: Reference, known: Bools, radius_px: float
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
            if not (-0.5 <= uv[0] < sights.size[i, 0] - 0.5 and -0.5 <= uv[1] < sights.size[i, 1] - 0.5):
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
def relabelled(
    views: Views,
    sights: Sights,
    chances: Chances,
    all_of: AllDetections,
    assigned: Ints,
    extra: Array,
    ref: Reference,
    pose_P: Array,
    log_clutter: Array,
) -> tuple[Ints, Array]:
    """Assignments (T, n) and their probabilities (T, n), from the smoothed poses and their covariances (T, 6, 6).

    assigned (T, n): those that the smoothing used. log_clutter (T, n). A frame of whose pose nothing is known keeps
    its assignments.
    """
    frames, n = assigned.shape
    out, certain = assigned.copy(), np.ones((frames, n))
    groups = 0
    for i in range(n):
        groups = max(groups, sights.group[i] + 1)
    nothing = np.zeros(12)
    for k in range(frames):
        use, uv, cov = labelled_points(all_of, k, assigned[k], extra)
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
        vague = False
        for i in range(6):
            limit = VAGUE_M if i < 3 else VAGUE_RAD
            vague |= not 0.0 < alone[i, i] < limit * limit
        if vague:
            continue
        R, t = _moved(ref.R[k], ref.t[k], _column(x, 6))
        a, b = all_of.begin[k], all_of.begin[k + 1]
        frame = Frame(
            all_of.uv[a:b], all_of.cov[a:b], all_of.blend_px[a:b], all_of.first[k], all_of.has_image[k], log_clutter[k]
        )
        hidden = _hiding(assigned, sights.group, groups, k)
        shining = marginal(hidden, sights.group)
        found, score, counted, R_b, t_b, count = associate(views, sights, frame, chances, R, t, alone, shining, extra)
        whole = np.zeros((STATE, STATE))
        _put_matrix(whole, alone)
        exact = np.empty(count)
        before = (R, t, nothing, whole)
        best = 0
        for j in range(count):
            exact[j] = -np.inf
            if score[j] > score[0] - 2 * RIVAL:
                _, _, _, _, gaussian, _, _ = concluded(views, frame, extra, before, found[j], R_b[j], t_b[j])
                exact[j] = counted[j] + gaussian + together(hidden, sights.group, found[j], chances.detect)
            if exact[j] > exact[best]:
                best = j
        total = 0.0
        share = np.zeros(n)
        for j in range(count):
            if exact[j] > exact[best] - RIVAL:
                p = np.exp(exact[j] - exact[best])
                total += p
                for i in range(n):
                    if found[j, i] % BLENDED == found[best, i] % BLENDED:
                        share[i] += p
        for i in range(n):
            out[k, i] = found[best, i] if found[best, i] >= 0 else -1
            certain[k, i] = share[i] / total
    return out, certain


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
