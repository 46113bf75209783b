"""The mean of the stand's rotations."""

from __future__ import annotations

import numpy as np

from geometry import rotations
from geometry.rotations import mean_rotation


def test_the_mean_is_the_rotation_nearest_to_the_mean_matrix():
    vectors = np.random.default_rng(3).normal(0.0, 0.5, (40, 3))
    matrices = rotations.exp(vectors)
    U, _, V = np.linalg.svd(matrices.mean(axis=0))
    nearest = U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
    np.testing.assert_allclose(mean_rotation(matrices), nearest, atol=1e-14)


def test_the_mean_turns_with_the_rotations():
    matrices = rotations.exp(np.random.default_rng(4).normal(0.0, 0.3, (9, 3)))
    turn = rotations.exp(np.array([2.0, -1.0, 0.5]))
    np.testing.assert_allclose(mean_rotation(turn @ matrices), turn @ mean_rotation(matrices), atol=1e-14)
    np.testing.assert_allclose(mean_rotation(matrices[:1]), matrices[0], atol=1e-15)
