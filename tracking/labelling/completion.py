"""A candidate pose completed to all the points that it explains, and the evidence of its labels, compiled."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compilation.jit import compiled, compiled_in_caller
from geometry.compiled_linalg import best_first, pose_plus
from geometry.compiled_projection import inside, project_view
from tracking.labelling.candidates import BestCandidates, best_point_of
from tracking.labelling.points import (
    LOG_2PI,
    NO_POINT,
    LabelProblem,
    PoseWorkspace,
    add_information,
    allowed,
    cholesky,
    clear,
    distinct_spots,
    pose_workspace,
    predicted_spread,
    solve_cholesky,
)

# The fit of a pose to labelled points and the evidence of the labels, compiled.
#
# The evidence is the likelihood averaged over the poses of the prior (Laplace's approximation), relative to all points
# being false. The size of the model's error (of the calibration) is unknown: the evidence is the mean over several
# sizes, so that a fit within the points' own noise counts for more than one that needs an allowance. Source: ours.

# Model errors as shares of the largest one considered, and the log of their prior probabilities. A model error above
# the points' noise is improbable: with equal weights, false points near four hidden spots gave a pose with residuals of
# 0.3 to 1 px in 11 % of the frames; with these weights in 2 %.
SHARES = np.array([1.0, 0.5, 0.1, 0.015])
LOG_WEIGHTS = np.log(np.array([0.002, 0.008, 0.495, 0.495]))
# Prior probability of a screen that is lit from the side without a camera (rear projection).
LOG_REAR = float(-np.log(100.0))


@compiled
def fit_labelled(
    problem: LabelProblem, labels: Ints, share: float, R: Array, t: Array, steps: int, work: PoseWorkspace
) -> tuple[Array, Array, bool]:
    """Gauss-Newton on the labelled points, with the model's error at a share of its largest value.

    Leaves all views' pixels and Jacobians at that pose, and the Cholesky factor of its information in work.H. False if
    a labelled spot cannot be projected or the information is singular.
    """
    points, spots, uv, J, H = problem.points, problem.spots, work.uv, work.J, work.H
    g, weighted = np.empty(6), np.empty(2)
    model = np.empty((2, 2))
    for step in range(steps + 1):
        for i in range(6):
            g[i] = 0.0
        clear(H)
        for v in range(problem.views.shape[0]):
            there = project_view(problem.views, v, R, t, uv[v], J[v])
            if labels[v] == NO_POINT:
                continue
            if not there:
                return R, t, False
            p = labels[v]
            for i in range(2):
                for j in range(2):
                    model[i, j] = spots.known_cov[v, i, j]
                model[i, i] += share * share * spots.allowance
            det = add_information(H, J[v], points.cov[p], model)
            a, b, c = (
                points.cov[p, 0, 0] + model[0, 0],
                points.cov[p, 0, 1] + model[0, 1],
                points.cov[p, 1, 1] + model[1, 1],
            )
            du, dv = points.uv[p, 0] - uv[v, 0], points.uv[p, 1] - uv[v, 1]
            weighted[0], weighted[1] = (c * du - b * dv) / det, (a * dv - b * du) / det
            for i in range(6):
                g[i] += J[v, 0, i] * weighted[0] + J[v, 1, i] * weighted[1]
        if cholesky(H) == -np.inf:
            return R, t, False
        if step == steps:
            break
        solve_cholesky(H, g)
        size = 0.0
        for i in range(6):
            size += g[i] * g[i]
        if size > 0.25:
            for i in range(6):
                g[i] *= 0.5 / np.sqrt(size)
        R, t = pose_plus(R, t, g)
    return R, t, True


@compiled_in_caller
def evidence(
    problem: LabelProblem, labels: Ints, R: Array, t: Array, work: PoseWorkspace
) -> tuple[Array, Array, float, int, int]:
    """The pose at the most likely model error, the evidence (nats), the index of that error, and the expected views.

    Starts from the pose R, t, at which `work` is filled.
    """
    fixed, views = _fixed_terms(problem, labels, work)
    for _ in range(_rear_screens(problem, labels, R, t)):
        fixed += LOG_REAR
    logs = np.full(SHARES.shape[0], -np.inf)
    best, best_R, best_t = 0, R, t
    for k in range(SHARES.shape[0]):
        R, t, ok = fit_labelled(problem, labels, SHARES[k], R, t, 2, work)
        if not ok:
            break
        logs[k] = _add_likelihood(fixed + LOG_WEIGHTS[k], problem, labels, SHARES[k], work)
        if logs[k] >= logs[best]:
            best, best_R, best_t = k, R, t
    total = 0.0
    for k in range(SHARES.shape[0]):
        total += np.exp(logs[k] - logs[best])
    return best_R, best_t, logs[best] + np.log(total), best, views


@compiled_in_caller
def _fixed_terms(problem: LabelProblem, labels: Ints, work: PoseWorkspace) -> tuple[float, int]:
    """The terms of the evidence that do not depend on the residuals, nats, and the number of expected views."""
    points, spots = problem.points, problem.spots
    found, missed = np.log(problem.limits.p_detect), np.log(1 - problem.limits.p_detect)
    n = problem.views.shape[0]
    fixed = 3 * LOG_2PI
    for c in range(points.first.shape[0] - 1):
        used = 0
        for v in range(n):
            used += spots.camera[v] == c and labels[v] != NO_POINT and _first_of_spot(spots.spot, labels, v) == v
        fixed += points.log_unused[c, used]
    views = 0
    for v in range(n):
        if labels[v] != NO_POINT:
            views += 1
            fixed += found - LOG_2PI + points.log_shape[labels[v]]
        elif spots.has_image[v] and inside(work.uv[v], spots.size[v]):
            views += 1
            fixed += missed
    return fixed, views


@compiled_in_caller
def _rear_screens(problem: LabelProblem, labels: Ints, R: Array, t: Array) -> int:
    """The number of screens that the beams of labelled views hit from the side without a camera."""
    front, views = problem.front, problem.views
    count = 0
    for v in range(labels.shape[0]):
        if labels[v] == NO_POINT:
            continue
        height = -front[v, 3]
        for a in range(3):
            height += front[v, a] * (
                t[a] + R[a, 0] * views[v].point[0] + R[a, 1] * views[v].point[1] + R[a, 2] * views[v].point[2]
            )
        new = True
        for w in range(v):
            if labels[w] != NO_POINT:
                same = True
                for a in range(4):
                    same = same and front[w, a] == front[v, a]
                new = new and not same
        if height < 0.0 and new:
            count += 1
    return count


@compiled_in_caller
def _add_likelihood(value: float, problem: LabelProblem, labels: Ints, share: float, work: PoseWorkspace) -> float:
    """`value` plus the log-likelihood of the residuals and the log of the poses' volume, at one model error."""
    points, spots, uv = problem.points, problem.spots, work.uv
    allowance = share**2 * spots.allowance
    for i in range(6):
        value -= np.log(work.H[i, i])
    for v in range(labels.shape[0]):
        p = labels[v]
        if p == NO_POINT:
            continue
        A = points.cov[p, 0, 0] + spots.known_cov[v, 0, 0] + allowance
        B = points.cov[p, 0, 1] + spots.known_cov[v, 0, 1]
        C = points.cov[p, 1, 1] + spots.known_cov[v, 1, 1] + allowance
        det = A * C - B * B
        du, dv = points.uv[p, 0] - uv[v, 0], points.uv[p, 1] - uv[v, 1]
        value -= 0.5 * (np.log(det) + (C * du * du - 2 * B * du * dv + A * dv * dv) / det)
        w = _first_of_spot(spots.spot, labels, v)
        if w != v:
            value += _second_view_term(problem, w, labels[w], p, A + C, allowance)
    return value


