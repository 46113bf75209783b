"""A candidate pose completed to all the points that it explains, compiled.

Starting from three spots, the spot with the most accurate prediction takes the nearest point in its gate; each point
improves the pose and so narrows the gates of the other spots. Points that contradict the final fit are removed again.
evidence.py then computes the evidence of the result. Source: ours.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_linalg import best_first
from geometry.compiled_projection import inside
from tracking.labelling.candidates import BestCandidates
from tracking.labelling.evidence import evidence, fit_labelled
from tracking.labelling.points import NO_POINT
from tracking.labelling.problem import (
    GATE,
    LOG_2PI,
    LabelProblem,
    PoseWorkspace,
    allowed,
    distinct_spots,
    pose_workspace,
    predicted_spread,
)

MISFIT_PER_POINT = 12.0  # squared sigmas of a point's residual: above it (p = 2.5e-3) the worst point is removed


@compiled
def complete_all(
    problem: LabelProblem, best: BestCandidates, most: int
) -> tuple[Array, Array, Ints, Array, Ints, Ints]:
    """The `most` likeliest candidates completed: R, t, labels, evidence, share and expected views of `complete`.

    All arrays have a leading axis (most,).
    """
    count, n = most, problem.views.shape[0]
    order = best_first(best.score[: best.taken[0]])
    R, t = np.empty((count, 3, 3)), np.empty((count, 3))
    labels, evidences = np.empty((count, n), np.int64), np.empty(count)
    share, expected = np.empty(count, np.int64), np.empty(count, np.int64)
    for k in range(count):
        i = order[k]
        R_k, t_k, evidences[k], share[k], expected[k] = complete(
            problem, best.seed_view[i], best.seed_point[i], best.R[i].copy(), best.t[i].copy(), labels[k]
        )
        for a in range(3):
            t[k, a] = t_k[a]
            for b in range(3):
                R[k, a, b] = R_k[a, b]
    return R, t, labels, evidences, share, expected


@compiled
def complete(
    problem: LabelProblem, seed_view: Ints, seed_point: Ints, R: Array, t: Array, labels: Ints
) -> tuple[Array, Array, float, int, int]:
    """The pose R, t, its evidence (nats, without the prior's volume; -inf: rejected), best share, expected views.

    Starts from the three spots seed_view, seed_point (3,) at the pose (R, t); fills labels (n,).
    """
    spots, limits = problem.spots, problem.limits
    n = problem.views.shape[0]
    work = pose_workspace(n)
    for v in range(n):
        labels[v] = NO_POINT
    for i in range(3):
        labels[seed_view[i]] = seed_point[i]
    for _ in range(2):
        R, t, ok = _add_points(problem, labels, R, t, work)
        if not ok:
            return R, t, -np.inf, 0, 0
    R, t, ok = fit_labelled(problem, labels, 1.0, R, t, 6, work)
    while ok:
        worst = _worst(problem, labels, work)
        if worst < 0:
            break
        labels[worst] = NO_POINT
        if distinct_spots(labels, spots.spot) < limits.min_spots:
            ok = False
        else:
            R, t, ok = fit_labelled(problem, labels, 1.0, R, t, 6, work)
    if not ok or distinct_spots(labels, spots.spot) < limits.min_spots or not allowed(limits, R, t):
        return R, t, -np.inf, 0, 0
    return evidence(problem, labels, R, t, work)


@compiled
def _add_points(
    problem: LabelProblem, labels: Ints, R: Array, t: Array, work: PoseWorkspace
) -> tuple[Array, Array, bool]:
    """Assign points to the unlabelled views, the most accurately predicted one first; False if a fit fails."""
    spots = problem.spots
    n = problem.views.shape[0]
    without_point = np.zeros(n, np.bool_)
    while True:
        R, t, ok = fit_labelled(problem, labels, 1.0, R, t, 2, work)
        if not ok:
            return R, t, False
        chosen, smallest = -1, np.inf
        a = b = c = 0.0
        for v in range(n):
            if (
                labels[v] != NO_POINT
                or without_point[v]
                or not spots.has_image[v]
                or not inside(work.uv[v], spots.size[v])
            ):
                continue
            a_, b_, c_ = predicted_spread(work.H, work.J[v], work.left)
            if a_ + c_ < smallest:
                chosen, smallest, a, b, c = v, a_ + c_, a_, b_, c_
        if chosen < 0:
            return R, t, True
        p = _nearest(problem, labels, chosen, work.uv[chosen], a, b, c)
        if p == NO_POINT:
            without_point[chosen] = True
        else:
            labels[chosen] = p


@compiled
def _nearest(problem: LabelProblem, labels: Ints, v: int, uv: Array, a: float, b: float, c: float) -> int:
    """The free point that best explains a view with the predicted covariance (a, b, c); NO_POINT if a miss is likelier.

    uv (2,), px: the predicted position.
    """
    points, spots, limits = problem.points, problem.spots, problem.limits
    camera = spots.camera[v]
    best, chosen = (
        np.log(1 - limits.p_detect) - np.log(limits.p_detect) + points.log_density[camera] + LOG_2PI,
        NO_POINT,
    )
    for p in range(points.first[camera], points.first[camera + 1]):
        free = True
        for other in range(labels.shape[0]):
            if labels[other] == p:
                free = False
        if not free:
            continue
        du, dv = points.uv[p, 0] - uv[0], points.uv[p, 1] - uv[1]
        A = a + points.cov[p, 0, 0] + spots.model_cov[v, 0, 0]
        B = b + points.cov[p, 0, 1] + spots.model_cov[v, 0, 1]
        C = c + points.cov[p, 1, 1] + spots.model_cov[v, 1, 1]
        det = A * C - B * B
        d2 = (C * du * du - 2 * B * du * dv + A * dv * dv) / det
        value = -0.5 * (np.log(det) + d2)
        if d2 < GATE and value > best:
            best, chosen = value, p
    return chosen


@compiled
def _worst(problem: LabelProblem, labels: Ints, work: PoseWorkspace) -> int:
    """The view with the largest normalised residual above MISFIT_PER_POINT; -1 if there is none."""
    points, spots, uv = problem.points, problem.spots, work.uv
    worst, largest = -1, MISFIT_PER_POINT
    for v in range(labels.shape[0]):
        p = labels[v]
        if p == NO_POINT:
            continue
        a, b, c = predicted_spread(work.H, work.J[v], work.left)
        A = points.cov[p, 0, 0] + spots.model_cov[v, 0, 0]
        B = points.cov[p, 0, 1] + spots.model_cov[v, 0, 1]
        C = points.cov[p, 1, 1] + spots.model_cov[v, 1, 1]
        # Covariance of the residual: the point's own minus that of the fit; singular without redundancy.
        a, b, c = max(A - a, 1e-3 * A), B - b, max(C - c, 1e-3 * C)
        det = a * c - b * b
        if not det > 1e-6 * A * C:
            continue
        du, dv = points.uv[p, 0] - uv[v, 0], points.uv[p, 1] - uv[v, 1]
        d2 = (c * du * du - 2 * b * du * dv + a * dv * dv) / det
        if d2 > largest:
            worst, largest = v, d2
    return worst
