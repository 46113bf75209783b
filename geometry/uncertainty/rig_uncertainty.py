"""Effect of a calibration's errors on the pixels of all spots together; the errors are the same in every frame.

A calibration that is wrong by a draw of its covariance moves the spots of one frame jointly, and those of the next
frame in the same way. The pose is therefore solved with this covariance beside the noise (generalised least squares),
which keeps the consistency tests correct, and its share of the pose's covariance is reported separately: averaging over
frames does not reduce it. Source: ours.
"""

from __future__ import annotations

import numpy as np

from geometry import rotations
from geometry.arrays import Array, symmetric
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from geometry.uncertainty.rig_parameters import RigCovariance, Sensitivity

# The covariance is computed at the middles of cells of poses; all poses of a cell share it. They lie at most 43 mm and
# 0.87 deg from the middle, where the pixels' sigmas differ by up to 2 % (the paper's rig, all numbers with equal
# sigmas). A computation takes 0.9 ms of CPU time there, more than all else in a frame; a kept one takes 0.07 ms.
CELL_M, CELL_RAD = 0.05, np.deg2rad(1.0)  # sides of a cell: position, and rotation vector of the attitude
_MAX_CELLS = 1000  # covariances kept, 5 kB each with twelve views


class CalibrationSpread:
    """The joint covariance of the pixels of all views that the covariance of a rig's calibration implies."""

    def __init__(self, rig: Rig, model: SpotModel, covariance: RigCovariance) -> None:
        """model: of this rig.

        Raises:
            KeyError: the covariance names a number that the rig does not have.
        """
        self._model = model
        self._sensitivity = Sensitivity(rig, model, covariance.names)
        self._root = _root(covariance.matrix)
        self._kept: dict[bytes, Array] = {}

    def at(self, world_from_body: Pose) -> Array:
        """Covariance (2n, 2n), px^2, of the pixels of the n views, ordered u, v; 0 for views without projection.

        Depends on the pose's cell alone, not on earlier calls: all poses of a cell get the covariance of its middle.
        """
        position = np.round(world_from_body.translation / CELL_M) + 0.0  # + 0.0: -0 is the cell of 0
        attitude = np.round(rotations.log(world_from_body.rotation) / CELL_RAD) + 0.0
        cell = position.tobytes() + attitude.tobytes()
        if cell not in self._kept:
            if len(self._kept) >= _MAX_CELLS:
                self._kept.clear()
            self._kept[cell] = self._at_exactly(Pose(rotations.exp(attitude * CELL_RAD), position * CELL_M))
        return self._kept[cell]

    def _at_exactly(self, world_from_body: Pose) -> Array:
        derivatives = self._model.derivatives(world_from_body)
        moves = self._sensitivity.of(derivatives)
        moves = np.where(np.isnan(derivatives.pixels)[..., None], 0.0, moves).reshape(-1, moves.shape[-1])
        spread = moves @ self._root
        return np.asarray(spread @ spread.T)


def _root(covariance: Array) -> Array:
    """A (p, r) with A A^T the covariance (p, p), which may be singular and of numbers of very different units."""
    unit = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    safe = np.where(unit > 0, unit, 1.0)
    eigenvalues, vectors = np.linalg.eigh(symmetric(covariance / np.outer(safe, safe)))
    real = eigenvalues > 1e-12 * max(float(eigenvalues[-1]), 1e-300)
    return (vectors[:, real] * np.sqrt(eigenvalues[real])) * unit[:, None]