@compiled_in_caller
def _second_view_term(
    problem: LabelProblem, first_view: int, first_point: int, point: int, trace: float, allowance: float
) -> float:
    """Minus the log density of the point of a second view if the light is false and seen in the first view as well.

    A false light on the screen is also seen by both cameras, at the same place on the screen. trace, px^2: of the
    covariance of the point with the model's error.
    """
    points, spots = problem.points, problem.spots
    p, q, w = point, first_point, first_view
    gap2 = 0.0
    for a in range(3):
        gap2 += (points.world[p, a] - points.world[q, a]) ** 2
    var = 0.5 * points.m_per_px[p] ** 2 * trace + 0.5 * points.m_per_px[q] ** 2 * (
        points.cov[q, 0, 0] + points.cov[q, 1, 1] + spots.known_cov[w, 0, 0] + spots.known_cov[w, 1, 1] + 2 * allowance
    )
    return LOG_2PI + np.log(var / points.m_per_px[p] ** 2) + 0.5 * gap2 / var


@compiled
def _first_of_spot(spot: Ints, labels: Ints, v: int) -> int:
    """The first view with a point of the same spot as view v."""
    for w in range(v):
        if labels[w] != NO_POINT and spot[w] == spot[v]:
            return w
    return v


# A candidate pose completed to all the points that it explains, compiled.
#
# Starting from three spots, the spot with the most accurate prediction takes the nearest point in its gate; each point
# improves the pose and so narrows the gates of the other spots. Points that contradict the final fit are removed again.
# `evidence` then computes the evidence of the result. Source: ours.

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


@compiled_in_caller
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
        for v in range(n):
            if (
                labels[v] != NO_POINT
                or without_point[v]
                or not spots.has_image[v]
                or not inside(work.uv[v], spots.size[v])
            ):
                continue
            a, _, c = predicted_spread(work.H, work.J[v], work.left)
            if a + c < smallest:
                chosen, smallest = v, a + c
        if chosen < 0:
            return R, t, True
        _, p = best_point_of(problem, chosen, work, True, labels)
        if p == NO_POINT:
            without_point[chosen] = True
        else:
            labels[chosen] = p


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
