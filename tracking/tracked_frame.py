"""The results of a tracker for one frame."""

from __future__ import annotations

from dataclasses import dataclass

from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from tracking.statuses import PoseStatus, SpotStatus


@dataclass(frozen=True, slots=True)
class Event:
    """An event for the report."""

    # labelled | tie | relabelled (after a frame with a pose) | reacquired (after frames without one) | dropped
    kind: str
    text: str
    view: int | None = None


@dataclass(frozen=True, slots=True)
class MotionEstimate:
    """The vehicle's velocities at one instant."""

    velocity: Array  # (3,), m/s, of the body origin, in world
    rate: Array  # (3,), rad/s, about the body's axes
    covariance: Array  # (6, 6) of both, (m/s)^2 and (rad/s)^2


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """The results of a tracker for one frame. n views, in the order of the SpotModel."""

    uv_px: Array  # (n, 2), nan if unknown
    cov_px2: Array  # (n, 2, 2)
    status: tuple[SpotStatus, ...]  # (n,)
    predicted_px: Array  # (n, 2): the prediction from earlier frames alone; nan without a track
    gain: Array  # (n,): g3 of the match; nan without
    point: Ints  # (n,): row of the detection in its camera's list, or UNMATCHED
    pose_status: PoseStatus
    pose: Pose | None
    pose_covariance: Array | None  # (6, 6)
    spots_used: int
    rms_px: float
    events: tuple[Event, ...]
    label_probability: Array | None = None  # (n,) that the label is right; nan without a label. None: not computed
    used_in_pose: Bools | None = None  # (n,): used in the pose; a merged detection is labelled but not used. None: all
    predicted_cov_px2: Array | None = None  # (n, 2, 2) of predicted_px, without the detection's own; None: not computed
    motion: MotionEstimate | None = None  # velocity and rate; None: unknown, or the tracker does not estimate them
    pose_systematic: Array | None = None  # (6, 6) the calibration's share of the covariance, the same in every frame
    # (n, 2) px: by how much uv_px and predicted_px, which are at the instants of the pictures, differ from those at the
    # instant of the pose. None: the instants are the same
    shift_px: Array | None = None

    @property
    def uv_at_pose_px(self) -> Array:
        """(n, 2): uv_px as they would be at the instant of the pose."""
        return self.uv_px if self.shift_px is None else self.uv_px - self.shift_px
