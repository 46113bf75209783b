"""Options of `beampose track drogue`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from lab.errors import InputError
from tracking.learned_detector.detector import learned_detector
from tracking.light_tracker.parameters import LightParameters
from tracking.light_tracker.tracker import DrogueTracker


@dataclass(frozen=True, slots=True)
class DrogueOptions:
    """Which drogue to track, and how."""

    near_px: tuple[float, float] | None = None  # centre of the first drogue, within 20 px or its radius
    check_every: int = LightParameters().check_every  # frames between two checks by the detector
    smallest_px: float = LightParameters().smallest_px  # diameters that are looked for
    largest_px: float | None = None  # None: the picture's smaller side
    rate_hz: float | None = None  # None: that of the video
    overlay: bool = False  # write overlay.avi
    limit: int | None = None  # largest number of pictures

    def parameters(self) -> LightParameters:
        """The parameters of the tracker.

        Raises:
            InputError: the diameters do not make a range.
        """
        if self.largest_px is not None and self.largest_px <= self.smallest_px:
            raise InputError(
                f"--max-diameter: expected more than --min-diameter ({self.smallest_px:g} px), got {self.largest_px:g}"
            )
        return LightParameters(check_every=self.check_every, smallest_px=self.smallest_px, largest_px=self.largest_px)

    def tracker(self) -> DrogueTracker:
        """A tracker before its first picture. Raises InputError as `parameters` does."""
        parameters = self.parameters()
        largest = None if self.largest_px is None else self.largest_px / 2
        return DrogueTracker(learned_detector(self.smallest_px / 2, largest), parameters, self.near_px)

    def as_mapping(self) -> dict[str, Any]:
        """All options and parameters, for summary.json."""
        return {"options": asdict(self), "tracker": asdict(self.parameters())}
