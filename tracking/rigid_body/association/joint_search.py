"""Joint search for the assignment of a frame's detections to all spots, given a predicted pose; compiled.

A beam search over partial assignments. The spots are decided one after the other, the best predicted first. Each
accepted detection updates the pose, so that the gates of the remaining spots shrink: after two or three spots they are
about as wide as the noise. The score of an assignment is its log-likelihood (frame_detections.py). Source: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled, compiled_in_caller
from geometry.compiled_linalg import best_first, copy_into, copy_matrix_into, pose_plus
from tracking.rigid_body.association.frame_detections import (
    BLENDED,
    NOT_SEARCHED,
    Observation,
    is_blended,
    log_false_density,
    p_in_picture,
    predicted_pixel,
)
from tracking.rigid_body.models.information import inverse_2x2
from tracking.rigid_body.models.occlusion import MISSED

GATE_CHI2 = 25.0  # a detection with a larger squared Mahalanobis distance is not this spot (p = 4e-6)
# Linearising the projection over a step of s px makes an error of about s^2 / 1500 px (lenses of 1000 to 1500 px).
LINEARISATION_PX = 1500.0
MAX_BLEND_DISTANCE2_PX2 = 100.0  # squared distance beyond which no neighbour merges with a spot
MIN_P_IN_PICTURE = 1e-3  # a spot whose probability of being in the picture is smaller is not searched for
# Partial assignments that are this much less likely than the best are dropped. A wide prediction needs the second one:
# of two poses that explain the same points of a periodic pattern, one explains a point earlier (17 nats at 0.01 px).
BEAM_PRUNE_NATS, WIDE_PRUNE_NATS = 14.0, 30.0
# Partial assignments that are kept: NARROW_BEAM if every spot's prediction has a smaller sigma (root of the
# covariance's trace) than NARROW_PREDICTION_PX, WIDE_BEAM if smaller than WIDE_PREDICTION_PX, else WIDEST_BEAM.
NARROW_PREDICTION_PX, WIDE_PREDICTION_PX = 30.0, 120.0
NARROW_BEAM, WIDE_BEAM, WIDEST_BEAM = 12, 48, 128

LOG_2PI = np.log(2 * np.pi)


class _Beam(NamedTuple):
    """Room for b partial assignments, each with the pose that its detections lead to."""

    R: Array  # (b, 3, 3)
    t: Array  # (b, 3)
    P: Array  # (b, 6, 6)
    assigned: Ints  # (b, n)
    score: Array  # (b,) nats
    p_in: Array  # (b, n): probability that each spot is in the picture


class _Candidates(NamedTuple):
    """Room for b extensions of partial assignments by the decision on one view."""

    score: Array  # (b,)
    node: Ints  # (b,) the extended partial assignment
    choice: Ints  # (b,) the decision: a row, that plus BLENDED, MISSED or NOT_SEARCHED


class _Predictions(NamedTuple):
    """Of one view by b partial assignments: pixel, Jacobian and covariance (uu, uv, vv) as from `predicted_pixel`."""

    uv: Array  # (b, 2)
    J: Array  # (b, 2, 6)
    cov: Array  # (b, 3)
    p_in: Array  # (b,): probability that the spot is in the picture


@compiled
def associate(
    obs: Observation, R: Array, t: Array, P: Array, p_unoccluded: Array
) -> tuple[Ints, Array, Array, Array, Array, int]:
    """Assignments of a frame's detections to spots, best first, from a predicted pose (R, t) with its P (6, 6).

    p_unoccluded (n,): marginal probability that each spot is not occluded. Returns b assignments (b, n); their
    scores (b,), nats; their p_in (b, n) for `detection_log_likelihood`; the poses R (b, 3, 3) and t (b, 3) that they
    lead to; and b.
    """
    n = obs.view_table.camera.shape[0]
    width = _beam_width(obs, R, t, P)
    beam, next_beam = _empty_beam(width, n), _empty_beam(width, n)
    predictions = _Predictions(np.empty((width, 2)), np.empty((width, 2, 6)), np.empty((width, 3)), np.empty(width))
    candidates = _Candidates(np.empty(width), np.empty(width, np.int64), np.empty(width, np.int64))
    beam.score[0] = 0.0
    for i in range(n):
        beam.assigned[0, i], beam.p_in[0, i] = NOT_SEARCHED, 0.0
    _copy_pose(beam, 0, R, t, P)
    count = 1
    undecided = np.empty(n, dtype=np.bool_)
    for i in range(n):
        undecided[i] = obs.frame.has_image[obs.view_table.camera[i]]
    for _ in range(n):
        view = _next_view(obs, beam, count, undecided)
        if view < 0:
            break
        undecided[view] = False
        found = 0
        worst = -np.inf
        for node in range(count):
            found, worst = _extend(obs, beam, node, view, p_unoccluded[view], predictions, candidates, found, worst)
        count = _select(obs, beam, view, predictions, candidates, found, next_beam)
        beam, next_beam = next_beam, beam
    return beam.assigned[:count], beam.score[:count], beam.p_in[:count], beam.R[:count], beam.t[:count], count


@compiled_in_caller
def _beam_width(obs: Observation, R: Array, t: Array, P: Array) -> int:
    """Number of partial assignments to keep: the less certain the prediction, the more."""
    uv, J = np.empty(2), np.empty((2, 6))
    largest = 0.0
    for i in range(obs.view_table.camera.shape[0]):
        projected, a, _, c = predicted_pixel(obs.views, i, R, t, P, uv, J)
        if projected:
            largest = max(largest, a + c)
    if largest < NARROW_PREDICTION_PX**2:
        return NARROW_BEAM
    return WIDE_BEAM if largest < WIDE_PREDICTION_PX**2 else WIDEST_BEAM


@compiled
def _empty_beam(b: int, n: int) -> _Beam:
    return _Beam(
        np.empty((b, 3, 3)),
        np.empty((b, 3)),
        np.empty((b, 6, 6)),
        np.empty((b, n), np.int64),
        np.empty(b),
        np.empty((b, n)),
    )


@compiled
def _copy_pose(beam: _Beam, k: int, R: Array, t: Array, P: Array) -> None:
    copy_matrix_into(beam.R[k], R)
    copy_into(beam.t[k], t)
    copy_matrix_into(beam.P[k], P)


@compiled_in_caller
def _next_view(obs: Observation, beam: _Beam, count: int, undecided: Bools) -> int:
    """The undecided view (n,) that the best partial assignment predicts best; -1: none that one of them projects.

    Where the best one projects none, the next decides: a prediction that is far off may place the spots beside the
    screen. Views whose spots are probably outside the picture come last.
    """
    uv, J = np.empty(2), np.empty((2, 6))
    view, smallest = -1, np.inf
    for node in range(count):
        for i in range(undecided.shape[0]):
            if not undecided[i]:
                continue
            projected, a, b, c = predicted_pixel(obs.views, i, beam.R[node], beam.t[node], beam.P[node], uv, J)
            if not projected:
                continue
            a, b, c = (
                a + obs.calibration_cov[i, 0, 0],
                b + obs.calibration_cov[i, 0, 1],
                c + obs.calibration_cov[i, 1, 1],
            )
            size = a * c - b * b
            width, height = obs.view_table.size[i, 0], obs.view_table.size[i, 1]
            if p_in_picture(uv[0], uv[1], a, c, width, height) < MIN_P_IN_PICTURE:
                size += 1e12
            if size < smallest:
                view, smallest = i, size
        if view >= 0:
            break
    return view


@compiled_in_caller
def _extend(
    obs: Observation,
    beam: _Beam,
    node: int,
    view: int,
    p_unoccluded: float,
    predictions: _Predictions,
    candidates: _Candidates,
    count: int,
    worst: float,
) -> tuple[int, float]:
    """Add all decisions on one view that extend one partial assignment to the candidates; see `_insert`.

    Writes the prediction of the view into row `node` of `predictions`.
    """
    frame, calibration_cov = obs.frame, obs.calibration_cov
    uv, J = predictions.uv[node], predictions.J[node]
    score = beam.score[node]
    projected, a, b, c = predicted_pixel(obs.views, view, beam.R[node], beam.t[node], beam.P[node], uv, J)
    predictions.cov[node, 0], predictions.cov[node, 1], predictions.cov[node, 2] = a, b, c
    p_in = 0.0
    if projected:
        curvature = ((a + c) / LINEARISATION_PX) ** 2 if a + c > 1.0 else 0.0
        a, b, c = (
            a + calibration_cov[view, 0, 0] + curvature,
            b + calibration_cov[view, 0, 1],
            c + calibration_cov[view, 1, 1] + curvature,
        )
        p_in = p_in_picture(uv[0], uv[1], a, c, obs.view_table.size[view, 0], obs.view_table.size[view, 1])
    predictions.p_in[node] = p_in
    if p_in < MIN_P_IN_PICTURE:
        return _insert(candidates, count, worst, score, node, NOT_SEARCHED)
    p_detect = obs.detection_model.p_detect * p_unoccluded * p_in
    count, worst = _insert(candidates, count, worst, score + np.log(1.0 - p_detect), node, MISSED)
    log_p_detect = np.log(p_detect)
    camera = obs.view_table.camera[view]
    for d in range(frame.first[camera], frame.first[camera + 1]):
        y0, y1 = frame.uv[d, 0] - uv[0], frame.uv[d, 1] - uv[1]
        distance2 = y0 * y0 + y1 * y1
        # A coarse gate that costs less than the exact one.
        if distance2 > GATE_CHI2 * (a + c + frame.cov[d, 0, 0] + frame.cov[d, 1, 1]) + MAX_BLEND_DISTANCE2_PX2:
            continue
        if is_taken(beam.assigned[node], d):
            continue
        gain = log_p_detect - log_false_density(frame, view, d)
        sa, sb, sc, det = inverse_2x2(a + frame.cov[d, 0, 0], b + frame.cov[d, 0, 1], c + frame.cov[d, 1, 1])
        chi2 = y0 * (sa * y0 + sb * y1) + y1 * (sb * y0 + sc * y1)
        if chi2 < GATE_CHI2:
            likelihood = score + gain - 0.5 * chi2 - 0.5 * np.log(det) - LOG_2PI
            count, worst = _insert(candidates, count, worst, likelihood, node, d)
        else:
            r = frame.blend_px[d] if is_blended(frame, view, d) else 0.0
            if r > 0.0 and distance2 < (r + 2 * np.sqrt(max(a, c))) ** 2 and a + c < r * r:
                log_blend = np.log(obs.detection_model.p_blend / (np.pi * r * r))
                count, worst = _insert(candidates, count, worst, score + gain + log_blend, node, d + BLENDED)
    return count, worst


@compiled
def is_taken(assigned: Ints, d: int) -> bool:
    """Whether an assignment (n,) already uses a detection."""
    taken = False
    for j in range(assigned.shape[0]):
        if assigned[j] == d or assigned[j] == d + BLENDED:
            taken = True
    return taken


@compiled
def _insert(
    candidates: _Candidates, count: int, worst: float, score: float, node: int, choice: int
) -> tuple[int, float]:
    """Add a candidate; where there is no room it replaces the worst, unless it is worse itself.

    Returns the number of candidates and, once there is no more room, the lowest score among them.
    """
    room = candidates.score.shape[0]
    if count < room:
        place = count
        count += 1
    elif score <= worst:
        return count, worst
    else:
        place = 0
        for k in range(room):
            if candidates.score[k] < candidates.score[place]:
                place = k
    candidates.score[place], candidates.node[place], candidates.choice[place] = score, node, choice
    if count == room:
        worst = candidates.score[0]
        for k in range(room):
            worst = min(worst, candidates.score[k])
    return count, worst


@compiled_in_caller
def _select(
    obs: Observation,
    beam: _Beam,
    view: int,
    predictions: _Predictions,
    candidates: _Candidates,
    found: int,
    next_beam: _Beam,
) -> int:
    """Turn the best candidates into the next beam, best first, each with its pose updated; returns their number."""
    order = best_first(candidates.score[:found])
    prune_nats = BEAM_PRUNE_NATS if candidates.score.shape[0] == NARROW_BEAM else WIDE_PRUNE_NATS
    kept = 0
    for place in range(found):
        k = order[place]
        if candidates.score[k] < candidates.score[order[0]] - prune_nats:
            break
        node, choice = candidates.node[k], candidates.choice[k]
        copy_into(next_beam.assigned[kept], beam.assigned[node])
        copy_into(next_beam.p_in[kept], beam.p_in[node])
        next_beam.assigned[kept, view] = choice
        next_beam.p_in[kept, view] = predictions.p_in[node] if choice >= MISSED else 0.0
        _copy_pose(next_beam, kept, beam.R[node], beam.t[node], beam.P[node])
        if 0 <= choice < BLENDED:
            _update_pose(obs, view, choice, predictions, node, next_beam.R[kept], next_beam.t[kept], next_beam.P[kept])
        next_beam.score[kept] = candidates.score[k]
        kept += 1
    return kept


@compiled_in_caller
def _update_pose(
    obs: Observation, view: int, d: int, predictions: _Predictions, node: int, R: Array, t: Array, P: Array
) -> None:
    """Kalman update of a pose and its covariance by detection d of a view, in place.

    The pose is that of a partial assignment, `node`, which predicts the view as in that row of `predictions`.
    """
    frame, calibration_cov = obs.frame, obs.calibration_cov
    uv, J = predictions.uv[node], predictions.J[node]
    a, b, c = predictions.cov[node, 0], predictions.cov[node, 1], predictions.cov[node, 2]
    y0, y1 = frame.uv[d, 0] - uv[0], frame.uv[d, 1] - uv[1]
    step2 = max(a + c, y0 * y0 + y1 * y1)
    curvature = (step2 / LINEARISATION_PX) ** 2 if step2 > 1.0 else 0.0
    a, b, c = a + frame.cov[d, 0, 0] + curvature, b + frame.cov[d, 0, 1], c + frame.cov[d, 1, 1] + curvature
    a, b, c = a + calibration_cov[view, 0, 0], b + calibration_cov[view, 0, 1], c + calibration_cov[view, 1, 1]
    sa, sb, sc, _ = inverse_2x2(a, b, c)
    H = np.zeros((6, 2))  # P J^T
    for i in range(6):
        for j in range(6):
            H[i, 0] += P[i, j] * J[0, j]
            H[i, 1] += P[i, j] * J[1, j]
    z0, z1 = sa * y0 + sb * y1, sb * y0 + sc * y1
    step = np.empty(6)
    for i in range(6):
        step[i] = H[i, 0] * z0 + H[i, 1] * z1
        for j in range(6):
            P[i, j] -= H[i, 0] * (sa * H[j, 0] + sb * H[j, 1]) + H[i, 1] * (sb * H[j, 0] + sc * H[j, 1])
    R_new, t_new = pose_plus(R, t, step)
    copy_matrix_into(R, R_new)
    copy_into(t, t_new)


# Labels of the spots that a pose explains although the joint search did not reach them; compiled.
#
# The joint search linearises the projection. Where the prediction is far off, the linearised places of the last spots
# are too, and a spot beyond the edge of its screen is not searched for at all. The pose of the labelled spots shows
# where they are. Source: ours.

MAX_SIGMA_PX = 8.0  # of a spot's place at the pose; with a larger one the search has alternatives of its own


@compiled
def complete(obs: Observation, assigned: Ints, R: Array, t: Array, P: Array, p_unoccluded: Array) -> bool:
    """Label the spots of an assignment (n,), in place, that a pose (R, t) with its P explains; whether there are any.

    P (6 or more, square); p_unoccluded (n,): marginal probability that each spot is not occluded.
    """
    frame, found = obs.frame, False
    uv, J = np.empty(2), np.empty((2, 6))
    for i in range(assigned.shape[0]):
        camera = obs.view_table.camera[i]
        if assigned[i] >= 0 or not frame.has_image[camera]:
            continue
        projected, a, b, c = predicted_pixel(obs.views, i, R, t, P, uv, J)
        if not projected or 0.5 * (a + c) > MAX_SIGMA_PX * MAX_SIGMA_PX:
            continue
        cov, p = obs.calibration_cov[i], obs.detection_model.p_detect * p_unoccluded[i]
        a, b, c = a + cov[0, 0], b + cov[0, 1], c + cov[1, 1]
        best = np.log(1.0 - p)
        for d in range(frame.first[camera], frame.first[camera + 1]):
            y0, y1 = frame.uv[d, 0] - uv[0], frame.uv[d, 1] - uv[1]
            if y0 * y0 + y1 * y1 > GATE_CHI2 * (a + c + frame.cov[d, 0, 0] + frame.cov[d, 1, 1]):
                continue
            sa, sb, sc, det = inverse_2x2(a + frame.cov[d, 0, 0], b + frame.cov[d, 0, 1], c + frame.cov[d, 1, 1])
            chi2 = y0 * (sa * y0 + sb * y1) + y1 * (sb * y0 + sc * y1)
            gain = np.log(p) - log_false_density(frame, i, d) - 0.5 * chi2 - 0.5 * np.log(det) - LOG_2PI
            if chi2 < GATE_CHI2 and gain > best and not is_taken(assigned, d):
                best, assigned[i], found = gain, d, True
    return found


@compiled_in_caller
def explainable(obs: Observation, assigned: Ints) -> float:
    """Upper bound, nats, of what `complete` can add to the log-likelihood of an assignment (n,)."""
    frame, total = obs.frame, 0.0
    for c in range(frame.has_image.shape[0]):
        open_views = 0
        log_clutter = np.inf
        for i in range(assigned.shape[0]):
            if obs.view_table.camera[i] == c and assigned[i] < 0:
                open_views += 1
                log_clutter = min(log_clutter, frame.log_clutter[i])
        for d in range(frame.first[c], frame.first[c + 1]):
            if open_views > 0 and not is_taken(assigned, d):
                open_views -= 1
                det = frame.cov[d, 0, 0] * frame.cov[d, 1, 1] - frame.cov[d, 0, 1] ** 2
                p = obs.detection_model.p_detect
                least = log_clutter - frame.log_shape[d]
                total += max(-np.log(1.0 - p) - least - 0.5 * np.log(det) - LOG_2PI, 0.0)
    return total
