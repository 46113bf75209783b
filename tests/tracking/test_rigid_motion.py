"""The vehicle's pose filter: exact for constant velocities, correct Jacobians, a correct covariance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geometry import rotations
from geometry.arrays import numeric_jacobian
from geometry.pose import Pose
from tracking.kalman import RigidMotion

DT = 0.01


def plus(motion: RigidMotion, delta: np.ndarray) -> RigidMotion:
    """The motion plus an error state (12,)."""
    return RigidMotion(
        motion.world_from_body.plus(delta[:6]), motion.velocity + delta[6:9], motion.rate + delta[9:], motion.P
    )


def minus(motion: RigidMotion, other: RigidMotion) -> np.ndarray:
    return np.concatenate([motion.world_from_body.minus(other.world_from_body), motion.velocity - other.velocity,
                           motion.rate - other.rate])  # fmt: skip


def some_motion(rng: np.random.Generator, rate: float = 3.0) -> RigidMotion:
    A = rng.normal(size=(12, 12)) * 0.01
    pose = Pose(Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3))
    return RigidMotion(pose, rng.normal(size=3), rate * rng.normal(size=3), A @ A.T)


def test_constant_velocity_and_rate_are_followed_exactly():
    """One and a half turns in 300 steps, against scipy's rotation."""
    rng = np.random.default_rng(1)
    motion = start = some_motion(rng)
    for _ in range(300):
        motion = motion.predicted(DT, 0.0, 0.0)
    turned = Rotation.from_matrix(start.world_from_body.rotation) * Rotation.from_rotvec(3.0 * start.rate)
    np.testing.assert_allclose(motion.world_from_body.rotation, turned.as_matrix(), atol=1e-10)
    np.testing.assert_allclose(motion.world_from_body.translation,
                               start.world_from_body.translation + 3.0 * start.velocity, atol=1e-10)  # fmt: skip


def test_a_step_of_zero_changes_nothing():
    motion = some_motion(np.random.default_rng(2))
    same = motion.predicted(0.0, 3.0, 6.0)
    np.testing.assert_allclose(minus(same, motion), 0.0, atol=1e-15)
    np.testing.assert_allclose(same.P, motion.P, atol=1e-15)


@pytest.mark.parametrize("rate", [0.0, 0.5, 20.0])
@pytest.mark.parametrize("dt", [0.01, 0.2])
def test_the_covariance_is_propagated_by_the_numerical_jacobian_of_the_prediction(rate, dt):
    rng = np.random.default_rng(3)
    motion = some_motion(rng, rate)
    ahead = motion.predicted(dt, 0.0, 0.0)
    F = numeric_jacobian(lambda e: minus(plus(motion, e).predicted(dt, 0.0, 0.0), ahead), np.zeros(12), 1e-5)
    np.testing.assert_allclose(ahead.P, F @ motion.P @ F.T, atol=1e-9)


def test_process_noise_is_that_of_accelerations_constant_within_a_step():
    still = RigidMotion(Pose.identity(), np.zeros(3), np.zeros(3), np.zeros((12, 12)))
    P = still.predicted(DT, 2.0, 5.0).P
    for axis, a in ((0, 2.0), (3, 5.0)):
        assert P[axis, axis] == pytest.approx(a**2 * DT**4 / 4)
        assert P[axis, axis + 6] == pytest.approx(a**2 * DT**3 / 2)
        assert P[axis + 6, axis + 6] == pytest.approx(a**2 * DT**2)


def test_twist_times_a_pixel_jacobian_is_the_pixels_rate():
    """d(pose)/dt in error coordinates: after a short time dt the pose is `plus(twist dt)`."""
    motion = some_motion(np.random.default_rng(4))
    ahead = motion.predicted(1e-4, 0.0, 0.0)
    np.testing.assert_allclose(ahead.world_from_body.minus(motion.world_from_body) / 1e-4, motion.twist, atol=1e-7)


def test_a_measured_pose_without_noise_becomes_the_pose():
    rng = np.random.default_rng(5)
    motion = some_motion(rng)
    measured = motion.world_from_body.plus(rng.normal(0, 1e-3, 6))
    after, y, S = motion.updated_with_pose(measured, 1e-18 * np.eye(6))
    assert np.abs(after.world_from_body.minus(measured)).max() < 1e-7
    np.testing.assert_allclose(motion.world_from_body.plus(y).rotation, measured.rotation, atol=1e-12)
    np.testing.assert_allclose(S, motion.covariance, atol=1e-12)


def test_velocities_are_estimated_from_poses_alone():
    truth = RigidMotion(Pose.identity(), np.array([0.5, -0.2, 0.1]), np.array([0.3, 0.4, -0.5]), np.zeros((12, 12)))
    C = 1e-6 * np.eye(6)
    motion = RigidMotion.at_rest(truth.world_from_body, C)
    assert np.all(motion.twist == 0)
    for _ in range(100):
        truth = truth.predicted(DT, 0.0, 0.0)
        motion = motion.predicted(DT, 0.1, 0.1)
        motion, _, _ = motion.updated_with_pose(truth.world_from_body, C)
    np.testing.assert_allclose(motion.velocity, truth.velocity, atol=0.01)
    np.testing.assert_allclose(motion.rate, truth.rate, atol=0.01)


def test_the_covariance_is_correct_over_many_motions():
    """The expected NEES of the twelve states after 20 frames is 12; the mean of 80 motions scatters by 0.55."""
    rng = np.random.default_rng(6)
    nees = []
    sigma = np.array([2e-3] * 3 + [1e-3] * 3)
    for _ in range(80):
        truth = some_motion(rng, 1.0)
        motion = RigidMotion.at_rest(
            truth.world_from_body.plus(-sigma * rng.standard_normal(6)), np.diag(sigma**2), 1.0, 1.0
        )
        for _ in range(20):
            a = np.concatenate([3.0 * rng.standard_normal(3), 6.0 * rng.standard_normal(3)])
            moved = truth.world_from_body.plus(truth.twist * DT + a * DT**2 / 2)
            truth = RigidMotion(moved, truth.velocity + a[:3] * DT, truth.rate + a[3:] * DT, truth.P)
            motion = motion.predicted(DT, 3.0, 6.0)
            measured = truth.world_from_body.plus(-sigma * rng.standard_normal(6))
            motion, _, _ = motion.updated_with_pose(measured, np.diag(sigma**2))
        error = minus(truth, motion)
        nees.append(error @ np.linalg.solve(motion.P, error))
    assert np.mean(nees) == pytest.approx(12.0, abs=1.5)


def test_an_update_changes_only_the_observed_variances():
    """A measurement of x alone: all other variances stay exactly the same."""
    motion = RigidMotion.at_rest(Pose.identity(), 0.01 * np.eye(6))
    H = np.zeros((1, 6))
    H[0, 0] = 100.0  # px per m
    after, S = motion.updated(np.array([3.0]), H, np.array([[0.01]]))
    assert S[0, 0] == pytest.approx(100.0**2 * 0.01 + 0.01)
    assert after.P[0, 0] == pytest.approx(1 / (1 / 0.01 + 100.0**2 / 0.01))
    assert after.world_from_body.translation[0] == pytest.approx(0.03, rel=1e-3)
    np.testing.assert_array_equal(np.diagonal(after.P)[1:], np.diagonal(motion.P)[1:])


def test_rotation_matrices_stay_orthonormal_over_a_long_run():
    motion = some_motion(np.random.default_rng(7), 10.0)
    for _ in range(5000):
        motion = motion.predicted(DT, 1.0, 1.0)
    R = motion.world_from_body.rotation
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert rotations.angle(R) <= np.pi
