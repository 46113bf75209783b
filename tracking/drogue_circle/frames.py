"""The circle in one frame: status, cause, state, and the fit behind it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array
from tracking.drogue_circle.rim_fit import RimFit
from tracking.statuses import Cause, PoseStatus


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
    found: int = 0  # separate circles, where the whole picture was searched
    event: str = ""  # acquired, reacquired, lost, ambiguous

    @property
    def place(self) -> Array:
        """u, v, radius (3,), px."""
        return self.state[:3]

    @property
    def sigmas(self) -> Array:
        """Standard deviations (3,) of `place`."""
        return np.sqrt(np.diag(self.covariance))[:3]


def nothing_known(cause: Cause, event: str = "") -> CircleFrame:
    """A lost frame."""
    nan = np.full(6, np.nan)
    return CircleFrame(PoseStatus.LOST, cause, nan, np.full((6, 6), np.nan), nan[:3], None, np.nan, event=event)
