"""Reassociation: labels of each frame from the motion that all other frames give, and the density of false points.

The pose of a frame without its own spots is the smoothed one with their information removed. The frame's detections are
assigned from there. Where that leaves something open, further explanations compete: a velocity jump at the frame, and a
wrong motion. Compiled. Source: ours.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled, compiled_in_caller
from geometry.compiled_linalg import apply, block, column, hstack, multiply, pose_plus, solve, symmetrise
from geometry.compiled_projection import Views, inside, project_all, project_view
from geometry.forward_model import SpotModel
from tracking.rigid_body.association.frame_detections import (
    BLENDED,
    CLUTTER_RADIUS_PX,
    DetectionModel,
    FrameDetections,
    Observation,
    ViewTable,
    chosen_points,
    detection_log_likelihood,
    in_picture,
    predicted_pixel,
)
from tracking.rigid_body.association.joint_search import associate
from tracking.rigid_body.hypotheses.hypothesis_set import State, iterated_update
from tracking.rigid_body.models.information import frame_information, single_frame_pose
from tracking.rigid_body.models.motion import STATE
from tracking.rigid_body.models.occlusion import marginal
from tracking.rigid_body.online_estimates import PicturePoints, no_places, static_log_density, update_places
from tracking.smoothing.motion.run_detections import Reference, RunDetections, labelled_points


@compiled
def clutter_density(
    views: Views, view_table: ViewTable, detections: RunDetections, assigned: Ints, ref: Reference, known: Bools
) -> Array:
    """False points per px^2 (cameras,) within CLUTTER_RADIUS_PX of the expected spots, over the known (T,) frames."""
    cameras = detections.has_image.shape[1]
    count, discs = np.zeros(cameras), np.zeros(cameras)
    uv, J = np.empty(2), np.empty((2, 6))
    radius2 = CLUTTER_RADIUS_PX * CLUTTER_RADIUS_PX
    for k in range(assigned.shape[0]):
        if not known[k]:
            continue
        for i in range(assigned.shape[1]):
            c = view_table.camera[i]
            if not detections.has_image[k, c] or not project_view(views, i, ref.R[k], ref.t[k], uv, J):
                continue
            if not inside(uv, view_table.size[i]):
                continue
            discs[c] += 1
            for d in range(detections.first[k, c], detections.first[k, c + 1]):
                row = detections.begin[k] + d
                a, b = detections.uv[row, 0] - uv[0], detections.uv[row, 1] - uv[1]
                taken = False
                for j in range(assigned.shape[1]):
                    taken |= assigned[k, j] == d or assigned[k, j] == d + BLENDED
                if not taken and a * a + b * b < radius2:
                    count[c] += 1
    for c in range(cameras):
        count[c] /= max(discs[c], 1.0) * np.pi * CLUTTER_RADIUS_PX**2
    return count


def run_log_clutter(
    model: SpotModel, view_table: ViewTable, detections: RunDetections, assigned: Ints, ref: Reference,
    known: Bools, min_per_px2: float,
) -> Array:  # fmt: skip
    """Log density (T, n) of false points, 1/px^2, by frame and view.

    The density near spots over the run, that of the frame's whole picture if it is higher, and at least min_per_px2.
    """
    near = clutter_density(model.numbers, view_table, detections, assigned, ref, known)
    area = np.array([np.prod(model.image_size_px[model.camera_of == c][:1]) for c in range(len(near))])
    density = np.maximum(np.maximum(near, np.diff(detections.first, axis=1) / area), min_per_px2)
    return np.ascontiguousarray(np.log(density)[:, model.camera_of])


def run_log_static(
    views: Views, camera_of: Ints, detections: RunDetections, noise_px2: Array, assigned: Ints, ref: Reference,
    known: Bools,
) -> Array:  # fmt: skip
    """Log density (m,) of static points, 1/px^2, at each detection, from the known (T,) frames of the whole run.

    camera_of (n,): of the views; noise_px2 (m,): as in PicturePoints. The tracker has to see a static point several
    times; here its first frames profit from the later ones.
    """
    places = no_places(detections.has_image.shape[1])
    expected, _ = project_all(views, ref.R, ref.t)
    rows = [slice(int(a), int(b)) for a, b in pairwise(detections.begin)]
    points = [
        PicturePoints(detections.uv[r], noise_px2[r], first, there)
        for r, first, there in zip(rows, detections.first, detections.has_image, strict=True)
    ]
    for k in np.flatnonzero(known):
        labels = np.where(assigned[k] >= 0, assigned[k] % BLENDED, -1)
        update_places(places, points[k], labels, expected[k], camera_of, 1.0)
    return np.concatenate([np.zeros(0), *(static_log_density(places, p.uv, p.noise_px2, p.first) for p in points)])


# Probability that a spot is not occluded if its screen is visible, by the neighbouring frames in which the screen was
# visible: the spot was labelled in none of them, in one of two, in all.
P_VISIBLE = np.array([0.2, 0.6, 0.98])
# Probability that a screen is visible, by the number of neighbouring frames that show spots of it.
P_SCREEN_VISIBLE = np.array([0.01, 0.3, 0.995])
RIVAL_NATS = 9.0  # assignments that are this much less likely than the best do not count in its probability
MAX_PREDICTION_SIGMA_PX = 60.0  # a frame whose spots the others predict worse keeps its labels
P_JUMP = 0.02  # probability of a velocity jump at a frame although none has been detected
P_WRONG_MOTION = 1e-4  # probability that the other frames are wrong about this one; then its pose is within
WRONG_MOTION_M, WRONG_MOTION_RAD = 0.3, 0.3  # (1 sigma) of their prediction
MIN_SPOTS_AGAINST_MOTION = 5  # labelled spots whose own pose may contradict the other frames
KEEP_NATS = 3.0  # in favour of the current labels of a frame with fewer spots
# Excess of the chi-square over its expectation, in its standard deviations, below which the first explanation suffices.
EXPECTED_SIGMAS = 3.5
MAX_TRIED = 300  # assignments of one frame


class RunObservation(NamedTuple):
    """All detections of a run together with what their likelihood depends on besides the motion; n views."""

    views: Views  # (n,)
    view_table: ViewTable
    detection_model: DetectionModel
    calibration_cov: Array  # (n, 2, 2) px^2: covariance of the expected pixels due to calibration errors
    detections: RunDetections
    log_static: Array  # (m,) log density of static points at each detection, 1/px^2


class _Case(NamedTuple):
    """One frame: its prediction without its own spots, and its current labels."""

    obs: Observation
    R: Array  # (3, 3)
    t: Array  # (3,)
    p_visible: Array  # (n + groups,) as in occlusion.py
    p_unoccluded: Array  # (n,)
    current: Ints  # (n,) the assignment that it has
    labels: int  # number of current labels that are used in the pose


class _Tried(NamedTuple):
    """Room for MAX_TRIED assignments of one frame."""

    assigned: Ints  # (c, n)
    score: Array  # (c,) log-likelihoods, nats


@compiled
def reassociated(
    run: RunObservation,
    assigned: Ints,
    ref: Reference,
    pose_P: Array,
    weight: Array,
    log_clutter: Array,
    jump_sigma: Array,
) -> tuple[Ints, Array, Array]:
    """Assignments (T, n), their probabilities (T, n), and how well the other frames predict the spots of each (T,).

    assigned (T, n): the current labels, which ref and pose_P (T, 6, 6), the smoothed motion, are based on: those
    of each frame with a weight (T,), 0 where they are not used. log_clutter (T, n), 1/px^2. jump_sigma (T, 6): sigmas
    of the pose, m and rad, that a velocity jump at the frame would add. The third result is the largest sigma of a
    spot, px. A frame that the others predict too badly keeps its labels.
    """
    frames, n = assigned.shape
    detections = run.detections
    out, probability = assigned.copy(), np.ones((frames, n))
    sigma_px = np.zeros(frames)
    groups = 0
    for i in range(n):
        groups = max(groups, run.view_table.group[i] + 1)
    no_excess, no_shift, no_clocks = np.zeros(n), np.zeros((n, 2, 2)), np.zeros((detections.has_image.shape[1], 3))
    for k in range(frames):
        P, R, t, sigma_px[k] = _prediction_without(run, assigned, ref, pose_P, weight[k], k)
        if not sigma_px[k] < MAX_PREDICTION_SIGMA_PX:
            continue
        a, b = detections.begin[k], detections.begin[k + 1]
        frame = FrameDetections(
            detections.uv[a:b], detections.cov[a:b], detections.blend_px[a:b], detections.first[k],
            detections.has_image[k], log_clutter[k], run.log_static[a:b], detections.size_px[a:b],
            detections.usual_size_px, no_excess, np.zeros(b - a),
        )  # fmt: skip
        obs = Observation(
            run.views, run.view_table, run.detection_model, run.calibration_cov, frame, no_shift, no_clocks, False
        )
        p_visible = _visibility_from_neighbours(assigned, run.view_table.group, groups, k)
        current = np.empty(n, np.int64)
        labels = 0
        for i in range(n):
            current[i] = max(assigned[k, i], -1)
            labels += 1 if 0 <= current[i] < BLENDED else 0
        case = _Case(obs, R, t, p_visible, marginal(p_visible, run.view_table.group), current, labels)
        tried = _explanations(case, P, jump_sigma[k])
        _choose(tried, out[k], probability[k])
    return out, probability, sigma_px


@compiled_in_caller
def _choose(tried: _Tried, out: Ints, probability: Array) -> None:
    """Write the likeliest assignment into out (n,) and the probability of each of its choices into probability (n,)."""
    n = out.shape[0]
    best = 0
    for j in range(tried.score.shape[0]):
        if tried.score[j] > tried.score[best]:
            best = j
    total = 0.0
    share = np.zeros(n)
    for j in range(tried.score.shape[0]):
        if tried.score[j] > tried.score[best] - RIVAL_NATS:
            p = np.exp(tried.score[j] - tried.score[best])
            total += p
            for i in range(n):
                if _same_point(tried.assigned[j, i], tried.assigned[best, i]):
                    share[i] += p
    for i in range(n):
        out[i] = tried.assigned[best, i] if tried.assigned[best, i] >= 0 else -1
        probability[i] = share[i] / total


@compiled
def _same_point(a: int, b: int) -> bool:
    """Whether two choices for a view are the same detection, or both none."""
    return (a < 0 and b < 0) or (a >= 0 and b >= 0 and a % BLENDED == b % BLENDED)


@compiled_in_caller
def _prediction_without(
    run: RunObservation, assigned: Ints, ref: Reference, pose_P: Array, weight: float, k: int
) -> tuple[Array, Array, Array, float]:
    """Prediction of frame k from all others: covariance (6, 6), R, t; and the largest sigma of a spot, px."""
    use, uv, cov = labelled_points(run.detections, k, assigned[k], run.calibration_cov)
    L, g, _, _, _ = frame_information(run.views, ref.R[k], ref.t[k], use, uv, cov)
    P = pose_P[k]
    A, step = multiply(P, L), apply(P, g)
    for i in range(6):
        step[i] = -weight * step[i]
        for j in range(6):
            A[i, j] = -weight * A[i, j]
        A[i, i] += 1.0
    x, _ = solve(A, hstack(P, step))
    P_without = block(x, 6)
    symmetrise(P_without)
    unknown = False
    for i in range(6):
        unknown |= not 0.0 < P_without[i, i] < 1.0
    if unknown:
        return P_without, ref.R[k], ref.t[k], np.inf
    R, t = pose_plus(ref.R[k], ref.t[k], column(x, 6))
    at, J = np.empty(2), np.empty((2, 6))
    largest = 0.0
    for i in range(assigned.shape[1]):
        if not run.detections.has_image[k, run.view_table.camera[i]]:
            continue
        projected, a, _, c = predicted_pixel(run.views, i, R, t, P_without, at, J)
        labelled = weight > 0.0 and assigned[k, i] >= 0
        if labelled and not projected:
            return P_without, R, t, np.inf  # the others contribute so little that their share cannot be separated
        if projected and (labelled or inside(at, run.view_table.size[i])):
            largest = max(largest, 0.5 * (a + c))
    return P_without, R, t, np.sqrt(largest)


@compiled_in_caller
def _explanations(case: _Case, P: Array, jump_sigma: Array) -> _Tried:
    """Assignments of one frame with their log-likelihoods, under up to three explanations.

    The prediction from the other frames, with covariance P (6, 6); the same with a velocity jump at the frame, which
    adds jump_sigma (6,); and a wrong motion. The current labels compete under each, even if they lie outside the gates.
    """
    n = case.current.shape[0]
    tried, frame = _Tried(np.empty((MAX_TRIED, n), np.int64), np.empty(MAX_TRIED)), case.obs.frame
    count, expected = 0, False
    for explanation in range(2 if case.labels < MIN_SPOTS_AGAINST_MOTION else 3):
        R, t, sigma, log_prior = case.R, case.t, np.zeros(6), np.log(1.0 - P_JUMP)
        if explanation == 1:
            sigma, log_prior = jump_sigma, np.log(P_JUMP)
        elif explanation == 2:
            for i in range(6):
                sigma[i] = WRONG_MOTION_M if i < 3 else WRONG_MOTION_RAD
            log_prior = np.log(P_WRONG_MOTION)
            use, uv, cov = chosen_points(frame.uv, frame.cov, 0, case.current, case.obs.calibration_cov)
            R, t, _, _, _ = single_frame_pose(case.obs.views, case.R, case.t, use, uv, cov)
        prior = _widened(case, P, sigma)
        if explanation < 2:
            count, expected = _try_assignments(case, prior, log_prior, tried, count)
        if explanation == 0 and expected:
            break
        if case.labels > 0:
            count = _try_current(case, prior, log_prior, R, t, tried, count)
    return _Tried(tried.assigned[:count], tried.score[:count])


@compiled
def _widened(case: _Case, P: Array, sigma: Array) -> State:
    """The prediction with the covariance P (6, 6) plus independent errors of these sigmas (6,), as a state at rest."""
    whole = np.zeros((STATE, STATE))
    for i in range(6):
        for j in range(6):
            whole[i, j] = P[i, j]
        whole[i, i] += sigma[i] * sigma[i]
    return State(case.R, case.t, np.zeros(12), whole)


@compiled
def _score(case: _Case, log_prior: float, log_likelihood: float, assigned: Ints, R: Array, t: Array) -> float:
    """Log-likelihood of an assignment (n,) with its Gaussian part, at a pose, nats."""
    p_in = in_picture(case.obs, assigned, R, t)
    return log_prior + log_likelihood + detection_log_likelihood(case.obs, case.p_visible, assigned, p_in)


@compiled
def _bonus(case: _Case) -> float:
    """Nats in favour of the current labels."""
    return KEEP_NATS if case.labels < MIN_SPOTS_AGAINST_MOTION else 0.0


@compiled_in_caller
def _try_assignments(case: _Case, prior: State, log_prior: float, tried: _Tried, count: int) -> tuple[int, bool]:
    """Add the assignments of a joint search from a prediction.

    Returns their number, and whether the likeliest one confirms the current labels with an expected misfit.
    """
    n = case.current.shape[0]
    found, rough, _, R, t, found_count = associate(case.obs, prior.R, prior.t, block(prior.P, 6), case.p_unoccluded)
    expected = False
    for j in range(found_count):
        if rough[j] < rough[0] - 2 * RIVAL_NATS or count == MAX_TRIED - 4:
            break
        result = iterated_update(case.obs, prior, found[j], R[j], t[j])
        same = True
        for i in range(n):
            tried.assigned[count, i] = found[j, i]
            same &= (found[j, i] < 0 and case.current[i] < 0) or found[j, i] == case.current[i]
        score = _score(case, log_prior, result.log_likelihood, found[j], result.state.R, result.state.t)
        tried.score[count] = score + (_bonus(case) if same else 0.0)
        if j == 0:
            limit = 2 * result.spots + EXPECTED_SIGMAS * np.sqrt(4.0 * max(result.spots, 1))
            expected = same and result.spots > 0 and result.chi2 <= limit
        count += 1
    return count, expected


@compiled_in_caller
def _try_current(case: _Case, prior: State, log_prior: float, R: Array, t: Array, tried: _Tried, count: int) -> int:
    """Add the current labels, with an update that starts at the pose (R, t); returns the number of assignments."""
    result = iterated_update(case.obs, prior, case.current, R, t)
    for i in range(case.current.shape[0]):
        tried.assigned[count, i] = case.current[i]
    score = _score(case, log_prior, result.log_likelihood, case.current, result.state.R, result.state.t)
    tried.score[count] = score + _bonus(case)
    return count + 1


@compiled_in_caller
def _visibility_from_neighbours(assigned: Ints, group: Ints, groups: int, k: int) -> Array:
    """Probabilities (n + groups,), as in occlusion.py, of frame k from the labels (T, n) of the frames next to it."""
    frames, n = assigned.shape
    out = np.empty(n + groups)
    neighbours, labelled = np.zeros(n), np.zeros(n)
    for g in range(groups):
        visible_neighbours = 0
        for other in (k - 1, k + 1):
            if not 0 <= other < frames:
                visible_neighbours += 1
                continue
            visible = False
            for i in range(n):
                visible |= group[i] == g and assigned[other, i] >= 0
            visible_neighbours += 1 if visible else 0
            for i in range(n):
                if visible and group[i] == g:
                    neighbours[i] += 1
                    labelled[i] += 1 if assigned[other, i] >= 0 else 0
        out[n + g] = P_SCREEN_VISIBLE[visible_neighbours]
    for i in range(n):
        out[i] = P_VISIBLE[2] if labelled[i] == neighbours[i] else P_VISIBLE[1 if labelled[i] > 0 else 0]
    return out
