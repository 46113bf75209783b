"""The best hypothesis of a frame in numbers, and the tracker's answer from it as a TrackedFrame.

The numbers come from one compiled call, since a dozen small ones would cost more.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled, compiled_in_caller
from geometry.compiled_linalg import block, cholesky, hstack, multiply, pose_plus, solve
from geometry.compiled_projection import Views, project_view
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from tracking.detections import UNMATCHED
from tracking.rigid_body.association.frame_detections import (
    BLENDED,
    CLUTTER_RADIUS_PX,
    FrameDetections,
    Observation,
    predicted_pixel,
)
from tracking.rigid_body.hypotheses.hypothesis_set import Hypotheses
from tracking.rigid_body.models.information import frame_information, single_frame_pose
from tracking.rigid_body.models.motion import predicted
from tracking.statuses import (
    LOST_SIGMA_M,
    LOST_SIGMA_RAD,
    Event,
    MotionEstimate,
    PoseStatus,
    SpotStatus,
    TrackedFrame,
    view_statuses,
)

# Pivot of a scaled normal matrix below which the pose is not observable; exact degeneracies give 1e-16.
RANK_TOLERANCE = 1e-12


class FrameSummary(NamedTuple):
    """Numbers of one frame with n views and c cameras."""

    labelled: Bools  # (n,) the label is probable enough to be given
    use: Bools  # (n,) the label is given and its detection takes part in the pose
    uv: Array  # (n, 2) px, of the labelled detections; nan without a label
    cov: Array  # (n, 2, 2) px^2
    chi2: float  # of the pose of this frame by itself
    rms_px: float  # of the same, per axis
    single_frame_cov: Array  # (6, 6) covariance of the same; inf where it is not observable
    expected_px: Array  # (n, 2) pixels of all spots at the hypothesis' pose; nan without a projection
    jacobian: Array  # (n, 2, 6)
    inside: Bools  # (n,) the expected pixel lies in the picture
    false_points: Array  # (c,) number of false points within CLUTTER_RADIUS_PX of the expected spots
    discs: Array  # (c,) number of these spots


@compiled
def summarise(
    obs: Observation, R: Array, t: Array, assigned: Ints, probability: Array, min_probability: float
) -> FrameSummary:
    """Summary of a hypothesis: its pose (R, t), its assignment (n,), and the probabilities of the labels (n,).

    Labels less probable than `min_probability` are not given.
    """
    frame, views = obs.frame, obs.views
    n, cameras = assigned.shape[0], frame.has_image.shape[0]
    labelled, use = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    uv, cov = np.empty((n, 2)), np.empty((n, 2, 2))
    for i in range(n):
        labelled[i] = assigned[i] >= 0 and probability[i] >= min_probability
        use[i] = labelled[i] and assigned[i] < BLENDED
        d = assigned[i] % BLENDED
        for a in range(2):
            uv[i, a] = frame.uv[d, a] if labelled[i] else np.nan
            for b in range(2):
                cov[i, a, b] = frame.cov[d, a, b] + obs.shift_cov[i, a, b] if labelled[i] else np.nan
    R1, t1, L, chi2, count = single_frame_pose(views, R, t, use, uv, cov)
    single_frame_cov = inverse(L) if count >= 3 else _infinite(6)
    expected, J, inside = np.empty((n, 2)), np.empty((n, 2, 6)), np.zeros(n, np.bool_)
    false_points, discs = np.zeros(cameras), np.zeros(cameras)
    square, at, J1 = 0.0, np.empty(2), np.empty((2, 6))
    for i in range(n):
        if use[i] and project_view(views, i, R1, t1, at, J1):
            square += (uv[i, 0] - at[0]) ** 2 + (uv[i, 1] - at[1]) ** 2
        if not project_view(views, i, R, t, expected[i], J[i]):
            continue
        u, v = expected[i, 0], expected[i, 1]
        inside[i] = -0.5 <= u < obs.view_table.size[i, 0] - 0.5 and -0.5 <= v < obs.view_table.size[i, 1] - 0.5
        c = obs.view_table.camera[i]
        if not inside[i] or not frame.has_image[c]:
            continue
        discs[c] += 1
        false_points[c] += _false_points_near(obs, c, u, v, assigned)
    rms = np.sqrt(square / (2 * count)) if count > 0 else np.nan
    return FrameSummary(labelled, use, uv, cov, chi2, rms, single_frame_cov, expected, J, inside, false_points, discs)


@compiled_in_caller
def _false_points_near(obs: Observation, camera: int, u: float, v: float, assigned: Ints) -> int:
    """Number of a camera's unlabelled detections within CLUTTER_RADIUS_PX of a pixel (u, v)."""
    frame = obs.frame
    out = 0
    for d in range(frame.first[camera], frame.first[camera + 1]):
        if (frame.uv[d, 0] - u) ** 2 + (frame.uv[d, 1] - v) ** 2 < CLUTTER_RADIUS_PX * CLUTTER_RADIUS_PX:
            taken = False
            for j in range(assigned.shape[0]):
                taken |= assigned[j] >= 0 and assigned[j] % BLENDED == d
            if not taken:
                out += 1
    return out


