"""A candidate pose completed to all the points that it explains, and its evidence, compiled.

From three spots on, the spot that is best predicted takes the point nearest to it, if one lies in its gate; each point
narrows the pose and so the gates of the rest. The evidence of the result is its likelihood averaged over the poses
of the prior (Laplace's approximation), relative to all points being false. How far the model (the calibration) is off
is not known: the evidence is the mean over several sizes of that error, so a fit that is as good as the points' own
noise counts for more than one that needs an allowance. Source: ours.
"""

from __future__ import annotations

import numpy as np

from geometry import compiled_linalg
from geometry.arrays import Array, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_projection import Views, inside, project_view
from tracking.labelling.candidates import (
    GATE,
    LOG_2PI,
    NO_POINT,
    Best,
    LabelLimits,
    SpotGeometry,
    add_information,
    allowed,
    cholesky,
    distinct_spots,
    predicted_spread,
)
from tracking.labelling.points import Points

_moved, best_first = compiled_linalg.pose_plus, compiled_linalg.best_first

# The model's error as shares of the largest allowed, and the log of how probable each is. A model that is off by more
# than the points' noise is improbable, as it must be: with equal weights false points near four hidden spots made a
# pose, with residuals of 0.3 to 1 px, in 11 % of the frames; so weighted in 2 %.
SHARES = np.array([1.0, 0.5, 0.1, 0.015])
LOG_WEIGHTS = np.log(np.array([0.002, 0.008, 0.495, 0.495]))
# A screen lit from the side on which no camera is (rear projection) is that seldom.
LOG_REAR = float(-np.log(100.0))
MISFIT_PER_POINT = 12.0  # squared sigmas of the two residuals of a point: above it (p = 2.5e-3) the worst is left out


@compiled
def complete_all(
    views: Views, spot_geometry: SpotGeometry, points: Points, limits: LabelLimits, front: Array, best: Best, most: int
) -> tuple[Array, Array, Ints, Array, Ints, Ints]:
    """The likeliest `most` candidates completed, as `complete` has it, with a leading axis (most,)."""
    count, n = most, views.shape[0]
    order = best_first(best.score[: best.taken[0]])
    R, t = np.empty((count, 3, 3)), np.empty((count, 3))
    labels, evidence = np.empty((count, n), np.int64), np.empty(count)
    share, expected = np.empty(count, np.int64), np.empty(count, np.int64)
    for k in range(count):
        i = order[k]
        R_k, t_k, evidence[k], share[k], expected[k] = complete(
            views,
            spot_geometry,
            points,
            limits,
            front,
            best.seed_view[i],
            best.seed_point[i],
            best.R[i].copy(),
            best.t[i].copy(),
            labels[k],
        )
        for a in range(3):
            t[k, a] = t_k[a]
            for b in range(3):
                R[k, a, b] = R_k[a, b]
    return R, t, labels, evidence, share, expected


@compiled
def complete(
    views: Views,
    spot_geometry: SpotGeometry,
    points: Points,
    limits: LabelLimits,
    front: Array,
    seed_view: Ints,
    seed_point: Ints,
    R: Array,
    t: Array,
    labels: Ints,
) -> tuple[Array, Array, float, int, int]:
    """The pose R, t, its evidence (nats, without the prior's volume; -inf: refused), the best share, expected views.

    Starts from three spots at (R, t); labels (n,) is filled. front (n, 4): the screen of each view as a plane
    (n . x = d) with the normal towards the camera.
    """
    n = views.shape[0]
    uv, J, H, left = np.empty((n, 2)), np.empty((n, 2, 6)), np.empty((6, 6)), np.empty((2, 6))
    refused = np.zeros(n, np.bool_)
    for v in range(n):
        labels[v] = NO_POINT
    for i in range(3):
        labels[seed_view[i]] = seed_point[i]
    for _ in range(2):
        for v in range(n):
            refused[v] = False
        while True:
            R, t, ok = _fit(views, spot_geometry, points, labels, 1.0, R, t, 2, uv, J, H)
            if not ok:
                return R, t, -np.inf, 0, 0
            chosen, smallest = -1, np.inf
            a = b = c = 0.0
            for v in range(n):
                if (
                    labels[v] != NO_POINT
                    or refused[v]
                    or not spot_geometry.has_image[v]
                    or not inside(uv[v], spot_geometry.size[v])
                ):
                    continue
                a_, b_, c_ = predicted_spread(H, J[v], left)
                if a_ + c_ < smallest:
                    chosen, smallest, a, b, c = v, a_ + c_, a_, b_, c_
            if chosen < 0:
                break
            p = _nearest(spot_geometry, points, limits, labels, chosen, uv[chosen], a, b, c)
            if p == NO_POINT:
                refused[chosen] = True
            else:
                labels[chosen] = p
    R, t, ok = _fit(views, spot_geometry, points, labels, 1.0, R, t, 6, uv, J, H)
    while ok:
        worst = _worst(spot_geometry, points, labels, uv, J, H, left)
        if worst < 0:
            break
        labels[worst] = NO_POINT
        if distinct_spots(labels, spot_geometry.spot) < limits.min_spots:
            ok = False
        else:
            R, t, ok = _fit(views, spot_geometry, points, labels, 1.0, R, t, 6, uv, J, H)
    if not ok or distinct_spots(labels, spot_geometry.spot) < limits.min_spots or not allowed(limits, R, t):
        return R, t, -np.inf, 0, 0
    return _evidence(views, spot_geometry, points, limits, front, labels, R, t, uv, J, H)


