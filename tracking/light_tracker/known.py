"""The appearance of a drogue that detections confirmed, kept while a newer one is not confirmed.

A drogue that is found again while a part of it is still hidden gives a pattern with the edge of what hides it. Such a
pattern does not match the whole drogue some frames later; the one from before does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tracking.drogue_circle.candidates import Picture
from tracking.light_tracker.frames import fisher
from tracking.light_tracker.motion import Motion
from tracking.light_tracker.pattern import Match, Pattern, unexplained

_SIMILAR = 0.7  # fall of Fisher's z of the correlation below its usual value
_GOOD = 1.5  # Fisher's z that is similar in any case: a correlation of 0.905
_LEAD = 0.3  # of Fisher's z over the next best place of the window


def is_similar(usual: float, z: float) -> bool:
    """Whether a match with Fisher's z is about as good as those of a pattern usually are."""
    return usual - z < _SIMILAR or z > _GOOD


def is_clear(match: Match) -> bool:
    """Whether no other place of the window is nearly as good."""
    return fisher(match.correlation) > fisher(match.second) + _LEAD


@dataclass(frozen=True, slots=True)
class Known:
    """A pattern with what belongs to it."""

    pattern: Pattern
    usual: float  # running mean of Fisher's z of its matches
    confirmed: int  # detections
    motion: Motion  # of its last frame: size, offset of the rim

    def found(self, picture: Picture, u_px: float, v_px: float, reach_px: float) -> Match | None:
        """Where it is within `reach_px` of a place; None where nothing looks like it, or several places do."""
        usual = unexplained(float(np.tanh(self.usual)))
        match = self.pattern.find(picture, u_px, v_px, self.motion.diameter_px, reach_px, usual)
        if match is None or not is_similar(self.usual, fisher(match.correlation)) or not is_clear(match):
            return None
        return match