@compiled
def _infinite(n: int) -> Array:
    """The covariance (n, n) of a quantity that is not observable."""
    out = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            out[i, j] = np.inf
    return out


@compiled
def inverse(L: Array) -> Array:
    """Covariance (n, n) of a normal matrix; inf if it lacks rank."""
    n = L.shape[0]
    scaled, eye = np.empty((n, n)), np.zeros((n, n))
    for i in range(n):
        if not L[i, i] > 0.0:
            return _infinite(n)
        for j in range(n):
            scaled[i, j] = L[i, j] / np.sqrt(L[i, i] * L[j, j])
        eye[i, i] = 1.0
    # The pivots of the Cholesky factorisation show the rank.
    root = cholesky(scaled)
    for j in range(n):
        if not root[j, j] * root[j, j] > RANK_TOLERANCE:
            return _infinite(n)
    out, _ = solve(scaled, eye)
    for i in range(n):
        for j in range(n):
            out[i, j] /= np.sqrt(L[i, i] * L[j, j])
    return out


@compiled
def innovation_score(
    views: Views, before: Hypotheses, h: int, dt: float, jerk: Array, use: Bools, uv: Array, cov: Array
) -> tuple[Array, Array]:
    """Innovation score (6,) of the steady motion's jerk, and the predicted covariance (n, 2, 2) of each spot, px^2.

    The score is the derivative of the innovation's log-likelihood by the log variance of each axis of the predicted
    pose, over (1 + the part of the innovation's information that this variance makes). With w = S^-1 y and P the
    predicted covariance: (w_i P_ii w_i - (S^-1)_ii P_ii) / (1 + (S^-1)_ii P_ii) / 2. Its mean is 0 where the jerk is
    right. h: index among the hypotheses of the frame before; jerk (6,). The second result leaves the noise of the
    detections out.
    """
    none = np.zeros(2)
    R, t, _, P, _ = predicted(before.R[h], before.t[h], before.m[h], before.P[h], dt, jerk, none, none)
    L, g, _, _, _ = frame_information(views, R, t, use, uv, cov)
    pose = block(P, 6)
    A = multiply(L, pose)
    for i in range(6):
        A[i, i] += 1.0
    x, _ = solve(A, hstack(L, g))
    out = np.empty(6)
    for i in range(6):
        expected = x[i, i] * pose[i, i]
        out[i] = 0.5 * (x[i, 6] * pose[i, i] * x[i, 6] - expected) / (1.0 + expected)
    n = use.shape[0]
    spread, at, J = np.empty((n, 2, 2)), np.empty(2), np.empty((2, 6))
    for i in range(n):
        projected, a, b, c = predicted_pixel(views, i, R, t, pose, at, J)
        if not projected:
            a = b = c = np.nan
        spread[i, 0, 0], spread[i, 0, 1], spread[i, 1, 0], spread[i, 1, 1] = a, b, b, c
    return out, spread


@compiled
def predicted_pixels(views: Views, h: Hypotheses, dt: float) -> Array:
    """Pixels (n, 2) that the first hypothesis predicts for a time dt (s) later."""
    step = np.empty(6)
    for i in range(6):
        step[i] = dt * h.m[0, i] + 0.5 * dt * dt * h.m[0, 6 + i]
    R, t = pose_plus(h.R[0], h.t[0], step)
    n = views.shape[0]
    uv, J = np.empty((n, 2)), np.empty((2, 6))
    for i in range(n):
        project_view(views, i, R, t, uv[i], J)
    return uv


NOWHERE = (SpotStatus.LOST, SpotStatus.OFF_SCREEN)  # statuses of spots without a position


def is_lost(covariance: Array) -> bool:
    """Whether a pose with this covariance (6 or more, square) is as good as unknown."""
    d = covariance.diagonal()
    return bool(max(d[:3]) >= LOST_SIGMA_M**2 or max(d[3:6]) >= LOST_SIGMA_RAD**2)


