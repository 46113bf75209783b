"""Candidate poses from three spots each, weighed by the points that they explain, compiled.

Every set of three spots of a list is given every combination of points of their screens. Each pose that puts the three
on their points predicts the other spots, with a covariance that follows from the three points' own: the gates are so
many sigmas wide, whatever the focal length, the noise or the arrangement of the beams. The likelihood is the usual one
of multi-target data association (Bar-Shalom & Li 1995, sec. 6.2), with the three points taken as measurements of a
pose of which nothing is known: their density is 1 / |det J|, J the Jacobian of their six pixels. Source: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_projection import Views, inside, project_view
from geometry.pose_solver.three_spots import pose_of_lengths, spot_lengths
from tracking.labelling.points import Points, PointsOnScreens

NO_POINT = -1
GATE = 25.0  # squared sigmas: beyond it a point is not this spot (p = 4e-6)
LOG_2PI = float(np.log(2 * np.pi))
# Two candidates with the same labels are one if their poses differ by less than this: both lead to the same fit.
SAME_M, SAME_TRACE = 0.05, 0.005  # m; 3 - trace of the turn between them, 0.005: 4 deg


class SpotGeometry(NamedTuple):
    """What the search needs of the n views beside their projection."""

    camera: Ints  # (n,)
    spot: Ints  # (n,)
    size: Array  # (n, 2) px: width, height of the picture
    has_image: Bools  # (n,)
    model_cov: Array  # (n, 2, 2) px^2, what the model may be off at most: the sum of
    known_cov: Array  # (n, 2, 2) px^2, what the calibration's errors are known to make ...
    allowance: float  # px^2, ... and the largest allowance for the rest
    view_at: Ints  # (spots, cameras) the view of a spot in a camera, or -1
    spot_point: Array  # (spots, 3) m, in body
    spot_ray: Array  # (spots, 3) in body
    spot_screen: Ints  # (spots,) -1: observed by no camera that has a picture


class LabelLimits(NamedTuple):
    """A prior's numbers."""

    R: Array  # (3, 3)
    t: Array  # (3,) m
    half_width_m: float
    least_trace: float  # of the turn from R
    p_detect: float
    min_spots: int


class Best(NamedTuple):
    """The best candidates so far, in no order."""

    score: Array  # (most,) nats
    R: Array  # (most, 3, 3)
    t: Array  # (most, 3) m
    seed_view: Ints  # (most, 3) the three spots' views ...
    seed_point: Ints  # (most, 3) ... and points
    labels: Ints  # (most, n) the point that each view takes, or NO_POINT
    taken: Ints  # (2,): how many there are; the place of the worst

    @staticmethod
    def none(most: int, views: int) -> Best:
        """Room for so many."""
        return Best(
            np.full(most, -np.inf),
            np.zeros((most, 3, 3)),
            np.zeros((most, 3)),
            np.zeros((most, 3), dtype=np.int64),
            np.zeros((most, 3), dtype=np.int64),
            np.full((most, views), NO_POINT),
            np.zeros(2, dtype=np.int64),
        )


@compiled
def generate(
    views: Views,
    spot_geometry: SpotGeometry,
    points: Points,
    screens: PointsOnScreens,
    reached: Bools,
    limits: LabelLimits,
    triples: Ints,
    best: Best,
) -> int:
    """Weigh all poses that three spots of a list, triples (k, 3), make with the points; how many poses there were.

    reached: (spots, m) which points each spot may light under the prior. The best candidates go into `best`.
    """
    n = views.shape[0]
    body, rays, lab, lengths, work = (
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((8, 3)),
        np.empty((16, 9)),
    )
    R, t = np.empty((3, 3)), np.empty(3)
    uv, J = np.empty((n, 2)), np.empty((n, 2, 6))
    H, left = np.empty((6, 6)), np.empty((2, 6))
    seed_view, seed_point = np.empty(3, np.int64), np.empty(3, np.int64)
    labels, gain = np.empty(n, np.int64), np.empty(n)
    tried = 0
    for row in range(triples.shape[0]):
        for i in range(3):
            for a in range(3):
                body[i, a] = spot_geometry.spot_point[triples[row, i], a]
                rays[i, a] = spot_geometry.spot_ray[triples[row, i], a]
        s0, s1, s2 = triples[row, 0], triples[row, 1], triples[row, 2]
        k0, k1, k2 = spot_geometry.spot_screen[s0], spot_geometry.spot_screen[s1], spot_geometry.spot_screen[s2]
        for i0 in range(screens.first[k0], screens.first[k0 + 1]):
            p0 = screens.point[i0]
            if not reached[s0, p0]:
                continue
            for i1 in range(screens.first[k1], screens.first[k1 + 1]):
                p1 = screens.point[i1]
                if p1 == p0 or not reached[s1, p1]:
                    continue
                for i2 in range(screens.first[k2], screens.first[k2 + 1]):
                    p2 = screens.point[i2]
                    if p2 == p0 or p2 == p1 or not reached[s2, p2]:  # noqa: SIM109 (compiled)
                        continue
                    for a in range(3):
                        lab[0, a], lab[1, a], lab[2, a] = points.world[p0, a], points.world[p1, a], points.world[p2, a]
                    count = spot_lengths(body, rays, lab, work, lengths)
                    for solution in range(count):
                        if not pose_of_lengths(body, rays, lab, lengths[solution], R, t):
                            continue
                        if not allowed(limits, R, t):
                            continue
                        tried += 1
                        for i in range(3):
                            s = triples[row, i]
                            p = p0 if i == 0 else (p1 if i == 1 else p2)
                            seed_point[i] = p
                            seed_view[i] = spot_geometry.view_at[s, camera_of(points.first, p)]
                        score = _weigh(
                            views,
                            spot_geometry,
                            points,
                            limits,
                            R,
                            t,
                            seed_view,
                            seed_point,
                            labels,
                            gain,
                            uv,
                            J,
                            H,
                            left,
                        )
                        if score > -np.inf:
                            _keep(best, score, R, t, seed_view, seed_point, labels)
    return tried


