"""How much larger than claimed the spots' errors are: light and calibration are seldom as good as the sigmas say."""

from __future__ import annotations

from collections import deque

import numpy as np

MEMORY = 100  # fits: memory of the misfit that scales claimed covariances ...
DEADBAND = 1.3  # ... once it exceeds this: with honest sigmas it scatters by 0.06 about 1


class VarianceFactor:
    """The slow mean of chi-square per degree of freedom, and what follows from it."""

    def __init__(self) -> None:
        self._mean = 1.0
        self._deadband = DEADBAND
        self._recent: deque[float] = deque(maxlen=9)

    @property
    def noise_scale(self) -> float:
        """How much larger than claimed the spots' errors are; 1 while the misfit does not say otherwise."""
        return float(np.sqrt(self._mean)) if self._mean > self._deadband else 1.0

    def take(self, chi2: float, dof: int, systematic_share: float = 0.0) -> None:
        """Learn from one fit: a single one counts at most threefold, but when most misfit the mean jumps.

        systematic_share: of the expected misfit, how much is the same in every frame. One calibration has one set of
        errors: its share is drawn once, and no mean evens it out.
        """
        if dof <= 0:
            return
        misfit = chi2 / dof
        self._recent.append(misfit)
        usual = sorted(self._recent)[len(self._recent) // 2]
        if len(self._recent) == self._recent.maxlen and usual > 3 * max(self._mean, 1.0):
            self._mean = usual
        self._mean *= 1 + (min(misfit / self._mean, 3.0) - 1) / MEMORY
        self._mean = max(self._mean, 0.1)
        self._deadband = DEADBAND + 3 * systematic_share * np.sqrt(2 / dof)

    def at_least(self, chi2: float, dof: int) -> None:
        """A frame whose labels are certain for other reasons misfits so much: believe it at once."""
        if dof > 0:
            self._mean = max(self._mean, chi2 / dof)
