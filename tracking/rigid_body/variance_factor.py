"""Online estimate of the variance factor: by how much the spots' errors exceed their stated sigmas."""

from __future__ import annotations

from collections import deque

import numpy as np

MEMORY = 100  # fits: time constant of the estimate, once it has seen so many
PRIOR_DOF = 30  # degrees of freedom that the stated sigmas count at the start: the first fits have more weight
DEADBAND = 1.3  # no effect below; if the stated sigmas are correct the estimate scatters by 0.06 about 1
MAX_RATIO = 3.0  # a single fit counts at most this many times the estimate
RECENT_FITS = 9  # if the median of so many exceeds the estimate by MAX_RATIO, the estimate jumps to it


class VarianceFactor:
    """Running mean of chi-square per degree of freedom, robust to outliers."""

    def __init__(self) -> None:
        self._mean = 1.0
        self._seen = float(PRIOR_DOF)  # degrees of freedom
        self._deadband = DEADBAND
        self._recent: deque[float] = deque(maxlen=RECENT_FITS)

    @property
    def noise_scale(self) -> float:
        """Ratio of the spots' errors to their stated sigmas; 1 while the estimate is within the deadband."""
        return float(np.sqrt(self._mean)) if self._mean > self._deadband else 1.0

    def update(self, chi2: float, dof: int, systematic_share: float = 0.0) -> None:
        """Take one fit.

        systematic_share: share of the expected misfit that comes from calibration errors. These are the same in every
        frame, so that no mean reduces their scatter; the deadband is widened by it.
        """
        if dof <= 0:
            return
        factor = chi2 / dof
        self._recent.append(factor)
        median = sorted(self._recent)[len(self._recent) // 2]
        if len(self._recent) == self._recent.maxlen and median > MAX_RATIO * max(self._mean, 1.0):
            self._mean = median
        self._seen += dof
        self._mean *= 1 + (min(factor / self._mean, MAX_RATIO) - 1) * max(dof / self._seen, 1 / MEMORY)
        self._mean = max(self._mean, 0.1)
        self._deadband = DEADBAND + 3 * systematic_share * np.sqrt(2 / dof)

    def raise_to(self, chi2: float, dof: int) -> None:
        """Raise the estimate at once to the misfit of a frame whose labels are certain for other reasons."""
        if dof > 0:
            self._mean = max(self._mean, chi2 / dof)
