"""Options of `beampose track circle`, and the detectors that it offers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

from lab.errors import InputError
from tracking.drogue_circle.candidates import CircleDetector
from tracking.drogue_circle.classical import classical_detector
from tracking.drogue_circle.parameters import CircleParameters
from tracking.drogue_circle.printed import PrintedTracker
from tracking.drogue_circle.tracker import CircleTracker
from tracking.learned_detector.detector import learned_detector

Tracker: TypeAlias = CircleTracker | PrintedTracker

# Name for --detector: its maker. Another detector needs its line here; the rim fit after it is the same for all.
DETECTORS: Mapping[str, Callable[[CircleParameters], CircleDetector]] = {
    "classical": classical_detector,
    "learned": lambda p: learned_detector(p.min_radius_px, p.max_radius_px),
}
SOUND, PRINTED = "sound", "printed"
FORMS = (SOUND, PRINTED)


@dataclass(frozen=True, slots=True)
class CircleOptions:
    """Which circle to track, and how."""

    near_px: tuple[float, float] | None = None  # centre of the first circle, within 20 px
    min_radius_px: float = CircleParameters().min_radius_px
    max_radius_px: float | None = None  # None: half of the picture's smaller side
    rate_hz: float | None = None  # None: that of the video
    form: str = SOUND  # of the noise and the measurement: sound, or as printed
    detector: str = "classical"
    overlay: bool = False  # write overlay.avi
    limit: int | None = None  # largest number of pictures

    def parameters(self) -> CircleParameters:
        """The parameters of the tracker.

        Raises:
            InputError: the radii do not make a range, or there is no such form or detector.
        """
        if self.max_radius_px is not None and self.max_radius_px <= self.min_radius_px:
            raise InputError(
                f"--max-radius: expected more than --min-radius ({self.min_radius_px:g} px), got {self.max_radius_px:g}"
            )
        for option, value, known in (("form", self.form, FORMS), ("detector", self.detector, tuple(DETECTORS))):
            if value not in known:
                raise InputError(f"--{option}: expected one of {', '.join(known)}, got {value!r}")
        return CircleParameters(min_radius_px=self.min_radius_px, max_radius_px=self.max_radius_px)

    def tracker(self) -> Tracker:
        """A tracker before its first picture. Raises InputError as `parameters` does."""
        parameters = self.parameters()
        kind = CircleTracker if self.form == SOUND else PrintedTracker
        return kind(DETECTORS[self.detector](parameters), parameters, self.near_px)

    def as_mapping(self) -> dict[str, Any]:
        """All options and parameters, for summary.json."""
        return {"options": asdict(self), "tracker": asdict(self.parameters())}
