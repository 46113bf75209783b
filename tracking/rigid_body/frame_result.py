"""The tracker's answer for one frame: spots, pose and covariances as a TrackedFrame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from tracking.detections import UNMATCHED
from tracking.rigid_body.association.frame_detections import BLENDED, FrameDetections
from tracking.rigid_body.frame_summary import FrameSummary
from tracking.rigid_body.hypotheses.hypothesis_set import Hypotheses
from tracking.statuses import LOST_SIGMA_M, LOST_SIGMA_RAD, PoseStatus, SpotStatus, view_statuses
from tracking.tracked_frame import Event, MotionEstimate, TrackedFrame

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
