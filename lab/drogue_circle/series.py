"""The frames of a whole recording, as arrays for the summary, the verdict and the report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array
from lab.target.frame_series import FrameSeries
from tracking.drogue_circle.frames import CircleFrame


@dataclass(slots=True, kw_only=True)
class CircleSeries(FrameSeries[CircleFrame]):
    """All frames so far."""

    form: str

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
