"""The circle in one frame: status, cause, state, and the fit behind it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from geometry.arrays import Array
from tracking.drogue_circle.rim_fit import RimFit
from tracking.statuses import PoseStatus


class Cause(StrEnum):
    """Why a frame has no measured circle; empty where it has one."""

    NONE = ""
    NO_IMAGE = "no_image"
    OCCLUDED = "occluded"
    NOT_FOUND = "not_found"
    AMBIGUOUS = "ambiguous"
    OUT_OF_VIEW = "out_of_view"

    @property
    def meaning(self) -> str:
        """One sentence for the user."""
        return _MEANINGS[self]


_MEANINGS = {
    Cause.NONE: "the circle is measured",
    Cause.NO_IMAGE: "there is no usable picture",
    Cause.OCCLUDED: "half of the target or more is hidden",
    Cause.NOT_FOUND: "no circle in the picture fits",
    Cause.AMBIGUOUS: "several circles fit equally well",
    Cause.OUT_OF_VIEW: "the predicted centre is outside the picture",
}


@dataclass(frozen=True, slots=True)
class CircleFrame:
    """The circle in one frame. Arrays are nan while nothing is known."""

    status: PoseStatus
    cause: Cause
    state: Array  # (6,) u, v, r in px and their rates in px/frame
    covariance: Array  # (6, 6)
    predicted: Array  # (3,) u, v, r before the picture was used
    measured: RimFit | None  # the fit that was used
    occlusion: float  # gamma; nan where it is unknown
    circles: int = 0  # separate circles, where the whole picture was searched
    event: str = ""  # acquired, reacquired, lost, ambiguous

    @property
    def found(self) -> int:
        """The same as `circles`, by the name that all trackers share."""
        return self.circles


def nothing_known(cause: Cause, event: str = "") -> CircleFrame:
    """A lost frame."""
    nan = np.full(6, np.nan)
    return CircleFrame(PoseStatus.LOST, cause, nan, np.full((6, 6), np.nan), nan[:3], None, np.nan, event=event)
