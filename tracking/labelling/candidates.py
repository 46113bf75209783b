"""Candidate poses from three spots each, scored by the points that they explain, compiled.

Every set of three spots of a list is combined with every combination of points of their screens. Each pose that puts
the three spots on their points predicts the other spots, with a covariance that follows from the three points' own: the
gates are a number of sigmas wide, for any focal length, noise and arrangement of beams. The likelihood is the usual one
of multi-target data association (Bar-Shalom & Li 1995, sec. 6.2), with the three points taken as measurements of a
pose with a flat prior: their density is 1 / |det J|, J the Jacobian of their six pixels. Source: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled, compiled_in_caller
from geometry.compiled_projection import inside, project_view
from geometry.pose_solver.three_spots import pose_of_lengths, spot_lengths
from tracking.labelling.points import (
    GATE,
    LOG_2PI,
    NO_POINT,
    LabelProblem,
    PointsOnScreens,
    PoseWorkspace,
    add_information,
    allowed,
    cholesky,
    clear,
    distinct_spots,
    pose_workspace,
    predicted_spread,
)

# Two candidates with the same labels are one if their poses differ by less than this: both lead to the same fit.
SAME_M, SAME_TRACE = 0.05, 0.005  # m; 3 - trace of the rotation between them: 4 deg


class BestCandidates(NamedTuple):
    """The best candidates so far, unordered."""

    score: Array  # (most,) nats
    R: Array  # (most, 3, 3)
    t: Array  # (most, 3) m
    seed_view: Ints  # (most, 3) the three spots' views ...
    seed_point: Ints  # (most, 3) ... and points
    labels: Ints  # (most, n) the point assigned to each view, or NO_POINT
    taken: Ints  # (2,): their number; the row of the worst

    @staticmethod
    def none(most: int, views: int) -> BestCandidates:
        """An empty set for at most `most` candidates."""
        return BestCandidates(
            np.full(most, -np.inf),
            np.zeros((most, 3, 3)),
            np.zeros((most, 3)),
            np.zeros((most, 3), dtype=np.int64),
            np.zeros((most, 3), dtype=np.int64),
            np.full((most, views), NO_POINT),
            np.zeros(2, dtype=np.int64),
        )


class Candidate(NamedTuple):
    """One candidate."""

    R: Array  # (3, 3)
    t: Array  # (3,) m
    seed_view: Ints  # (3,)
    seed_point: Ints  # (3,)
    labels: Ints  # (n,)
    gain: Array  # (n,) nats, the log-likelihood gained by each label


class ThreeSpots(NamedTuple):
    """Three spots and their points, with the workspace of the closed-form solution."""

    body: Array  # (3, 3) m, a point on each ray, in body
    rays: Array  # (3, 3) in body
    world: Array  # (3, 3) m, the points on the screens
    lengths: Array  # (8, 3) m, along the rays, of all solutions
    scratch: Array  # (16, 9)


@compiled
def generate(
    problem: LabelProblem, screens: PointsOnScreens, reached: Bools, triples: Ints, best: BestCandidates
) -> int:
    """Score all poses from the sets of three spots `triples` (k, 3) with all their points; returns their number.

    reached (spots, m): the points that each spot may light under the prior. The best candidates are entered in `best`.
    """
    n = problem.views.shape[0]
    spots = problem.spots
    three = ThreeSpots(np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((8, 3)), np.empty((16, 9)))
    candidate = Candidate(
        np.empty((3, 3)),
        np.empty(3),
        np.empty(3, np.int64),
        np.empty(3, np.int64),
        np.empty(n, np.int64),
        np.empty(n),
    )
    work = pose_workspace(n)
    tried = 0
    for row in range(triples.shape[0]):
        for i in range(3):
            for a in range(3):
                three.body[i, a] = spots.spot_point[triples[row, i], a]
                three.rays[i, a] = spots.spot_ray[triples[row, i], a]
        s0, s1, s2 = triples[row, 0], triples[row, 1], triples[row, 2]
        k0, k1, k2 = spots.spot_screen[s0], spots.spot_screen[s1], spots.spot_screen[s2]
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
                    candidate.seed_point[0], candidate.seed_point[1], candidate.seed_point[2] = p0, p1, p2
                    tried += _add_poses(problem, triples[row], three, candidate, work, best)
    return tried


@compiled_in_caller
def _add_poses(
    problem: LabelProblem,
    triple: Ints,
    three: ThreeSpots,
    candidate: Candidate,
    work: PoseWorkspace,
    best: BestCandidates,
) -> int:
    """Score the poses that put the spots `triple` (3,) on the points candidate.seed_point; returns their number."""
    points, spots = problem.points, problem.spots
    for i in range(3):
        p = candidate.seed_point[i]
        for a in range(3):
            three.world[i, a] = points.world[p, a]
        candidate.seed_view[i] = spots.view_at[triple[i], _camera_of(points.first, p)]
    tried = 0
    for solution in range(spot_lengths(three.body, three.rays, three.world, three.scratch, three.lengths)):
        if not pose_of_lengths(
            three.body, three.rays, three.world, three.lengths[solution], candidate.R, candidate.t
        ) or not allowed(problem.limits, candidate.R, candidate.t):
            continue
        tried += 1
        score = _score(problem, candidate, work)
        if score > -np.inf:
            _insert(best, score, candidate)
    return tried


@compiled
def _camera_of(first: Ints, point: int) -> int:
    """The camera of a point."""
    c = 0
    while point >= first[c + 1]:
        c += 1
    return c


@compiled
def _score(problem: LabelProblem, candidate: Candidate, work: PoseWorkspace) -> float:
    """The log-likelihood of a candidate, whose labels are filled; -inf if it has too few spots."""
    points, spots, limits = problem.points, problem.spots, problem.limits
    labels, gain, uv, J, H = candidate.labels, candidate.gain, work.uv, work.J, work.H
    n = problem.views.shape[0]
    found, missed = np.log(limits.p_detect), np.log(1 - limits.p_detect)
    for v in range(n):
        labels[v] = NO_POINT
        gain[v] = 0.0
        project_view(problem.views, v, candidate.R, candidate.t, uv[v], J[v])
    clear(H)
    score = 0.0
    for i in range(3):
        v, p = candidate.seed_view[i], candidate.seed_point[i]
        if np.isnan(uv[v, 0]):
            return -np.inf
        labels[v] = p
        det = add_information(H, J[v], points.cov[p], spots.model_cov[v])
        score += found + points.log_shape[p] - points.log_density[spots.camera[v]] - 0.5 * np.log(det)
        gain[v] = np.inf
    log_det = cholesky(H)
    if log_det == -np.inf:
        return -np.inf
    score -= 0.5 * log_det
    for v in range(n):
        if labels[v] != NO_POINT or not spots.has_image[v] or not inside(uv[v], spots.size[v]):
            continue
        best, best_point = best_point_of(problem, v, work, False, labels)
        if best_point == NO_POINT:
            score += missed
            continue
        # A point is assigned to one spot: to the view with the larger gain.
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
    if distinct_spots(labels, spots.spot) < limits.min_spots:
        return -np.inf
    return score


@compiled
def best_point_of(
    problem: LabelProblem, v: int, work: PoseWorkspace, only_free: bool, labels: Ints
) -> tuple[float, int]:
    """The log-likelihood gained by the best point of a view, and that point; NO_POINT if a miss is more likely.

    only_free: without the points that have a label in `labels` (n,).
    """
    points, spots = problem.points, problem.spots
    found, missed = np.log(problem.limits.p_detect), np.log(1 - problem.limits.p_detect)
    a, b, c = predicted_spread(work.H, work.J[v], work.left)
    a, b, c = a + spots.model_cov[v, 0, 0], b + spots.model_cov[v, 0, 1], c + spots.model_cov[v, 1, 1]
    camera = spots.camera[v]
    best, best_point = missed, NO_POINT
    for p in range(points.first[camera], points.first[camera + 1]):
        free = True
        if only_free:
            for other in range(labels.shape[0]):
                free &= labels[other] != p
        du, dv = points.uv[p, 0] - work.uv[v, 0], points.uv[p, 1] - work.uv[v, 1]
        A, B, C = a + points.cov[p, 0, 0], b + points.cov[p, 0, 1], c + points.cov[p, 1, 1]
        det = A * C - B * B
        d2 = (C * du * du - 2 * B * du * dv + A * dv * dv) / det
        if not free or not d2 < GATE:
            continue
        value = found + points.log_shape[p] - points.log_density[camera] - LOG_2PI - 0.5 * (np.log(det) + d2)
        if value > best:
            best, best_point = value, p
    return best, best_point


@compiled
def _insert(best: BestCandidates, score: float, candidate: Candidate) -> None:
    """Enter a candidate in place of its duplicate or of the worst one, if it has a higher score."""
    most, n = best.labels.shape
    count, place = best.taken[0], best.taken[1]
    if count == most and score <= best.score[place]:
        return
    if count < most:
        place = count
    for k in range(count):
        if not _same(best, k, candidate):
            continue
        if score <= best.score[k]:
            return
        place = k
        break
    if place == count:
        best.taken[0] = count + 1
    best.score[place] = score
    for a in range(3):
        best.t[place, a] = candidate.t[a]
        best.seed_view[place, a], best.seed_point[place, a] = candidate.seed_view[a], candidate.seed_point[a]
        for b in range(3):
            best.R[place, a, b] = candidate.R[a, b]
    for v in range(n):
        best.labels[place, v] = candidate.labels[v]
    worst = 0
    for k in range(best.taken[0]):
        if best.score[k] < best.score[worst]:
            worst = k
    best.taken[1] = worst


@compiled
def _same(best: BestCandidates, k: int, candidate: Candidate) -> bool:
    """Whether a candidate has the labels and about the pose of entry k."""
    for v in range(candidate.labels.shape[0]):
        if best.labels[k, v] != candidate.labels[v]:
            return False
    trace = 0.0
    for a in range(3):
        if abs(best.t[k, a] - candidate.t[a]) > SAME_M:
            return False
        for b in range(3):
            trace += best.R[k, a, b] * candidate.R[a, b]
    return 3.0 - trace < SAME_TRACE
