"""Recorded poses as a term of an adjustment: the readings of a stand at its positions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.least_squares.adjustment import Linearised, Loss, Part, Values
from calibration.terms.surveyed import pose_of
from geometry import rotations
from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose


@dataclass(frozen=True, slots=True)
class RecordTerm:
    """n recorded transforms of a stack of poses, each number with its own sigma."""

    stack: str
    index: Ints  # (n,) index into the stack
    recorded: Pose  # (n,)
    sigmas: Array  # (n, 6), m and rad, of the error [dt, dtheta]; inf: not recorded; 0 only for numbers held fixed
    loss: Loss | None = None

    def __len__(self) -> int:
        return len(self.index)

    def pick(self, rows: Bools, loss: Loss | None = None) -> RecordTerm:
        """Some of the records, with this loss."""
        return RecordTerm(self.stack, self.index[rows], self.recorded[rows], self.sigmas[rows], loss)

    def widened(self, scale: float) -> RecordTerm:
        """The same records with all sigmas multiplied."""
        return replace(self, sigmas=self.sigmas * scale)

    def linearise(self, values: Values) -> Linearised:
        """Pose minus record (n, 6), in sigmas; 0 for numbers that are not recorded or held fixed."""
        delta = pose_of(values, self.stack)[self.index].minus(self.recorded)
        used = np.isfinite(self.sigmas) & (self.sigmas > 0)
        per_sigma = np.where(used, 1.0 / np.where(used, self.sigmas, 1.0), 0.0)
        J = np.zeros((len(self.index), 6, 6))
        J[:, :3, :3] = np.eye(3)
        # d(log(R_0^T R Exp(theta))) / d(theta) is the inverse of the right Jacobian at the difference.
        J[:, 3:, 3:] = np.linalg.inv(rotations.right_jacobian(delta[:, 3:]))
        return Linearised(delta * per_sigma, [Part(self.stack, self.index, per_sigma[..., None] * J)])
