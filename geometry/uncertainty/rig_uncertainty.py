"""Effect of a calibration's errors on the pixels of all spots together; the errors are the same in every frame.

A calibration that is wrong by a draw of its covariance moves the spots of one frame jointly, and those of the next
frame in the same way. The pose is therefore solved with this covariance beside the noise (generalised least squares),
which keeps the consistency tests correct, and its share of the pose's covariance is reported separately: averaging over
frames does not reduce it. Source: ours.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, symmetric
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from geometry.uncertainty.rig_parameters import RigCovariance, Sensitivity


class RigUncertainty:
    """The joint covariance of the pixels of all views that the covariance of a rig's calibration implies."""

    def __init__(self, rig: Rig, model: SpotModel, covariance: RigCovariance) -> None:
        """model: of this rig.

        Raises:
            KeyError: the covariance names a number that the rig does not have.
        """
        self._model = model
        self._sensitivity = Sensitivity(rig, model, covariance.names)
        self._root = _root(covariance.matrix)

    def at(self, world_from_body: Pose) -> Array:
        """Covariance (..., 2n, 2n), px^2, of the pixels of the n views, ordered u, v; 0 for views without projection.

        The pose may be a stack (...): 0.6 ms of CPU time for a pose, 0.03 ms for each of a stack.
        """
        derivatives = self._model.derivatives(world_from_body)
        moves = self._sensitivity.of(derivatives)
        moves = np.where(np.isnan(derivatives.pixels)[..., None], 0.0, moves)
        *stack, n, two, p = moves.shape
        spread = moves.reshape(*stack, n * two, p) @ self._root  # the stack may be empty
        return np.asarray(spread @ np.swapaxes(spread, -1, -2))


def _root(covariance: Array) -> Array:
    """A (p, r) with A A^T the covariance (p, p), which may be singular and of numbers of very different units."""
    unit = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    safe = np.where(unit > 0, unit, 1.0)
    eigenvalues, vectors = np.linalg.eigh(symmetric(covariance / np.outer(safe, safe)))
    real = eigenvalues > 1e-12 * max(float(eigenvalues[-1]), 1e-300)
    return (vectors[:, real] * np.sqrt(eigenvalues[real])) * unit[:, None]
