"""The compiled small matrices and rotations against numpy and against the stacked formulas."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry import rotations, small
from geometry.pose import Pose

seeds = st.integers(0, 2**32 - 1)
ANGLES = (0.0, 1e-9, 1e-5, 0.3, 2.0, np.pi - 1e-7)


def vector(rng: np.random.Generator, angle: float) -> np.ndarray:
    axis = rng.normal(size=3)
    return angle * axis / np.linalg.norm(axis)


@pytest.mark.parametrize("angle", ANGLES)
def test_rotations_are_those_of_the_stacked_formulas(angle):
    w = vector(np.random.default_rng(1), angle)
    R = rotations.exp(w)
    np.testing.assert_allclose(small.exp(w), R, rtol=0, atol=1e-15)
    np.testing.assert_allclose(small.log(R), rotations.log(R), rtol=0, atol=1e-12)
    np.testing.assert_allclose(small.right_jacobian(w), rotations.right_jacobian(w), rtol=0, atol=1e-8)


@settings(max_examples=30, deadline=None)
@given(seed=seeds)
def test_a_pose_moved_and_taken_apart_again_gives_the_same_difference(seed):
    rng = np.random.default_rng(seed)
    pose = Pose(rotations.exp(vector(rng, 1.0)), rng.normal(size=3))
    delta = np.concatenate([rng.normal(size=3), vector(rng, rng.uniform(0, 3.0))])
    R, t = small.moved(pose.rotation, pose.translation, delta)
    expected = pose.plus(delta)
    np.testing.assert_allclose(R, expected.rotation, rtol=0, atol=1e-14)
    np.testing.assert_allclose(t, expected.translation, rtol=0, atol=1e-14)
    np.testing.assert_allclose(small.apart(R, t, pose.rotation, pose.translation), delta, rtol=0, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(seed=seeds, n=st.integers(1, 12))
def test_a_system_is_solved_as_numpy_solves_it(seed, n):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(n, n)) + 3 * np.eye(n), rng.normal(size=(n, 2))
    x, log_det = small.solve(a, b)
    np.testing.assert_allclose(a @ x, b, rtol=0, atol=1e-9)
    assert log_det == pytest.approx(np.linalg.slogdet(a)[1], abs=1e-9)
    np.testing.assert_allclose(small.multiply(a, b), a @ b, rtol=0, atol=1e-12)
    np.testing.assert_allclose(small.apply(a, b[:, 0].copy()), a @ b[:, 0], rtol=0, atol=1e-12)


def test_a_singular_system_is_seen_by_its_determinant():
    a = np.ones((3, 3))
    assert not np.isfinite(small.solve(a, np.ones((3, 1)))[1])
