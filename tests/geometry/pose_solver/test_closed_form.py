"""The pose in closed form from lines: exact for exact lines of any beams; None where the lines determine no pose."""

from __future__ import annotations

import numpy as np
import pytest

from geometry import rotations
from geometry.arrays import normalised
from geometry.pose import Pose
from geometry.pose_solver.closed_form import pose_from_lines
from tests.geometry.scenes import random_pose

EXACT = 1e-9  # m and rad: rounding of numbers of some metres


def far_apart(pose: Pose, other: Pose) -> float:
    """Distance, m, and angle, rad, whichever is larger."""
    turn = rotations.angle(other.rotation.T @ pose.rotation)
    return max(float(np.linalg.norm(pose.translation - other.translation)), float(turn))


def lines_of(pose: Pose, points: np.ndarray, directions: np.ndarray, rng: np.random.Generator):
    """The beams as lines in world: any point of each, and direction vectors of any length."""
    slid = points + rng.uniform(-3, 3, (len(points), 1)) * directions
    return pose.apply(slid), pose.turn(directions) * rng.uniform(0.5, 4, (len(points), 1))


@pytest.mark.parametrize("beams", [2, 3, 5])
def test_beams_that_do_not_meet_give_the_true_pose(beams):
    rng = np.random.default_rng(beams)
    for _ in range(100):
        directions, points = rng.normal(size=(beams, 3)), rng.normal(0, 0.3, (beams, 3))
        pose = random_pose(rng, 2.0)
        found = pose_from_lines(points, directions, *lines_of(pose, points, directions, rng))
        assert found is not None
        assert far_apart(found, pose) < 1e-7  # the angle between two random beams may be a hundredth of a radian


def test_the_rotation_is_proper_for_nearly_mirrored_lines():
    """Coplanar directions also fit a reflection; Kabsch's determinant makes it a rotation."""
    rng = np.random.default_rng(1)
    angles = np.deg2rad([-20.0, 0.0, 20.0])
    directions = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(3)])
    for _ in range(50):
        pose = random_pose(rng)
        world = pose.turn(directions) + rng.normal(0, 1e-3, (3, 3))
        found = pose_from_lines(np.zeros((3, 3)), directions, np.tile(pose.translation, (3, 1)), world)
        assert found is not None
        assert np.linalg.det(found.rotation) == pytest.approx(1.0)
        assert far_apart(found, pose) < 0.03


def test_the_origin_minimises_the_sum_of_squared_distances():
    rng = np.random.default_rng(2)
    directions = normalised(rng.normal(size=(4, 3)))
    points = rng.normal(size=(4, 3))
    found = pose_from_lines(np.zeros((4, 3)), directions, points, directions)
    assert found is not None

    def cost(at):
        gap = at - points
        return np.sum(gap**2) - np.sum(np.sum(gap * directions, axis=1) ** 2)

    here = cost(found.translation)
    for _ in range(100):
        assert cost(found.translation + rng.normal(0, 0.01, 3)) > here


def test_parallel_beams_and_a_single_beam_give_no_pose():
    x = np.array([[1.0, 0, 0]])
    along, points = np.repeat(x, 3, axis=0), np.array([[0.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert pose_from_lines(points, along, points, along) is None
    assert pose_from_lines(points, along * [[1], [-1], [1]], points, along * [[1], [-1], [1]]) is None
    assert pose_from_lines(points[:1], x, points[:1], x) is None
    # With noise the lines do meet somewhere, but the turn about parallel beams is still not determined.
    noisy = along + np.array([[0, 1e-3, 0], [0, 0, 1e-3], [0, 0, 0]])
    assert pose_from_lines(points, along, points, noisy) is None