@compiled
def _fit(
    views: Views,
    spot_geometry: SpotGeometry,
    points: Points,
    labels: Ints,
    share: float,
    R: Array,
    t: Array,
    steps: int,
    uv: Array,
    J: Array,
    H: Array,
) -> tuple[Array, Array, bool]:
    """Gauss-Newton on the labelled points, with the model's error at a share of its allowance.

    Leaves all views' pixels and Jacobians at that pose, and the Cholesky factor of its information in H.
    """
    n = views.shape[0]
    g, left = np.empty(6), np.empty(2)
    model = np.empty((2, 2))
    for step in range(steps + 1):
        for i in range(6):
            g[i] = 0.0
            for j in range(6):
                H[i, j] = 0.0
        for v in range(n):
            there = project_view(views, v, R, t, uv[v], J[v])
            if labels[v] == NO_POINT:
                continue
            if not there:
                return R, t, False
            p = labels[v]
            for i in range(2):
                for j in range(2):
                    model[i, j] = spot_geometry.known_cov[v, i, j]
                model[i, i] += share * share * spot_geometry.allowance
            det = add_information(H, J[v], points.cov[p], model)
            a, b, c = (
                points.cov[p, 0, 0] + model[0, 0],
                points.cov[p, 0, 1] + model[0, 1],
                points.cov[p, 1, 1] + model[1, 1],
            )
            du, dv = points.uv[p, 0] - uv[v, 0], points.uv[p, 1] - uv[v, 1]
            left[0], left[1] = (c * du - b * dv) / det, (a * dv - b * du) / det
            for i in range(6):
                g[i] += J[v, 0, i] * left[0] + J[v, 1, i] * left[1]
        if cholesky(H) == -np.inf:
            return R, t, False
        if step == steps:
            break
        _solve_with(H, g)
        size = 0.0
        for i in range(6):
            size += g[i] * g[i]
        if size > 0.25:
            for i in range(6):
                g[i] *= 0.5 / np.sqrt(size)
        R, t = _moved(R, t, g)
    return R, t, True


@compiled
def _solve_with(L: Array, x: Array) -> None:
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
def _nearest(
    spot_geometry: SpotGeometry,
    points: Points,
    limits: LabelLimits,
    labels: Ints,
    v: int,
    uv: Array,
    a: float,
    b: float,
    c: float,
) -> int:
    """The free point that explains a view best, or NO_POINT where none is likelier than a missed spot."""
    camera = spot_geometry.camera[v]
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
        A = a + points.cov[p, 0, 0] + spot_geometry.model_cov[v, 0, 0]
        B = b + points.cov[p, 0, 1] + spot_geometry.model_cov[v, 0, 1]
        C = c + points.cov[p, 1, 1] + spot_geometry.model_cov[v, 1, 1]
        det = A * C - B * B
        d2 = (C * du * du - 2 * B * du * dv + A * dv * dv) / det
        value = -0.5 * (np.log(det) + d2)
        if d2 < GATE and value > best:
            best, chosen = value, p
    return chosen


