"""Several answers to where the vehicle is, each with its own labels, until the evidence decides; compiled.

Every hypothesis is moved on twice, steadily and with a jump of its velocities (a manoeuvre); each time the frame's
detections are assigned jointly (tracking/rigid_body/association.py), and each assignment is a child with an exact
update of its own. All children compete by likelihood. Source: ours; a multiple hypothesis tracker (Reid 1979) whose one
target is the vehicle, with the two models of motion as a branch of the tree.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry import compiled_linalg
from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_projection import Views
from tracking.rigid_body.association import (
    BLENDED,
    DetectionModel,
    FrameDetections,
    ViewTable,
    associate,
    expected_at,
    log_clutter_ratio,
)
from tracking.rigid_body.information import frame_information, size_of, widen_by_curvature
from tracking.rigid_body.motion import STATE, predicted, updated
from tracking.rigid_body.occlusion import MISSED, joint_log_likelihood, marginal, predict, update

MOST_CHILDREN = 48  # of one frame, over all hypotheses
MOST_KEPT = 8  # hypotheses from frame to frame
PRUNE_NATS = 12.0  # nats: a hypothesis so far behind is dropped
SAME = 0.7  # two hypotheses with one assignment whose states differ by less than this in sigmas are one
MOST_STEPS, MOST_HALVINGS = 8, 5  # of Gauss-Newton, and of one step
TOO_WIDE = 0.06  # m, rad: where a frame leaves its widest direction so open, it is not taken
LEAST_SHARE = 1e-3  # of the probability: hypotheses below it, however far away, do not widen the covariance
FEW = 4  # spots: fewer do not tell a lost vehicle from one that is mostly hidden
VAGUE_PX = 15.0  # 1 sigma of a predicted spot: beyond it the whole picture is searched at once
CHECK_PX = 8.0  # 1 sigma of a predicted spot: up to it the prediction checks a label
FAR_TOO_VAGUE_PX = 45.0  # beyond it three spots fit anywhere too
SURE = 1 - 2.5e-3  # label probability (6 nats) where nothing else checks a label
MIN_CONFIRMING_SPOTS = 3  # spots: where so many lie in their narrow gates, the velocities have not jumped
LEAST_TO_TURN = 6.0  # nats: a hypothesis so far behind is not tried with a manoeuvre as well
UNEXPECTED_SIGMAS = (
    3.5  # sigmas of a misfit's own scatter: beyond it a manoeuvre is considered although every spot is found
)
_apart, _apply, _dot, _block = (
    compiled_linalg.pose_minus,
    compiled_linalg.apply,
    compiled_linalg.dot,
    compiled_linalg.block,
)
_moved, _posterior, _solve = compiled_linalg.pose_plus, compiled_linalg.posterior, compiled_linalg.solve
_put, _put_matrix, _best_first = compiled_linalg.copy_into, compiled_linalg.copy_matrix_into, compiled_linalg.best_first


class Hypotheses(NamedTuple):
    """h answers, in no order. Rotations, translations, motions as in tracking/rigid_body/motion.py."""

    R: Array  # (h, 3, 3)
    t: Array  # (h, 3), m
    m: Array  # (h, 12)
    P: Array  # (h, 18, 18)
    weight: Array  # (h,) nats
    shown: Array  # (h, n + groups) that each spot is not hidden, and that each screen is lit; see occlusion.py


class Children(NamedTuple):
    """The hypotheses after a frame, before they are sifted: c of room for MOST_CHILDREN."""

    after: Hypotheses
    assigned: Ints  # (c, n) as in associate
    manoeuvre: Bools  # (c,)
    parent: Ints  # (c,)


class Dynamics(NamedTuple):
    """How the vehicle may move; pairs are of translation and rotation."""

    jerk: Array  # (6,) spectral densities of the steady motion's jerk, by axis as in motion.py
    jump: Array  # (2,) variances of a manoeuvre's jump of the velocities
    unsteady: Array  # (2,) and of the accelerations
    p_manoeuvre: float  # per frame


@compiled
def no_children(n: int, groups: int) -> Children:
    """An empty list for n views in so many groups."""
    c = MOST_CHILDREN
    return Children(_room_for(c, n + groups), np.empty((c, n), np.int64), np.zeros(c, np.bool_), np.zeros(c, np.int64))


@compiled
def _room_for(h: int, chances: int) -> Hypotheses:
    """Room for h hypotheses with so many chances of being shown."""
    return Hypotheses(
        np.empty((h, 3, 3)),
        np.empty((h, 3)),
        np.empty((h, 12)),
        np.empty((h, STATE, STATE)),
        np.empty(h),
        np.empty((h, chances)),
    )


@compiled
def _put_hypothesis(
    out: Hypotheses, k: int, R: Array, t: Array, m: Array, P: Array, weight: float, shown: Array
) -> None:
    """Let hypothesis k of a list be this."""
    _put_matrix(out.R[k], R)
    _put(out.t[k], t)
    _put(out.m[k], m)
    _put_matrix(out.P[k], P)
    out.weight[k] = weight
    _put(out.shown[k], shown)


@compiled
def chosen_points(frame: FrameDetections, assigned: Ints, calibration_cov: Array) -> tuple[Bools, Array, Array]:
    """Which views take part in the pose, with pixels (n, 2) and covariances (n, 2, 2), of one assignment (n,)."""
    n = assigned.shape[0]
    use, uv, cov = np.zeros(n, np.bool_), np.empty((n, 2)), np.empty((n, 2, 2))
    for i in range(n):
        d = assigned[i]
        if 0 <= d < BLENDED:
            use[i] = True
            for a in range(2):
                uv[i, a] = frame.uv[d, a]
                for b in range(2):
                    cov[i, a, b] = frame.cov[d, a, b] + calibration_cov[i, a, b]
    return use, uv, cov


@compiled
def iterated_update(
    views: Views,
    frame: FrameDetections,
    calibration_cov: Array,
    before: tuple[Array, Array, Array, Array],
    assigned: Ints,
    R: Array,
    t: Array,
) -> tuple[Array, Array, Array, Array, float, float, int]:
    """The exact update of a predicted state by one assignment, linearised at its own optimum; start pose (R, t).

    before: R, t, m, P. Returns the same after, the Gaussian part of the log-likelihood, the misfit (chi-square of as
    many numbers as the spots have) and the number of spots. A spot that the pose found does not project makes the
    likelihood 0. An update that does not settle leaves the state as it was, and counts by its misfit there.
    """
    R0, t0, m0, P0 = before
    use, uv, cov = chosen_points(frame, assigned, calibration_cov)
    wanted = 0
    for i in range(use.shape[0]):
        wanted += 1 if use[i] else 0
    if wanted == 0:
        return R0, t0, m0.copy(), P0.copy(), 0.0, 0.0, 0
    pose_P0 = _block(P0, 6)
    found = _found_near(views, (R0, t0, pose_P0), use, uv, cov, wanted, R, t)
    R, t, pose_P, L, r, gaussian, misfit, settled = found
    if gaussian == -np.inf:
        return R0, t0, m0.copy(), P0.copy(), gaussian, misfit, wanted
    # Where a direction stays open the spots' paths along it are not straight, and must not narrow what they do not see:
    # once more, with what the bend of each path is off by.
    sigma = widen_by_curvature(views, use, cov, R, t, pose_P)
    if sigma > 0.0:
        found = _found_near(views, (R0, t0, pose_P0), use, uv, cov, wanted, R, t)
        R, t, pose_P, L, r, gaussian, misfit, settled = found
    if not settled or sigma > TOO_WIDE:
        # So few spots of a vehicle that may be anywhere narrow nothing that a straight line could tell.
        return R0, t0, m0.copy(), P0.copy(), gaussian, misfit, wanted
    out_R, out_t, out_m, out_P, _, _ = updated(R0, t0, m0, P0, L, r)
    return out_R, out_t, out_m, out_P, gaussian, misfit, wanted


@compiled
def _found_near(
    views: Views,
    before: tuple[Array, Array, Array],
    use: Bools,
    uv: Array,
    cov: Array,
    wanted: int,
    R: Array,
    t: Array,
) -> tuple[Array, Array, Array, Array, Array, float, float, bool]:
    """The likeliest pose given a prior `before` (R, t, P of 6) and so many spots, by Gauss-Newton with halved steps.

    Starts at (R, t). Returns the pose, its covariance (6, 6), the spots' information matrix (6, 6) and vector (6,)
    about the prior's pose, the Gaussian part of the log-likelihood, the misfit, and whether the steps settled.
    """
    R0, t0, P0 = before
    eye = np.zeros((6, 6))
    for i in range(6):
        eye[i, i] = 1.0
    stiff, _ = _solve(P0, eye)  # the prior's information
    delta = _apart(R, t, R0, t0)
    L, g, chi2, count, log_norm = frame_information(views, R, t, use, uv, cov)
    cost = chi2 + size_of(stiff, delta) if count == wanted else np.inf
    P, r, log_det, settled = P0, np.zeros(6), 0.0, False
    for _ in range(MOST_STEPS):
        r = _apply(L, delta)
        for i in range(6):
            r[i] += g[i]
        P, log_det = _posterior(P0, L)
        moved = _apply(P, r)
        for i in range(6):
            moved[i] -= delta[i]
        # A thousandth of the pose's own sigma is good enough.
        settled = count == wanted and _dot(moved, _apply(L, moved)) < 1e-4
        better = False
        for _ in range(MOST_HALVINGS):
            if settled:
                break
            there = np.empty(6)
            for i in range(6):
                there[i] = delta[i] + moved[i]
                moved[i] *= 0.5
            R_new, t_new = _moved(R0, t0, there)
            L_new, g_new, chi2_new, count_new, norm_new = frame_information(views, R_new, t_new, use, uv, cov)
            cost_new = chi2_new + size_of(stiff, there)
            if count_new == wanted and cost_new < cost:
                R, t, delta, cost, better = R_new, t_new, there, cost_new, True
                L, g, chi2, count, log_norm = L_new, g_new, chi2_new, count_new, norm_new
                break
        if not better:
            break
    # The prior alone may make the likelihood small, never large.
    misfit = max(cost, 0.0)
    gaussian = -0.5 * (log_norm + log_det + misfit) if np.isfinite(misfit) else -np.inf
    return R, t, P, L, r, gaussian, misfit, settled


@compiled
def branch(
    views: Views,
    sights: ViewTable,
    frame: FrameDetections,
    chances: DetectionModel,
    dynamics: Dynamics,
    calibration_cov: Array,
    dt: float,
    old: Hypotheses,
) -> tuple[Children, int]:
    """The children of all hypotheses after a frame that comes dt (s) later."""
    n = sights.camera.shape[0]
    out = no_children(n, old.shown.shape[1] - n)
    count = 0
    nothing = np.zeros(2)
    best = -np.inf
    for h in range(old.t.shape[0]):
        if old.weight[h] < -PRUNE_NATS:
            continue
        shown = predict(old.shown[h], n) if dt > 0.0 else old.shown[h]
        shining = marginal(shown, sights.group)
        turning = False
        for mode in range(2):
            if mode == 1 and not turning:
                break
            jump, unsteady = (nothing, nothing) if mode == 0 else (dynamics.jump, dynamics.unsteady)
            if dt > 0.0:
                R, t, m, P, _ = predicted(old.R[h], old.t[h], old.m[h], old.P[h], dt, dynamics.jerk, jump, unsteady)
            else:
                R, t, m, P = old.R[h], old.t[h], old.m[h], old.P[h]
            prior = old.weight[h] + np.log(1 - dynamics.p_manoeuvre if mode == 0 else dynamics.p_manoeuvre)
            assigned, score, counted, R_b, t_b, b = associate(
                views, sights, frame, chances, R, t, _block(P, 6), shining, calibration_cov
            )
            # Upper bound of what `log_clutter_ratio` may add: no child is dropped before its likelihood is known.
            crowd = 0.0
            for i in range(n):
                crowd += frame.log_crowding[i]
            for k in range(b):
                if prior + score[k] + crowd < best - PRUNE_NATS or (k > 0 and score[k] < score[0] - PRUNE_NATS):
                    continue
                labelled = 0
                for i in range(n):
                    labelled += 1 if 0 <= assigned[k, i] < BLENDED else 0
                # Spots that were shining and are not found were hidden, or are elsewhere.
                sudden = _misses(assigned[k], shining)
                dim = P
                if mode == 0 and dt > 0.0 and labelled < MIN_CONFIRMING_SPOTS:
                    dim = _either_motion(old, h, P, dynamics, dt, sudden)
                before = (R, t, m, dim)
                R_k, t_k, m_k, P_k, gaussian, misfit, spots = iterated_update(
                    views, frame, calibration_cov, before, assigned[k], R_b[k], t_b[k]
                )
                if mode == 0 and 0 < labelled < MIN_CONFIRMING_SPOTS and dt > 0.0:
                    # The mixture is no less likely than its steady part: else a false third spot would seem likelier.
                    steady = (R, t, m, P)
                    _, _, _, _, narrow, misfit, _ = iterated_update(
                        views, frame, calibration_cov, steady, assigned[k], R_b[k], t_b[k]
                    )
                    gaussian = max(
                        gaussian, narrow + np.log(1.0 - (SUDDEN_MANOEUVRE if sudden else OCCLUDED_MANOEUVRE))
                    )
                if mode == 0 and k == 0:
                    dof = 2 * spots
                    turning = (
                        dt > 0.0
                        and old.weight[h] > -LEAST_TO_TURN
                        and (
                            misfit > dof + UNEXPECTED_SIGMAS * np.sqrt(2.0 * max(dof, 1))
                            or (labelled < MIN_CONFIRMING_SPOTS and _misses(assigned[k], shining))
                            or _misses_a_screen(assigned[k], shining, sights.group)
                        )
                    )
                if mode == 1 and labelled < MIN_CONFIRMING_SPOTS:
                    continue  # a bend is in the mixture above; a point or two would be one wherever they lie
                most = VAGUE_PX if labelled < MIN_CONFIRMING_SPOTS else FAR_TOO_VAGUE_PX
                if mode == 0 and dt > 0.0 and MIN_CONFIRMING_SPOTS <= labelled < FEW:
                    dim = _either_motion(old, h, P, dynamics, dt, sudden)
                if 0 < labelled < FEW and widest(views, R, t, dim, assigned[k]) > most:
                    # Where a spot may be anywhere some false point fits: so few say nothing of the pose.
                    R_k, t_k, m_k, P_k = R, t, m, dim
                total = (
                    prior
                    + counted[k]
                    + gaussian
                    + joint_log_likelihood(shown, sights.group, assigned[k], chances.detect)
                )
                total += log_clutter_ratio(views, sights, frame, R_k, t_k, P_k)
                if not np.isfinite(total):
                    continue
                best = max(best, total)
                after = update(shown, sights.group, assigned[k], chances.detect)
                count, _ = add_child(out, count, R_k, t_k, m_k, P_k, total, after, assigned[k], mode == 1, h)
    return out, count


SUDDEN_MANOEUVRE = 0.5  # of a frame in which spots that were shining are suddenly not where they were expected
OCCLUDED_MANOEUVRE = (
    0.05  # least chance of a manoeuvre per frame that does not show the pose: what is hidden is often a bend
)


@compiled
def _either_motion(old: Hypotheses, h: int, P: Array, dynamics: Dynamics, dt: float, sudden: bool) -> Array:
    """The covariance (18, 18) of hypothesis h where the spots do not give the pose. They do not separate the two
    motions, so it is that of their mixture, which has one mean. P: of the steady motion; sudden: spots are missing.
    """
    _, _, _, P_jump, _ = predicted(
        old.R[h], old.t[h], old.m[h], old.P[h], dt, dynamics.jerk, dynamics.jump, dynamics.unsteady
    )
    return _mixed(P, P_jump, SUDDEN_MANOEUVRE if sudden else max(dynamics.p_manoeuvre, OCCLUDED_MANOEUVRE))


@compiled
def widest(views: Views, R: Array, t: Array, P: Array, assigned: Ints) -> float:
    """The largest sigma, px, with which a predicted pose (R, t) and its P (6 or more, square) place a labelled spot."""
    uv, J = np.empty(2), np.empty((2, 6))
    worst = 0.0
    for i in range(assigned.shape[0]):
        if assigned[i] >= 0:
            there, a, _, c = expected_at(views, i, R, t, P, uv, J)
            worst = max(worst, 0.5 * (a + c)) if there else np.inf
    return np.sqrt(worst)


@compiled
def wide_views(views: Views, R: Array, t: Array, P: Array, assigned: Ints) -> Bools:
    """(n,): labelled spots that a predicted pose (R, t) with its P (6 or more, square) places worse than CHECK_PX."""
    uv, J = np.empty(2), np.empty((2, 6))
    out = np.zeros(assigned.shape[0], np.bool_)
    for i in range(assigned.shape[0]):
        if assigned[i] >= 0:
            there, a, _, c = expected_at(views, i, R, t, P, uv, J)
            out[i] = not there or 0.5 * (a + c) > CHECK_PX * CHECK_PX
    return out


@compiled
def _misses(assigned: Ints, shown: Array) -> bool:
    """Whether a spot that should be seen is not."""
    misses = False
    for i in range(assigned.shape[0]):
        misses |= (assigned[i] == MISSED or assigned[i] >= BLENDED) and shown[i] > 0.5
    return misses


@compiled
def _misses_a_screen(assigned: Ints, shown: Array, group: Ints) -> bool:
    """Whether a screen has gone dark, as it seems: none of its spots was found, and one should be seen.

    After frames with one screen only the gates of its spots are narrow and those of the other's are not: then a bend
    looks like a dark screen, however many spots of the one are found.
    """
    for i in range(assigned.shape[0]):
        if assigned[i] != MISSED or shown[i] <= 0.5:
            continue
        none = True
        for j in range(assigned.shape[0]):
            none = none and (group[j] != group[i] or assigned[j] < 0)
        if none:
            return True
    return False


@compiled
def _mixed(P: Array, other: Array, p: float) -> Array:
    """(1 - p) P + p other, of matrices."""
    out = np.empty_like(P)
    for i in range(P.shape[0]):
        for j in range(P.shape[1]):
            out[i, j] = (1 - p) * P[i, j] + p * other[i, j]
    return out


@compiled
def add_child(
    children: Children,
    count: int,
    R: Array,
    t: Array,
    m: Array,
    P: Array,
    weight: float,
    shown: Array,
    assigned: Ints,
    manoeuvre: bool,
    parent: int,
) -> tuple[int, int]:
    """Add a child, in place of the worst where there is no room; how many there are then, and its place, -1: none."""
    place = count
    if count == MOST_CHILDREN:
        place = 0
        for k in range(count):
            if children.after.weight[k] < children.after.weight[place]:
                place = k
        if children.after.weight[place] >= weight:
            return count, -1
    else:
        count += 1
    _put_hypothesis(children.after, place, R, t, m, P, weight, shown)
    _put(children.assigned[place], assigned)
    children.manoeuvre[place], children.parent[place] = manoeuvre, parent
    return count, place


@compiled
def prune_and_merge(children: Children, count: int) -> tuple[Hypotheses, Ints, Array, Array]:
    """Weigh the children: those that stay, as hypotheses, best first.

    Also their places (h,) among the children, how likely the best one's choice for each view is (n,), and the spread
    (6, 6) of the other children's poses about the best's, to be added to its covariance.
    """
    w = children.after.weight[:count]
    n = children.assigned.shape[1]
    order = _best_first(w)
    best = order[0]
    share = np.empty(count)
    total = 0.0
    for k in range(count):
        share[k] = np.exp(w[k] - w[best])
        total += share[k]
    certain, spread = np.zeros(n), np.zeros((6, 6))
    for k in range(count):
        p = share[k] / total
        for i in range(n):
            if children.assigned[k, i] % BLENDED == children.assigned[best, i] % BLENDED:
                certain[i] += p
        if k != best and p > LEAST_SHARE:
            d = _apart(children.after.R[k], children.after.t[k], children.after.R[best], children.after.t[best])
            for i in range(6):
                for j in range(6):
                    spread[i, j] += p * d[i] * d[j]
    kept, weight = np.empty(MOST_KEPT, np.int64), np.empty(MOST_KEPT)
    h = 0
    for place in range(count):
        k = order[place]
        if w[k] < w[best] - PRUNE_NATS:
            break
        twin = -1
        for other in range(h):
            if _alike(children, k, kept[other]):
                twin = other
                break
        if twin >= 0:
            weight[twin] = np.log(np.exp(weight[twin]) + share[k] / total)
        elif h < MOST_KEPT:
            kept[h], weight[h] = k, w[k] - w[best] - np.log(total)
            h += 1
    heaviest = -np.inf
    for i in range(h):
        heaviest = max(heaviest, weight[i])
    a = children.after
    staying = _room_for(h, a.shown.shape[1])
    for i in range(h):
        k = kept[i]
        _put_hypothesis(staying, i, a.R[k], a.t[k], a.m[k], a.P[k], weight[i] - heaviest, a.shown[k])
    return staying, kept[:h], certain, spread


@compiled
def spread_of_all(children: Children, places: Ints) -> Array:
    """The spread (6, 6) of the kept children's poses about the best's, each as if it were as likely as the best.

    For a pose that no label is sure of: a covariance that covers all answers.
    """
    out = np.zeros((6, 6))
    a, best = children.after, places[0]
    for place in range(1, places.shape[0]):
        k = places[place]
        d = _apart(a.R[k], a.t[k], a.R[best], a.t[best])
        for i in range(6):
            for j in range(6):
                out[i, j] += d[i] * d[j]
    return out


@compiled
def _alike(children: Children, k: int, o: int) -> bool:
    """Whether two children chose the same points and have come to the same state."""
    for i in range(children.assigned.shape[1]):
        if children.assigned[k, i] != children.assigned[o, i]:
            return False
    a = children.after
    d = _apart(a.R[k], a.t[k], a.R[o], a.t[o])
    for i in range(6):
        if abs(d[i]) > SAME * np.sqrt(a.P[o, i, i]):
            return False
        if abs(a.m[k, i] - a.m[o, i]) > SAME * np.sqrt(a.P[o, 6 + i, 6 + i]):
            return False
    return True
