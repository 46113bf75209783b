"""What is known of a drogue while it is followed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tracking.light_tracker.confidence import fisher
from tracking.light_tracker.known import Known, is_similar
from tracking.light_tracker.motion import Motion
from tracking.light_tracker.parameters import LightParameters
from tracking.light_tracker.pattern import Match, Pattern

TRUSTED = 4  # detections that confirmed a track
LONGEST_GAP = 20  # frames
_MOSTLY = 0.6  # visible share from which the agreement of this share counts


@dataclass(slots=True)
class Track:
    """What is known of the drogue while it is followed."""

    motion: Motion
    pattern: Pattern
    support: float  # running mean of the log odds of the checks
    usual: float = float("nan")  # running mean of Fisher's z of the matches' correlation
    confirmed: int = 1  # detections
    unconfirmed: int = 0  # checks in a row without a detection
    age: float = 0.0  # frames since the last confirmation
    since_check: int = 0  # frames since the detector searched
    lost: bool = False  # reported as lost
    trusted: float = 1.0  # confidence of the last measured frame
    misses: int = 0  # frames in a row without a measurement
    blind: int = 0  # frames in a row without a match that resembles the pattern
    gap: int = 0  # the same, and falling by one with each match afterwards: how far the drogue can have moved away
    before: Known | None = None  # the appearance before the pattern was cut out again

    @property
    def known(self) -> Known | None:
        """The appearance that detections confirmed last."""
        if self.confirmed < TRUSTED or np.isnan(self.usual):
            return self.before
        return Known(self.pattern, self.usual, self.confirmed, self.motion)

    def take_back(self, known: Known, found: Match, p: LightParameters) -> None:
        """Continue with the appearance from before, found again at a place."""
        self.motion = known.motion.moved(found, p)
        self.pattern, self.usual, self.confirmed, self.before = known.pattern, known.usual, known.confirmed, None

    def count_blind(self) -> None:
        """One more frame without a match."""
        self.blind, self.gap = self.blind + 1, min(self.gap + 1, LONGEST_GAP)

    def resembles(self, match: Match) -> bool:
        """Whether a match is about as good as the ones before."""
        z = fisher(match.agreement if match.visible > _MOSTLY else match.correlation)
        return bool(np.isnan(self.usual)) or is_similar(self.usual, z)  # nan: a new pattern