@compiled
def _worst(
    spot_geometry: SpotGeometry, points: Points, labels: Ints, uv: Array, J: Array, L: Array, left: Array
) -> int:
    """The view whose point misfits most for its share of the fit, if any misfits; else -1."""
    worst, largest = -1, MISFIT_PER_POINT
    for v in range(labels.shape[0]):
        p = labels[v]
        if p == NO_POINT:
            continue
        a, b, c = predicted_spread(L, J[v], left)
        A = points.cov[p, 0, 0] + spot_geometry.model_cov[v, 0, 0]
        B = points.cov[p, 0, 1] + spot_geometry.model_cov[v, 0, 1]
        C = points.cov[p, 1, 1] + spot_geometry.model_cov[v, 1, 1]
        # The residual's own covariance: noise less what the fit has adapted to. Where that is all, nothing is tested.
        a, b, c = max(A - a, 1e-3 * A), B - b, max(C - c, 1e-3 * C)
        det = a * c - b * b
        if not det > 1e-6 * A * C:
            continue
        du, dv = points.uv[p, 0] - uv[v, 0], points.uv[p, 1] - uv[v, 1]
        d2 = (c * du * du - 2 * b * du * dv + a * dv * dv) / det
        if d2 > largest:
            worst, largest = v, d2
    return worst


@compiled
def _first_of_spot(spot: Ints, labels: Ints, v: int) -> int:
    """The first view that has a point of the same spot as view v."""
    for w in range(v):
        if labels[w] != NO_POINT and spot[w] == spot[v]:
            return w
    return v


@compiled
def _evidence(
    views: Views,
    spot_geometry: SpotGeometry,
    points: Points,
    limits: LabelLimits,
    front: Array,
    labels: Ints,
    R: Array,
    t: Array,
    uv: Array,
    J: Array,
    H: Array,
) -> tuple[Array, Array, float, int, int]:
    n = views.shape[0]
    found, missed = np.log(limits.p_detect), np.log(1 - limits.p_detect)
    fixed = 3 * LOG_2PI
    cameras = points.first.shape[0] - 1
    for c in range(cameras):
        used = 0
        for v in range(n):
            used += (
                spot_geometry.camera[v] == c
                and labels[v] != NO_POINT
                and _first_of_spot(spot_geometry.spot, labels, v) == v
            )
        fixed += points.log_unused[c, used]
    logs = np.full(SHARES.shape[0], -np.inf)
    best, best_R, best_t = 0, R, t
    count = expected = 0
    for v in range(n):
        if labels[v] != NO_POINT:
            count += 1
            fixed += found - LOG_2PI
        elif spot_geometry.has_image[v] and inside(uv[v], spot_geometry.size[v]):
            expected += 1
            fixed += missed
    for v in range(n):
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
            fixed += LOG_REAR
    for k in range(SHARES.shape[0]):
        R, t, ok = _fit(views, spot_geometry, points, labels, SHARES[k], R, t, 2, uv, J, H)
        if not ok:
            break
        value = fixed + LOG_WEIGHTS[k]
        for i in range(6):
            value -= np.log(H[i, i])
        for v in range(n):
            p = labels[v]
            if p == NO_POINT:
                continue
            allowance = SHARES[k] ** 2 * spot_geometry.allowance
            A = points.cov[p, 0, 0] + spot_geometry.known_cov[v, 0, 0] + allowance
            B = points.cov[p, 0, 1] + spot_geometry.known_cov[v, 0, 1]
            C = points.cov[p, 1, 1] + spot_geometry.known_cov[v, 1, 1] + allowance
            det = A * C - B * B
            du, dv = points.uv[p, 0] - uv[v, 0], points.uv[p, 1] - uv[v, 1]
            value -= 0.5 * (np.log(det) + (C * du * du - 2 * B * du * dv + A * dv * dv) / det)
            w = _first_of_spot(spot_geometry.spot, labels, v)
            if w != v:
                # A false light on the screen, too, is seen by both cameras, at the same place of the screen.
                q = labels[w]
                gap2 = 0.0
                for a in range(3):
                    gap2 += (points.world[p, a] - points.world[q, a]) ** 2
                var = 0.5 * points.m_per_px[p] ** 2 * (A + C) + 0.5 * points.m_per_px[q] ** 2 * (
                    points.cov[q, 0, 0]
                    + points.cov[q, 1, 1]
                    + spot_geometry.known_cov[w, 0, 0]
                    + spot_geometry.known_cov[w, 1, 1]
                    + 2 * allowance
                )
                value += LOG_2PI + np.log(var / points.m_per_px[p] ** 2) + 0.5 * gap2 / var
        logs[k] = value
        if value >= logs[best]:
            best, best_R, best_t = k, R, t
    total = 0.0
    for k in range(SHARES.shape[0]):
        total += np.exp(logs[k] - logs[best])
    return best_R, best_t, logs[best] + np.log(total), best, count + expected
