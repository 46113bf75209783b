"""What a calibration's errors do to the spots' pixels, all of them together: they are the same in every frame.

A calibration that is off by its covariance moves the spots of one frame in a joint way, and those of the next frame in
the same. Ours: the pose is solved with this covariance beside the noise (generalised least squares), so that tests of
consistency stay right, and its share of the pose's covariance is told apart: averaging over frames does not lessen it.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, symmetric
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from geometry.uncertainty.rig_parameters import RigCovariance, Sensitivity

# A pose as near as this to the one last asked for gets the same answer: the derivatives change by some per cent.
NEAR_M, NEAR_RAD = 0.05, np.deg2rad(1.0)


class CalibrationSpread:
    """The joint covariance of all pixels of a rig, from what its calibration is known to."""

    def __init__(self, rig: Rig, model: SpotModel, covariance: RigCovariance) -> None:
        """model: of this rig. KeyError where the covariance names what the rig does not have."""
        self._model = model
        self._sensitivity = Sensitivity(rig, model, covariance.names)
        self._root = _root(covariance.matrix)
        self._last: tuple[Pose, Array] | None = None

    def at(self, world_from_body: Pose) -> Array:
        """Covariance (2n, 2n), px^2, of the pixels of the n views, u and v in turn; 0 for views without projection.

        The very same array for poses that lie within NEAR_M and NEAR_RAD of each other.
        """
        if self._last is not None:
            apart = world_from_body.minus(self._last[0])
            if np.linalg.norm(apart[:3]) < NEAR_M and np.linalg.norm(apart[3:]) < NEAR_RAD:
                return self._last[1]
        derivatives = self._model.derivatives(world_from_body)
        moves = self._sensitivity.of(derivatives)
        moves = np.where(np.isnan(derivatives.pixels)[..., None], 0.0, moves).reshape(-1, moves.shape[-1])
        spread = moves @ self._root
        joint = np.asarray(spread @ spread.T)
        self._last = (world_from_body, joint)
        return joint


def _root(covariance: Array) -> Array:
    """A (p, r) with A A^T the covariance (p, p), which may be singular; numbers of very unequal units are no harm."""
    unit = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    safe = np.where(unit > 0, unit, 1.0)
    eigenvalues, vectors = np.linalg.eigh(symmetric(covariance / np.outer(safe, safe)))
    real = eigenvalues > 1e-12 * max(float(eigenvalues[-1]), 1e-300)
    return (vectors[:, real] * np.sqrt(eigenvalues[real])) * unit[:, None]
