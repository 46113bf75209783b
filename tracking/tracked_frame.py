"""What the tracker says of one frame."""

from __future__ import annotations

from dataclasses import dataclass

from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from tracking.statuses import PoseStatus, SpotStatus


@dataclass(frozen=True, slots=True)
class Event:
    """Something that the report should tell: labels found, a tie, a re-acquisition, a spot dropped."""

    kind: str  # labelled | tie | relabelled (matching failed at a bend) | reacquired (after frames without) | dropped
    text: str
    view: int | None = None


@dataclass(frozen=True, slots=True)
class MotionEstimate:
    """How the vehicle moves at one instant."""

    velocity: Array  # (3,), m/s, of the body origin, in world
    rate: Array  # (3,), rad/s, about the body's axes
    covariance: Array  # (6, 6) of both, (m/s)^2 and (rad/s)^2


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """What the tracker says of one frame. n views, in the order of the SpotModel."""

    uv_px: Array  # (n, 2), nan where nothing is known
    cov_px2: Array  # (n, 2, 2)
    status: tuple[SpotStatus, ...]  # (n,)
    predicted_px: Array  # (n, 2): before this frame's picture was looked at; nan without a track
    gain: Array  # (n,): g3 of the match; nan without
    point: Ints  # (n,): row of the detection in its camera's list, or UNMATCHED
    pose_status: PoseStatus
    pose: Pose | None
    pose_covariance: Array | None  # (6, 6)
    spots_used: int
    rms_px: float
    events: tuple[Event, ...]
    label_probability: Array | None = None  # (n,) that the label is right; nan without a label. None: not reckoned
    used_in_pose: Bools | None = (
        None  # (n,): takes part in the pose; a blended detection keeps its label only. None: all
    )
    predicted_cov_px2: Array | None = None  # (n, 2, 2) of predicted_px, without the detection's own; None: not reckoned
    motion: MotionEstimate | None = None  # velocity and rate; None: unknown, or the tracker does not have them
    pose_systematic: Array | None = None  # (6, 6) the calibration's share of the covariance, the same in every frame