@compiled
def allowed(limits: LabelLimits, R: Array, t: Array) -> bool:
    """Whether the prior holds a pose."""
    trace = 0.0
    for a in range(3):
        if not abs(t[a] - limits.t[a]) <= limits.half_width_m:
            return False
        for b in range(3):
            trace += R[a, b] * limits.R[a, b]
    return trace >= limits.least_trace


@compiled
def camera_of(first: Ints, point: int) -> int:
    """The camera of a point."""
    c = 0
    while point >= first[c + 1]:
        c += 1
    return c


@compiled
def _weigh(
    views: Views,
    spot_geometry: SpotGeometry,
    points: Points,
    limits: LabelLimits,
    R: Array,
    t: Array,
    seed_view: Ints,
    seed_point: Ints,
    labels: Ints,
    gain: Array,
    uv: Array,
    J: Array,
    H: Array,
    left: Array,
) -> float:
    """The log-likelihood of a pose from three spots, and the labels (n,) that it gives; -inf if they are too few."""
    n = views.shape[0]
    found, missed = np.log(limits.p_detect), np.log(1 - limits.p_detect)
    for v in range(n):
        labels[v] = NO_POINT
        gain[v] = 0.0
        project_view(views, v, R, t, uv[v], J[v])
    for i in range(6):
        for j in range(6):
            H[i, j] = 0.0
    score = 0.0
    for i in range(3):
        v, p = seed_view[i], seed_point[i]
        if np.isnan(uv[v, 0]):
            return -np.inf
        labels[v] = p
        det = add_information(H, J[v], points.cov[p], spot_geometry.model_cov[v])
        score += found - points.log_density[spot_geometry.camera[v]] - 0.5 * np.log(det)
        gain[v] = np.inf
    log_det = cholesky(H)
    if log_det == -np.inf:
        return -np.inf
    score -= 0.5 * log_det
    for v in range(n):
        if labels[v] != NO_POINT or not spot_geometry.has_image[v] or not inside(uv[v], spot_geometry.size[v]):
            continue
        a, b, c = predicted_spread(H, J[v], left)
        a, b, c = (
            a + spot_geometry.model_cov[v, 0, 0],
            b + spot_geometry.model_cov[v, 0, 1],
            c + spot_geometry.model_cov[v, 1, 1],
        )
        camera = spot_geometry.camera[v]
        best, best_point = missed, NO_POINT
        for p in range(points.first[camera], points.first[camera + 1]):
            du, dv = points.uv[p, 0] - uv[v, 0], points.uv[p, 1] - uv[v, 1]
            A, B, C = a + points.cov[p, 0, 0], b + points.cov[p, 0, 1], c + points.cov[p, 1, 1]
            det = A * C - B * B
            d2 = (C * du * du - 2 * B * du * dv + A * dv * dv) / det
            if not d2 < GATE:
                continue
            value = found - points.log_density[camera] - LOG_2PI - 0.5 * (np.log(det) + d2)
            if value > best:
                best, best_point = value, p
        if best_point == NO_POINT:
            score += missed
            continue
        # One point is one spot: the view that gains more has it.
        owner = -1
        for other in range(n):
            if labels[other] == best_point:
                owner = other
        if owner >= 0 and gain[owner] >= best:
            score += missed
            continue
        if owner >= 0:
            score += missed - gain[owner]
            labels[owner] = NO_POINT
        labels[v], gain[v] = best_point, best
        score += best
    if distinct_spots(labels, spot_geometry.spot) < limits.min_spots:
        return -np.inf
    return score


@compiled
def distinct_spots(labels: Ints, spot: Ints) -> int:
    """How many spots have a point, in whatever views."""
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
    """The lower Cholesky factor in place (6, 6), and log det H; -inf where H is singular."""
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


@compiled
def _keep(best: Best, score: float, R: Array, t: Array, seed_view: Ints, seed_point: Ints, labels: Ints) -> None:
    """Put a candidate among the best, in place of its double or of the worst, if it is better."""
    most, n = best.labels.shape
    count, place = best.taken[0], best.taken[1]
    if count == most and score <= best.score[place]:
        return
    if count < most:
        place = count
    for k in range(count):
        if not _same(best, k, R, t, labels):
            continue
        if score <= best.score[k]:
            return
        place = k
        break
    if place == count:
        best.taken[0] = count + 1
    best.score[place] = score
    for a in range(3):
        best.t[place, a] = t[a]
        best.seed_view[place, a], best.seed_point[place, a] = seed_view[a], seed_point[a]
        for b in range(3):
            best.R[place, a, b] = R[a, b]
    for v in range(n):
        best.labels[place, v] = labels[v]
    worst = 0
    for k in range(best.taken[0]):
        if best.score[k] < best.score[worst]:
            worst = k
    best.taken[1] = worst


@compiled
def _same(best: Best, k: int, R: Array, t: Array, labels: Ints) -> bool:
    for v in range(labels.shape[0]):
        if best.labels[k, v] != labels[v]:
            return False
    trace = 0.0
    for a in range(3):
        if abs(best.t[k, a] - t[a]) > SAME_M:
            return False
        for b in range(3):
            trace += best.R[k, a, b] * R[a, b]
    return 3.0 - trace < SAME_TRACE