@dataclass(frozen=True, slots=True)
class FrameDecision:
    """What has been decided about a frame's best hypothesis, n views."""

    assigned: Ints  # (n,)
    probability: Array  # (n,) of each label
    labelled: Bools  # (n,) labels that are given
    known: bool  # there is a pose
    measured: bool  # ... that this frame's spots determine
    manoeuvre: bool  # the velocities have jumped in the step before
    covariance: Array  # (6, 6) of the pose
    systematic: Array  # (6, 6) the calibration's share of it
    calibration_cov: Array  # (n, 2, 2) px^2, of the expected pixels
    blend_px: float  # how far a neighbour may shift a blended detection


def tracked_frame(
    model: SpotModel,
    frame: FrameDetections,
    summary: FrameSummary,
    hypotheses: Hypotheses,
    decision: FrameDecision,
    predicted: tuple[Array, Array | None],
    events: list[Event],
) -> TrackedFrame:
    """A frame's answer from its best hypothesis; predicted: pixels (n, 2) and covariances (n, 2, 2) or None."""
    h, d, s = hypotheses, decision, summary
    uv_px = np.where(d.labelled[:, None], s.uv, s.expected_px)
    expected_cov = s.jacobian @ d.covariance @ s.jacobian.transpose(0, 2, 1) + d.calibration_cov
    cov_px2 = np.where(d.labelled[:, None, None], s.cov, expected_cov)
    blended = d.labelled & (d.assigned >= BLENDED)
    if blended.any():
        cov_px2[blended] += (d.blend_px / 2) ** 2 * np.eye(2)  # the shift by the neighbour is unknown
    turned = d.labelled & d.manoeuvre
    exists = ~np.isnan(s.expected_px[:, 0])
    status = view_statuses(d.labelled, turned, exists, s.inside, frame.has_image[model.camera_of], d.known)
    nowhere = [word in NOWHERE for word in status]
    uv_px[nowhere], cov_px2[nowhere] = np.nan, np.nan
    pose_status = PoseStatus.MEASURED if d.measured else PoseStatus.PREDICTED if d.known else PoseStatus.LOST
    return TrackedFrame(
        uv_px=uv_px,
        cov_px2=cov_px2,
        status=status,
        predicted_px=predicted[0],
        gain=np.full(len(model), np.nan),
        point=np.where(d.labelled, d.assigned % BLENDED - frame.first[model.camera_of], UNMATCHED),
        pose_status=pose_status,
        pose=Pose(h.R[0], h.t[0]) if d.known else None,
        pose_covariance=d.covariance if d.known else None,
        spots_used=int(np.count_nonzero(s.use)) if d.measured else 0,
        rms_px=float(s.rms_px) if d.measured else float("nan"),
        events=tuple(events),
        label_probability=np.where(d.assigned >= 0, d.probability, np.nan),
        used_in_pose=s.use & d.labelled,
        predicted_cov_px2=predicted[1],
        motion=MotionEstimate(h.m[0, :3], h.m[0, 3:6], h.P[0, 6:12, 6:12]) if d.known else None,
        pose_systematic=d.systematic if d.known else None,
    )


def lost_frame(n: int, predicted_px: Array, events: list[Event]) -> TrackedFrame:
    """The answer for a frame without a hypothesis: nothing is known of its n views."""
    return TrackedFrame(
        uv_px=np.full((n, 2), np.nan),
        cov_px2=np.full((n, 2, 2), np.nan),
        status=(SpotStatus.LOST,) * n,
        predicted_px=predicted_px,
        gain=np.full(n, np.nan),
        point=np.full(n, UNMATCHED),
        pose_status=PoseStatus.LOST,
        pose=None,
        pose_covariance=None,
        spots_used=0,
        rms_px=float("nan"),
        events=tuple(events),
        label_probability=np.full(n, np.nan),
    )


def undecided_events(assigned: Ints, probability: Array, labelled: Bools, enough: Bools) -> list[Event]:
    """Events for the labels (n,) that are left open; enough (n,): their probability (n,) would have been enough."""
    out = []
    for v in np.flatnonzero((assigned >= 0) & ~labelled):
        if enough[v]:
            text = "label left open: one or two points of light after a frame without any may be false"
        else:
            text = f"label left open: its probability is {probability[v]:.2f}"
        out.append(Event("undecided", text, int(v)))
    return out
