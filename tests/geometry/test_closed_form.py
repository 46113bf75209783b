"""Poses in closed form: exact on exact lines and spots, whatever the beams; nothing where nothing fits."""

from __future__ import annotations

import numpy as np
import pytest

from geometry import rotations
from geometry.arrays import normalised
from geometry.closed_form import pose_from_lines, poses_from_line_and_spot
from geometry.pose import Pose
from tests.geometry.scenes import random_pose

EXACT = 1e-9  # m and rad: rounding of numbers of some metres


def far_apart(pose: Pose, other: Pose) -> float:
    """Distance, m, and angle, rad, whichever is larger."""
    turn = rotations.angle(other.rotation.T @ pose.rotation)
    return max(float(np.linalg.norm(pose.translation - other.translation)), float(turn))


def lines_of(pose: Pose, points: np.ndarray, directions: np.ndarray, rng: np.random.Generator):
    """Beams as lines in world: any point on each, and direction vectors of any length."""
    slid = points + rng.uniform(-3, 3, (len(points), 1)) * directions
    return pose.apply(slid), pose.turn(directions) * rng.uniform(0.5, 4, (len(points), 1))


@pytest.mark.parametrize("beams", [2, 3, 5])
def test_beams_that_meet_nowhere_give_back_the_pose_that_drew_them(beams):
    rng = np.random.default_rng(beams)
    for _ in range(100):
        directions, points = rng.normal(size=(beams, 3)), rng.normal(0, 0.3, (beams, 3))
        pose = random_pose(rng, 2.0)
        found = pose_from_lines(points, directions, *lines_of(pose, points, directions, rng))
        assert found is not None
        assert far_apart(found, pose) < 1e-7  # two random beams may be a hundredth of a radian apart


def test_the_rotation_is_proper_where_the_lines_are_nearly_mirrored():
    """Directions of a plane fit a reflection as well; Kabsch's sign keeps it a rotation."""
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


def test_the_origin_is_where_the_sum_of_squared_distances_is_least():
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


def test_parallel_beams_and_a_single_beam_are_no_pose():
    x = np.array([[1.0, 0, 0]])
    along, points = np.repeat(x, 3, axis=0), np.array([[0.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert pose_from_lines(points, along, points, along) is None
    assert pose_from_lines(points, along * [[1], [-1], [1]], points, along * [[1], [-1], [1]]) is None
    assert pose_from_lines(points[:1], x, points[:1], x) is None
    # Noise makes the lines meet somewhere; the beams still say nothing of the turn about them.
    noisy = along + np.array([[0, 1e-3, 0], [0, 0, 1e-3], [0, 0, 0]])
    assert pose_from_lines(points, along, points, noisy) is None


def random_line_and_spot(rng: np.random.Generator):
    """A pose, a whole beam and a ray of another one, and where both are in world."""
    pose = random_pose(rng, 1.5)
    point, direction, other, ray = rng.normal(0, 0.3, (4, 3))
    direction, ray = normalised(direction), normalised(ray)
    line_point = pose.apply(point + rng.uniform(-2, 2) * direction)
    spot = pose.apply(other + rng.uniform(0.5, 4) * ray)
    return pose, (point, direction, line_point, pose.turn(direction) * rng.uniform(0.5, 2), other, ray, spot)


def test_one_of_the_two_poses_is_the_true_one_and_both_explain_what_was_seen():
    rng = np.random.default_rng(3)
    both = 0
    for _ in range(500):
        pose, seen = random_line_and_spot(rng)
        point, direction, line_point, line_direction, other, ray, spot = seen
        poses = poses_from_line_and_spot(*seen)
        real = [poses[i] for i in range(2) if np.isfinite(poses.rotation[i]).all()]
        both += len(real) == 2
        assert min(far_apart(p, pose) for p in real) < 1e-6  # the quadratic may have its roots close together
        for p in real:
            np.testing.assert_allclose(p.rotation @ p.rotation.T, np.eye(3), atol=EXACT)
            assert np.linalg.det(p.rotation) == pytest.approx(1.0)
            np.testing.assert_allclose(p.turn(direction), normalised(line_direction), atol=EXACT)
            on_line = p.apply(point) - line_point
            np.testing.assert_allclose(np.cross(on_line, normalised(line_direction)), 0.0, atol=1e-7)
            towards = spot - p.apply(other)
            np.testing.assert_allclose(np.cross(towards, p.turn(ray)), 0.0, atol=1e-7)
            assert towards @ p.turn(ray) > 0  # the ray points at the spot, not away from it
    assert both > 20  # mostly the second root lies behind the ray's start


def test_a_spot_that_the_ray_cannot_reach_gives_no_pose():
    """The ray runs parallel to the beam, 0.1 m beside it: a spot 0.5 m off the line is out of its reach."""
    x, z = np.array([1.0, 0, 0]), np.array([0.0, 0, 1])
    poses = poses_from_line_and_spot(0 * x, x, 0 * x, x, 0.1 * z, x, np.array([2.0, 0.5, 0]))
    assert np.isnan(poses.rotation).all()
    # Skew to it, it passes the axis at 0.3 m: nothing nearer than that either.
    y = np.array([0.0, 1, 0])
    assert np.isnan(
        poses_from_line_and_spot(0 * x, x, 0 * x, x, 0.3 * z - 5 * y, y, np.array([1, 0.2, 0])).rotation
    ).all()
    near = poses_from_line_and_spot(0 * x, x, 0 * x, x, 0.3 * z - 5 * y, y, np.array([1, 0.4, 0]))
    assert np.isfinite(near.rotation).all()


def test_a_spot_behind_the_ray_gives_no_pose():
    x, y = np.array([1.0, 0, 0]), np.array([0.0, 1, 0])
    assert np.isfinite(poses_from_line_and_spot(0 * x, x, 0 * x, x, y, y, 2 * y).rotation).any()
    # The ray starts 3 m from the axis and leads away from it: 2 m is behind its start.
    assert np.isnan(poses_from_line_and_spot(0 * x, x, 0 * x, x, 3 * y, y, 2 * y).rotation).all()


def test_all_lines_with_all_spots_in_one_call_are_each_by_itself():
    rng = np.random.default_rng(4)
    _, (point, direction, line_point, line_direction, other, ray, spot) = random_line_and_spot(rng)
    lines = line_point + rng.normal(0, 0.1, (4, 3))
    along = line_direction + rng.normal(0, 0.1, (4, 3))
    spots = spot + rng.normal(0, 0.3, (5, 3))
    many = poses_from_line_and_spot(point, direction, lines[:, None], along[:, None], other, ray, spots[None])
    assert many.rotation.shape == (4, 5, 2, 3, 3)
    for i in range(4):
        for j in range(5):
            one = poses_from_line_and_spot(point, direction, lines[i], along[i], other, ray, spots[j])
            np.testing.assert_allclose(many.rotation[i, j], one.rotation, atol=1e-12)
            np.testing.assert_allclose(many.translation[i, j], one.translation, atol=1e-12)
