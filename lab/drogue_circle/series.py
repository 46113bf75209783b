"""The frames of a whole recording, as arrays for the summary, the verdict and the report."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from geometry.arrays import Array, Bools
from lab.detect.frame_series import FrameSeries
from tracking.drogue_circle.frames import Cause, CircleFrame
from tracking.statuses import PoseStatus


@dataclass(slots=True, kw_only=True)
class CircleSeries(FrameSeries):
    """All frames so far."""

    form: str
    frames: list[CircleFrame] = field(default_factory=list)

    def add(self, number: int, frame: CircleFrame) -> None:
        """Add the next frame."""
        self.numbers.append(number)
        self.frames.append(frame)

    def has_status(self, status: PoseStatus) -> Bools:
        """Which frames (n,) have a status."""
        return np.array([f.status is status for f in self.frames], dtype=bool)

    @property
    def states(self) -> Array:
        """(n, 6); nan where nothing is known."""
        return np.array([f.state for f in self.frames]).reshape(-1, 6)

    @property
    def sigmas(self) -> Array:
        """(n, 6) standard deviations; nan where nothing is known."""
        return np.array([np.sqrt(np.diag(f.covariance)) for f in self.frames]).reshape(-1, 6)

    @property
    def fits(self) -> Array:
        """(n, 3): measured u, v, radius; nan without a fit."""
        nan = np.full(3, np.nan)
        return np.array([nan if f.measured is None else f.measured.centre_and_radius for f in self.frames]).reshape(
            -1, 3
        )

    def quality(self) -> Array:
        """(n, 3): occlusion coefficient, coverage and RMS of the fit (px); nan where there is none."""
        rows = [
            (f.occlusion, *((np.nan, np.nan) if f.measured is None else (f.measured.coverage, f.measured.rms_px)))
            for f in self.frames
        ]
        return np.array(rows, dtype=float).reshape(-1, 3)

    def statuses(self) -> dict[str, int]:
        """Number of frames by status, all statuses."""
        return {status.value: int(self.has_status(status).sum()) for status in PoseStatus}

    def causes(self) -> dict[str, int]:
        """Number of frames without a measurement by cause, the most frequent first."""
        counts = Counter(f.cause.value for f in self.frames if f.cause is not Cause.NONE)
        return dict(counts.most_common())

    def events(self) -> list[dict[str, object]]:
        """Frame, kind and number of circles of every event."""
        return [
            {"frame": number, "kind": f.event, "circles": f.circles}
            for number, f in zip(self.numbers, self.frames, strict=True)
            if f.event
        ]
