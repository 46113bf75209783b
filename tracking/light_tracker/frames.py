"""The drogue in one frame: status, cause, place, size, confidence and who measured it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from geometry.arrays import Array
from tracking.statuses import Cause, PoseStatus


class Source(StrEnum):
    """What measured the drogue."""

    NONE = ""
    DETECTOR = "detector"
    LIGHT = "light"
    BOTH = "both"

    @property
    def meaning(self) -> str:
        """One sentence for the user."""
        return _SOURCES[self]


_SOURCES = {
    Source.NONE: "nothing",
    Source.DETECTOR: "the detector alone: an acquisition",
    Source.LIGHT: "the light tracker",
    Source.BOTH: "the light tracker, and the detector confirms it",
}


@dataclass(frozen=True, slots=True)
class DrogueFrame:
    """The drogue in one frame. Numbers that are not known are nan."""

    status: PoseStatus
    cause: Cause
    source: Source
    centre_px: Array  # (2,) of the rim's image
    rate_px: Array  # (2,) px/frame
    diameter_px: float
    covariance: Array  # (2, 2) of the centre, px^2
    sigma_diameter_px: float
    confidence: float  # probability that the centre is within a quarter of the diameter of the drogue's
    correlation: float  # of the match; nan without one
    searched: str = ""  # what the detector searched in this frame: window, picture, or both
    found: int = 0  # drogues that it found
    event: str = ""  # acquired, reacquired, lost, ambiguous

    @property
    def place(self) -> Array:
        """u, v, diameter (3,), px."""
        return np.array([*self.centre_px, self.diameter_px])

    @property
    def sigmas(self) -> Array:
        """Standard deviations (3,) of `place`."""
        return np.array([*np.sqrt(np.diag(self.covariance)), self.sigma_diameter_px])

    @property
    def known(self) -> bool:
        """Whether there is a place."""
        return self.status is not PoseStatus.LOST


def nothing_known(cause: Cause, event: str = "", searched: str = "", found: int = 0) -> DrogueFrame:
    """A lost frame."""
    nan = float("nan")
    return DrogueFrame(
        PoseStatus.LOST, cause, Source.NONE, np.full(2, nan), np.full(2, nan), nan, np.full((2, 2), nan), nan, 0.0,
        nan, searched, found, event,
    )  # fmt: skip
