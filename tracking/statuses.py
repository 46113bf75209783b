"""The statuses of spots, poses and targets with their meanings, and the results of a tracker for one frame.

Report and documentation read the meanings here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Self

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose

LOST_SIGMA_M, LOST_SIGMA_RAD = 1.0, np.deg2rad(60.0)  # a predicted pose with larger sigmas is `lost`


class Word(StrEnum):
    """A word of the tables with its meaning: a sentence for the user. Members are pairs of both."""

    meaning: str

    def __new__(cls, word: str, meaning: str) -> Self:
        """A member that equals its word."""
        member = str.__new__(cls, word)
        member._value_, member.meaning = word, meaning
        return member


class SpotStatus(Word):
    """The status of one spot in one picture."""

    MATCHED = "matched", "a detection of this image has this spot's label"
    TURNED = "turned", "a detection has this spot's label, and the trajectory bends: it is not where it was predicted"
    OCCLUDED = "occluded", "should be in view, but no detection is accepted: the position is estimated"
    OUT_OF_VIEW = "out_of_view", "outside the image: the position follows from the other spots"
    OFF_SCREEN = "off_screen", "the beam is known, but misses its screen or cannot be projected"
    NO_IMAGE = "no_image", "this camera has no usable image for this frame: the position is estimated"
    LOST = "lost", "nothing is known"

    def meaning_for(self, method: str) -> str:
        """One sentence for the user, as the tracker `method` (`rigid` or `spots`) assigns this status.

        Raises ValueError: for any other method.
        """
        if method not in _MEANINGS_BY_METHOD:
            raise ValueError(f"tracker method: expected one of {', '.join(_MEANINGS_BY_METHOD)}, got {method!r}")
        return _MEANINGS_BY_METHOD[method].get(self, self.meaning)

    @property
    def measured(self) -> bool:
        """Whether the position is that of a detection in this picture."""
        return self in (SpotStatus.MATCHED, SpotStatus.TURNED)


class PoseStatus(Word):
    """The status of the vehicle's pose in one frame."""

    MEASURED = "measured", "the pose is observable from this frame's matched spots"
    PREDICTED = "predicted", "not observable in this frame: predicted by the motion model, with a larger covariance"
    LOST = "lost", "nothing is known"


class Cause(Word):
    """Why a frame has no measured target of one camera (a circle, a drogue, a point); empty where it has one."""

    NONE = "", "the target is measured"
    NO_IMAGE = "no_image", "there is no usable picture"
    OCCLUDED = "occluded", "half of the target or more is hidden"
    NOT_FOUND = "not_found", "nothing in the picture is found that can be the target"
    NO_MATCH = "no_match", "nothing in the window looks like the target: it is hidden or moved away"
    UNCERTAIN = "uncertain", "the match has a low confidence"
    AMBIGUOUS = "ambiguous", "several targets fit equally well"
    OUT_OF_VIEW = "out_of_view", "the predicted centre is outside the picture"


# Huo, Yang & Yang 2015, section 4.1.2, for `spots`.
_MEANINGS_BY_METHOD = {
    "rigid": {
        SpotStatus.MATCHED: "a detection has this spot's label: the most likely one under the motion of the vehicle",
        SpotStatus.TURNED: "a detection has this spot's label, and the vehicle's velocity jumped since the last frame",
        SpotStatus.OCCLUDED: "should be in view, but no detection is accepted: the pose gives the position",
        SpotStatus.OUT_OF_VIEW: "outside the image: the pose gives the position",
        SpotStatus.NO_IMAGE: "this camera has no usable image for this frame: the pose gives the position",
    },
    "spots": {
        SpotStatus.MATCHED: "found in the search region around the prediction (matching step 1)",
        SpotStatus.TURNED: "found by the second search, around the last position: the trajectory bent (step 2)",
        SpotStatus.OCCLUDED: "should be in view, no detection accepted: the estimate is used (step 3)",
        SpotStatus.OUT_OF_VIEW: "outside the image: solved from the other beams",
    },
}


def view_statuses(
    seen: Bools, turned: Bools, exists: Bools, inside: Bools, has_image: Sequence[bool] | Bools, known: Bools | bool
) -> tuple[SpotStatus, ...]:
    """The status of every view from a pose; all arguments (n,), or one `known` for all.

    seen: a detection has the label; turned: at a bend; exists: the pose projects the spot; inside: into the image;
    has_image: its camera has a picture; known: there is a pose.
    """
    out, known = [], np.broadcast_to(known, len(seen))
    for i in range(len(seen)):
        if seen[i]:
            out.append(SpotStatus.TURNED if turned[i] else SpotStatus.MATCHED)
        elif not known[i]:
            out.append(SpotStatus.LOST)
        elif not exists[i]:
            out.append(SpotStatus.OFF_SCREEN)
        elif not has_image[i]:
            out.append(SpotStatus.NO_IMAGE)
        else:
            out.append(SpotStatus.OCCLUDED if inside[i] else SpotStatus.OUT_OF_VIEW)
    return tuple(out)


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
    # (28,) of the rest: the part of errors of places in noise and errors of places; sigmas of [dt, dtheta] (m, rad), to
    # be squared and added, of turns within the exposure; upper triangle of the part (6, 6) of estimated clocks. None:
    # not known apart
    rest_parts: Array | None = None
    # (n, 2) px: by how much uv_px and predicted_px, which are at the instants of the pictures, differ from those at the
    # instant of the pose. None: the instants are the same
    shift_px: Array | None = None

    @property
    def uv_at_pose_px(self) -> Array:
        """(n, 2): uv_px as they would be at the instant of the pose."""
        return self.uv_px if self.shift_px is None else self.uv_px - self.shift_px
