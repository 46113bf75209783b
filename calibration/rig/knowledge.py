"""What is known of the errors of a rig's parameters, before and after recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.changes import ExcessResidual
from calibration.model_check.fault_identification import compressed
from calibration.rig.recordings import Reduced
from geometry.arrays import Array, Bools


@dataclass(frozen=True, slots=True)
class Knowledge:
    """What is known of p errors delta: a mean and a covariance L L^T."""

    mean: Array  # (p,)
    root: Array  # (p, r)

    @property
    def covariance(self) -> Array:
        """(p, p)"""
        return np.asarray(self.root @ self.root.T)

    def with_data(self, data: Sequence[Reduced], changed: Bools | None = None) -> Knowledge:
        """After some recordings.

        changed (p,): the numbers that are changed; the others keep their mean and stay uncertain (Schmidt 1966,
        "Application of state-space methods to navigation problems"). None: all.
        """
        S, g = normal_equations(data)
        values, vectors = np.linalg.eigh(np.eye(self.root.shape[1]) + self.root.T @ S @ self.root)
        root = self.root @ (vectors / np.sqrt(values))
        step = root @ (root.T @ (g - S @ self.mean))
        if changed is None or changed.all():
            return Knowledge(self.mean + step, root)
        gain = np.where(changed[:, None], root @ root.T, 0.0)
        own = self.root - gain @ S @ self.root
        return Knowledge(
            self.mean + np.where(changed, step, 0.0), np.concatenate([own, gain @ compressed(S)[0].T], axis=1)
        )

    def excess(self, data: Sequence[Reduced]) -> tuple[ExcessResidual, Array, float]:
        """What this does not explain of some recordings, the whitened X (q, p) that belongs to it, and ln p(data)."""
        X, y = np.concatenate([d.X for d in data]), np.concatenate([d.y for d in data])
        spread = X @ self.root
        factor = np.linalg.cholesky(np.eye(len(y)) + spread @ spread.T)
        white = np.linalg.solve(factor, y - X @ self.mean)
        chi2 = float(white @ white) + sum(d.rest for d in data)
        log_density = -0.5 * chi2 - float(np.sum(np.log(np.diagonal(factor))))
        return ExcessResidual.of_white(white), np.linalg.solve(factor, X), log_density

    def log_density(self, data: Sequence[Reduced]) -> float:
        """ln p of some recordings, up to a constant that is the same for all knowledge and values of the rig."""
        return self.excess(data)[2]


def normal_equations(data: Sequence[Reduced]) -> tuple[Array, Array]:
    """X^T X (p, p) and X^T y (p,) of some recordings."""
    return np.sum([d.X.T @ d.X for d in data], axis=0), np.sum([d.X.T @ d.y for d in data], axis=0)
