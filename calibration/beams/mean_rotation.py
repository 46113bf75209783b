"""The mean of rotations."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array


def mean_rotation(matrices: Array) -> Array:
    """The rotation (3, 3) with the least sum of squared chordal distances to the rotations (n, 3, 3), n >= 1.

    Source: Markley, Cheng, Crassidis & Oshman (2007), "Averaging quaternions", equation (13), as scipy computes it.
    """
    from scipy.spatial.transform import Rotation  # imported here because the import takes 0.1 s

    return np.asarray(Rotation.from_matrix(matrices).mean().as_matrix())
