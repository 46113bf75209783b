"""Poses: the algebra of transforms, and the pose error that the file contract defines."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geometry.pose import Pose, ypr_sigmas
from tests.geometry.scenes import random_pose

seeds = st.integers(0, 2**32 - 1)
ROUNDING_M = 1e-14  # rounding of a few metres


def same(a: Pose, b: Pose, atol: float = ROUNDING_M) -> None:
    np.testing.assert_allclose(a.rotation, b.rotation, rtol=0, atol=atol)
    np.testing.assert_allclose(a.translation, b.translation, rtol=0, atol=atol)


@given(seed=seeds)
def test_a_product_of_transforms_applies_them_in_turn(seed):
    rng = np.random.default_rng(seed)
    a_from_b, b_from_c = random_pose(rng), random_pose(rng)
    points_c = rng.normal(size=(4, 3))
    np.testing.assert_allclose(
        (a_from_b @ b_from_c).apply(points_c), a_from_b.apply(b_from_c.apply(points_c)), rtol=0, atol=ROUNDING_M
    )


@given(seed=seeds)
def test_a_transform_times_its_inverse_is_the_identity(seed):
    rng = np.random.default_rng(seed)
    pose = random_pose(rng)
    same(pose @ pose.inverse(), Pose.identity())
    same(pose.inverse() @ pose, Pose.identity())
    same(pose.inverse().inverse(), pose)


@given(seed=seeds)
def test_a_direction_is_rotated_and_not_translated(seed):
    rng = np.random.default_rng(seed)
    pose, start, vector = random_pose(rng), rng.normal(size=3), rng.normal(size=3)
    np.testing.assert_allclose(
        pose.turn(vector), pose.apply(start + vector) - pose.apply(start), rtol=0, atol=ROUNDING_M
    )


@given(seed=seeds)
def test_plus_the_difference_of_two_poses_gives_the_other(seed):
    rng = np.random.default_rng(seed)
    estimate, truth = random_pose(rng), random_pose(rng)
    same(estimate.plus(truth.minus(estimate)), truth)


@given(seed=seeds, size=st.sampled_from([1e-12, 1e-6, 0.1, 3.0]))
def test_minus_is_the_inverse_of_plus(seed, size):
    rng = np.random.default_rng(seed)
    pose, delta = random_pose(rng), size * rng.normal(size=6)
    if np.linalg.norm(delta[3:]) >= np.pi:
        delta[3:] *= 3.1 / np.linalg.norm(delta[3:])
    np.testing.assert_allclose(pose.plus(delta).minus(pose), delta, rtol=0, atol=ROUNDING_M)


def test_the_error_shifts_in_world_and_turns_in_the_body():
    """Section 1 of the file contract: t_true = t_est + dt, R_true = R_est Exp(dtheta)."""
    facing_left = Pose.from_ypr(np.array([np.pi / 2, 0, 0]), np.zeros(3))
    shifted = facing_left.plus(np.array([0.1, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(shifted.translation, [0.1, 0, 0], atol=ROUNDING_M)
    rolled = facing_left.plus(np.array([0, 0, 0, 0.2, 0, 0]))  # about the body's own x: a roll
    np.testing.assert_allclose(rolled.ypr, [np.pi / 2, 0, 0.2], atol=ROUNDING_M)
    np.testing.assert_allclose(rolled.translation, 0, atol=ROUNDING_M)


@given(seed=seeds)
def test_a_pose_is_recovered_from_its_quaternion_which_equals_scipys(seed):
    pose = random_pose(np.random.default_rng(seed))
    same(Pose.from_quaternion(pose.quaternion_wxyz, pose.translation), pose)
    np.testing.assert_allclose(
        Rotation.from_quat(pose.quaternion_wxyz, scalar_first=True).as_matrix(), pose.rotation, rtol=0, atol=ROUNDING_M
    )


@given(seed=seeds)
def test_a_pose_is_recovered_from_its_angles(seed):
    pose = random_pose(np.random.default_rng(seed))
    same(Pose.from_ypr(pose.ypr, pose.translation), pose, atol=1e-8)


def test_a_stack_gives_the_same_as_each_element_alone():
    rng = np.random.default_rng(5)
    poses = [random_pose(rng) for _ in range(4)]
    stack = Pose(np.array([p.rotation for p in poses]), np.array([p.translation for p in poses]))
    point, deltas = rng.normal(size=3), rng.normal(0, 0.1, (4, 6))
    for i, pose in enumerate(poses):
        np.testing.assert_allclose(stack.apply(point)[i], pose.apply(point), atol=ROUNDING_M)
        same(stack[i], pose)
        same(stack.inverse()[i], pose.inverse())
        same(stack.plus(deltas)[i], pose.plus(deltas[i]))
        same((stack @ stack[::-1])[i], pose @ poses[3 - i])
        np.testing.assert_allclose(stack.minus(stack[::-1])[i], pose.minus(poses[3 - i]), atol=ROUNDING_M)


def test_the_sigmas_of_the_angles_equal_their_scatter():
    rng = np.random.default_rng(6)
    pose = Pose.from_ypr(np.radians([20.0, 50.0, -35.0]), np.zeros(3))
    root = rng.normal(0, 1e-3, (6, 6))
    scatter = pose.plus(rng.normal(size=(40_000, 6)) @ root.T).ypr.std(axis=0)
    # The sigma of 40,000 draws has a standard deviation of 0.35 %; four times that.
    np.testing.assert_allclose(ypr_sigmas(pose, root @ root.T), scatter, rtol=0.014)
