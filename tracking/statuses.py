"""The status words of spots and poses, and what each means. The report and the documentation read them from here."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

import numpy as np

from geometry.arrays import Bools

LOST_SIGMA_M, LOST_SIGMA_RAD = 1.0, np.deg2rad(60.0)  # a predicted pose with larger sigmas is `lost`


class SpotStatus(StrEnum):
    """What is known of one spot in one picture."""

    MATCHED = "matched"
    TURNED = "turned"
    OCCLUDED = "occluded"
    OUT_OF_VIEW = "out_of_view"
    OFF_SCREEN = "off_screen"
    NO_IMAGE = "no_image"
    LOST = "lost"

    @property
    def meaning(self) -> str:
        """One sentence for a reader."""
        return _SPOT_MEANINGS[self]

    @property
    def measured(self) -> bool:
        """Whether a detection of this picture stands behind the position."""
        return self in (SpotStatus.MATCHED, SpotStatus.TURNED)


class PoseStatus(StrEnum):
    """What is known of the vehicle's pose in one frame."""

    MEASURED = "measured"
    PREDICTED = "predicted"
    LOST = "lost"

    @property
    def meaning(self) -> str:
        """One sentence for a reader."""
        return _POSE_MEANINGS[self]


_SPOT_MEANINGS = {
    SpotStatus.MATCHED: "found in the search region around the prediction (matching step 1)",
    SpotStatus.TURNED: "found by the second search, around the last position: the trajectory bent (step 2)",
    SpotStatus.OCCLUDED: "should be in view, no detection accepted: the estimate is used (step 3)",
    SpotStatus.OUT_OF_VIEW: "outside the image: solved from the other beams",
    SpotStatus.OFF_SCREEN: "the beam is known, but misses its screen or cannot be projected",
    SpotStatus.NO_IMAGE: "this camera has no usable image for this frame: the position is the estimate",
    SpotStatus.LOST: "nothing is known",
}

_POSE_MEANINGS = {
    PoseStatus.MEASURED: "the pose is observable from this frame's matched spots",
    PoseStatus.PREDICTED: "not observable in this frame: motion model, with a covariance that says so",
    PoseStatus.LOST: "nothing is known",
}


def view_statuses(
    seen: Bools, turned: Bools, exists: Bools, inside: Bools, has_image: Sequence[bool] | Bools, known: bool
) -> tuple[SpotStatus, ...]:
    """One word per view, all (n,): a detection is labelled, at a bend; the pose projects it, into the picture; the
    camera has a picture. known: there is a pose.
    """
    out = []
    for i in range(len(seen)):
        if seen[i]:
            out.append(SpotStatus.TURNED if turned[i] else SpotStatus.MATCHED)
        elif not known:
            out.append(SpotStatus.LOST)
        elif not exists[i]:
            out.append(SpotStatus.OFF_SCREEN)
        elif not has_image[i]:
            out.append(SpotStatus.NO_IMAGE)
        else:
            out.append(SpotStatus.OCCLUDED if inside[i] else SpotStatus.OUT_OF_VIEW)
    return tuple(out)
