"""Three rays through three points: all poses, including mirror solutions, and none where no pose exists."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry import rotations
from geometry.arrays import Array, normalised
from geometry.pose import Pose
from geometry.pose_solver.three_spots import poses_from_three_spots
from tests.geometry.pose_solver.line_and_spot import poses_from_line_and_spot

MANY = 2000
EXACT = 1e-6  # m, and m over a lever of 1 m

KINDS = ("any", "one point", "fan", "beam and spot", "crossed ends", "nearly one line", "two parallel")


def problems(kind: str, rng: np.random.Generator, count: int = MANY) -> tuple[Array, Array, Array, Pose]:
    """Rays in body, the points that they light, and the true poses."""
    points, rays = rng.normal(0, 0.3, (count, 3, 3)), normalised(rng.normal(size=(count, 3, 3)))
    if kind == "one point":
        points[:] = points[:, :1]
    if kind == "fan":
        angles = np.deg2rad([-20.0, 0.0, 203.0])
        points[:], rays[:] = 0.0, np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=-1)
    if kind in ("beam and spot", "crossed ends"):
        rays[:, 1] = -rays[:, 0]
    if kind == "beam and spot":
        points[:, 1] = points[:, 0]
    if kind == "nearly one line":
        rays[:, 1] = normalised(-rays[:, 0] + rng.normal(0, 2e-3, (count, 3)))
        points[:, 1] = points[:, 0] + rng.normal(0, 2e-3, (count, 3))
    if kind == "two parallel":
        rays[:, 1] = rays[:, 0]
    lit = points + rng.uniform(0.5, 4, (count, 3, 1)) * rays
    pose = Pose(rotations.exp(rng.normal(0, 1.5, (count, 3))), rng.normal(0, 1, (count, 3)))
    return points, rays, Pose(pose.rotation[:, None], pose.translation[:, None]).apply(lit), pose


def gaps(found: Pose, pose: Pose) -> Array:
    """Distance of each solution (m, 8) from the pose (m), m and rad; inf where there is no solution."""
    away = np.linalg.norm(found.translation - pose.translation[:, None], axis=-1)
    away = away + np.linalg.norm(found.rotation - pose.rotation[:, None], axis=(-1, -2))
    return np.where(np.isnan(away), np.inf, away)


@pytest.mark.parametrize("kind", KINDS)
def test_the_true_pose_is_among_the_solutions(kind):
    points, rays, world, pose = problems(kind, np.random.default_rng(1))
    found = poses_from_three_spots(points, rays, world)
    assert found.rotation.shape == (MANY, 8, 3, 3)
    assert gaps(found, pose).min(axis=1).max() < EXACT


@pytest.mark.parametrize("kind", KINDS)
def test_every_solution_is_a_rotation_that_puts_the_points_ahead_on_their_rays(kind):
    points, rays, world, _ = problems(kind, np.random.default_rng(2))
    found = poses_from_three_spots(points, rays, world)
    there = np.isfinite(found.translation[..., 0])
    problem, _ = np.nonzero(there)
    R, t = found.rotation[there], found.translation[there]
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
    assert np.all(np.linalg.det(R) > 0)
    body = (world[problem] - t[:, None]) @ R - points[problem]  # rows times R = R^T x
    along = np.sum(body * rays[problem], axis=-1)
    assert along.min() > 0
    np.testing.assert_allclose(body, along[..., None] * rays[problem], atol=1e-8)


def lengths_by_descent(points: Array, rays: Array, world: Array, rng: np.random.Generator) -> list[Array]:
    """All positive lengths that Gauss-Newton finds from many starts: a slow independent solution."""
    pairs = ((0, 1), (0, 2), (1, 2))
    aim = np.array([np.sum((world[i] - world[j]) ** 2) for i, j in pairs])
    lengths, misfit = rng.uniform(0, 8, (400, 3)), np.full(400, np.inf)
    moving = np.arange(400)
    for _ in range(80):
        q = points + lengths[moving, :, None] * rays
        F, J = np.empty((len(q), 3)), np.zeros((len(q), 3, 3))
        for row, (i, j) in enumerate(pairs):
            gap = q[:, i] - q[:, j]
            F[:, row] = np.sum(gap**2, axis=-1) - aim[row]
            J[:, row, i], J[:, row, j] = 2 * gap @ rays[i], -2 * gap @ rays[j]
        H = np.swapaxes(J, -1, -2) @ J + 1e-12 * np.eye(3)
        step = np.linalg.solve(H, np.swapaxes(J, -1, -2) @ F[..., None])[..., 0]
        size = np.linalg.norm(step, axis=-1, keepdims=True)
        lengths[moving] -= step * np.minimum(1.0, 1.0 / np.maximum(size, 1e-12))
        misfit[moving] = np.abs(F).max(axis=-1)
        moving = moving[size[:, 0] > 1e-13]  # the others have arrived
        if not len(moving):
            break
    good = (misfit < 1e-10) & (lengths > 1e-6).all(axis=-1)
    found: list[Array] = []
    for one in lengths[good]:
        if all(np.abs(one - other).max() > 1e-4 for other in found):
            found.append(one)
    return found


MOSTLY_ONE = "crossed ends"  # few of its problems have mirror solutions
SLOW = [pytest.param(kind, 200, marks=pytest.mark.slow) for kind in ("any", "one point", "fan", MOSTLY_ONE)]


@pytest.mark.parametrize(("kind", "count"), [("any", 20), ("one point", 20), ("fan", 20), (MOSTLY_ONE, 40), *SLOW])
def test_a_search_from_many_starts_finds_no_further_solution(kind, count):
    rng = np.random.default_rng(3)
    points, rays, world, _ = problems(kind, rng, count)
    found = poses_from_three_spots(points, rays, world)
    several = 0
    for k in range(count):
        slow = lengths_by_descent(points[k], rays[k], world[k], rng)
        assert np.isfinite(found.translation[k, :, 0]).sum() >= len(slow)
        several += len(slow) > 1
    assert several >= 3  # there are mirror solutions


@pytest.mark.parametrize(("angle_deg", "count"), [(30.0, 4), (50.0, 4), (70.0, 1)])
def test_an_equilateral_triangle_seen_along_its_axis_has_the_solutions_of_grunerts_problem(angle_deg, count):
    """Side 1, equal angles: lengths (a, a, a), and (a, a, 2 a cos - a) in three orders where that is positive."""
    corners = np.array([[np.cos(x), np.sin(x), 0.0] for x in np.deg2rad([90.0, 210.0, 330.0])]) / np.sqrt(3)
    a = 0.5 / np.sin(np.deg2rad(angle_deg / 2))
    top = np.array([0, 0, np.sqrt(a * a - 1 / 3)])
    rays = normalised(corners - top)
    found = poses_from_three_spots(np.zeros((3, 3)), rays, corners)
    there = np.isfinite(found.translation[:, 0])
    lengths = np.linalg.norm(corners - found.translation[there][:, None], axis=-1)
    other = a * (2 * np.cos(np.deg2rad(angle_deg)) - 1)
    expected = [[a, a, a]] + ([[a, a, other], [a, other, a], [other, a, a]] if count == 4 else [])
    assert len(lengths) == count
    np.testing.assert_allclose(sorted(lengths.round(6).tolist()), sorted(np.round(expected, 6).tolist()), atol=2e-6)


def test_a_beam_and_a_spot_have_the_solutions_of_their_own_closed_form():
    points, rays, world, _ = problems("beam and spot", np.random.default_rng(4), 300)
    found = poses_from_three_spots(points, rays, world)
    for k in range(300):
        two = poses_from_line_and_spot(
            points[k, 0], rays[k, 0], world[k, 1], world[k, 0] - world[k, 1], points[k, 2], rays[k, 2], world[k, 2]
        )
        for pose in (two[0], two[1]):
            if np.isfinite(pose.rotation).all():
                ahead = np.sum((pose.inverse().apply(world[k]) - points[k]) * rays[k], axis=-1) > 0
                near = gaps(found[k : k + 1], Pose(pose.rotation[None], pose.translation[None])).min() < EXACT
                assert near == ahead.all()


three = st.tuples(*[st.floats(-3, 3)] * 3)


@settings(max_examples=50, deadline=None)
@given(turn=three, shift=three, scale=st.floats(0.01, 100), seed=st.integers(0, 1000))
def test_the_solutions_move_with_the_world_and_grow_with_it(turn, shift, scale, seed):
    points, rays, world, _ = problems("any", np.random.default_rng(seed), 1)
    move = Pose(rotations.exp(np.array(turn)), np.array(shift))
    one = poses_from_three_spots(points[0], rays[0], world[0])
    other = poses_from_three_spots(scale * points[0], rays[0], scale * move.apply(world[0]))
    np.testing.assert_allclose(other.translation, scale * move.apply(one.translation), atol=1e-5 * scale)


def test_three_points_on_a_line_and_three_parallel_rays_give_no_pose():
    x, y, z = np.eye(3)
    rays = normalised(np.array([x + 0.2 * y, x, x - 0.3 * y]))
    line = np.array([2 * x + 0.4 * y, 2 * x, 2 * x - 0.6 * y])
    assert np.isnan(poses_from_three_spots(np.zeros((3, 3)), rays, line).rotation).all()
    points = np.array([0 * x, y, z])
    assert np.isnan(poses_from_three_spots(points, np.array([x, x, x]), points + x).rotation).all()
    assert np.isnan(poses_from_three_spots(points, np.array([x, -x, x]), points + np.array([x, -x, x])).rotation).all()


def test_points_out_of_reach_of_the_rays_give_no_pose():
    """Rays from one point, at most 1 rad apart, do not reach the corners of a triangle that contains the point."""
    rng = np.random.default_rng(5)
    points, rays, world, _ = problems("any", rng, 50)
    assert np.isnan(poses_from_three_spots(points, rays, np.repeat(world[:, :1], 3, axis=1)).rotation).all()
    nowhere = np.full((3, 3), np.nan)
    assert np.isnan(poses_from_three_spots(points[0], rays[0], nowhere).rotation).all()


def test_a_stack_of_problems_gives_the_same_as_each_alone():
    points, rays, world, _ = problems("any", np.random.default_rng(6), 12)
    many = poses_from_three_spots(points[0], rays[0], world.reshape(3, 4, 3, 3))
    assert many.translation.shape == (3, 4, 8, 3)
    for k in range(12):
        one = poses_from_three_spots(points[0], rays[0], world[k])
        np.testing.assert_array_equal(many.translation[k // 4, k % 4], one.translation)
