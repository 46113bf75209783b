"""The outcome of `beampose track point`: the track with its figures and verdict."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lab.number_format import format_percent
from lab.single_target.recording import PointRecording
from lab.single_target.verdict import PointStatistics, Reason
from tracking.single_target.parameters import TargetStatus
from tracking.single_target.point_tracker import PointEstimate


@dataclass(frozen=True, slots=True)
class PointOutcome:
    """The outcome of one call."""

    recording: PointRecording
    track: tuple[PointEstimate, ...]
    statistics: PointStatistics
    reasons: tuple[Reason, ...]
    verdict: str
    exit_status: int
    out: Path

    def line(self) -> str:
        """One line for the command line."""
        s = self.statistics
        first = f" ({self.reasons[0].what})" if self.reasons else ""
        measured = format_percent(s.share(TargetStatus.MEASURED))
        return f"{self.verdict} {self.recording.name}: {s.frames} frames, {measured} measured{first} -> {self.out}"
