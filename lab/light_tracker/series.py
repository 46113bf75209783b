"""The frames of a whole recording, as arrays for the summary, the verdict and the report."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array
from lab.target.frame_series import FrameSeries
from tracking.light_tracker.frames import DrogueFrame, Source
from tracking.statuses import PoseStatus


@dataclass(slots=True, kw_only=True)
class DrogueSeries(FrameSeries[DrogueFrame]):
    """All frames so far."""

    @property
    def circles(self) -> Array:
        """(n, 3) u, v and diameter, px; nan where nothing is known."""
        return np.array([[*f.centre_px, f.diameter_px] for f in self.frames]).reshape(-1, 3)

    @property
    def sigmas(self) -> Array:
        """(n, 3) standard deviations of `circles`."""
        rows = [[*np.sqrt(np.diag(f.covariance)), f.sigma_diameter_px] for f in self.frames]
        return np.array(rows).reshape(-1, 3)

    @property
    def confidences(self) -> Array:
        """(n,)"""
        return np.array([f.confidence for f in self.frames])

    @property
    def correlations(self) -> Array:
        """(n,) nan without a match."""
        return np.array([f.correlation for f in self.frames])

    def sources(self) -> dict[str, int]:
        """Number of measured frames by source, all sources."""
        counts = Counter(f.source for f in self.frames if f.status is PoseStatus.MEASURED)
        return {s.value: counts[s] for s in Source if s is not Source.NONE}

    def searches(self) -> dict[str, int]:
        """Number of frames by what the detector searched in them."""
        counts = Counter(f.searched or "none" for f in self.frames)
        return {name: counts[name] for name in ("none", "window", "picture", "both")}

    def checks(self) -> tuple[int, int]:
        """Checks of measured frames by the detector, and those that confirmed the drogue."""
        checked = [f for f in self.frames if f.status is PoseStatus.MEASURED and f.searched and not f.event]
        return len(checked), sum(f.source is Source.BOTH for f in checked)
