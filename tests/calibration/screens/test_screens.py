"""Single screens: frame, flatness, outliers, scans and targets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.screens import clouds
from calibration.screens.clouds import register
from calibration.screens.flatness import assess_flatness, fit_surface, frame_of_dots, frame_of_extent
from calibration.screens.network_start import resect
from calibration.screens.screens import (
    ScreenSetup,
    camera_sigmas,
    facing,
    moved_to_surface,
    pose_covariance,
    screen_of_dots,
)
from geometry.arrays import numeric_jacobian
from geometry.pose import Pose
from geometry.rotations import exp, log
from tests.calibration.screens.networks import lab, measured
from tests.marks import needs_open3d

SIGMA = 3e-4


def control_points(rng, n, bow=(0.0, 0.0, 0.0)):
    """Points of a 4 m x 3 m screen, in a slightly tilted frame, and the sigma of each."""
    x, y = rng.uniform(-2, 2, n), rng.uniform(-1.5, 1.5, n)
    z = 0.002 + 0.01 * x - 0.02 * y + bow[0] * x * x + bow[1] * x * y + bow[2] * y * y
    return np.column_stack([x, y, z + SIGMA * rng.normal(size=n)]), np.full(n, SIGMA)


def test_a_flat_screen_is_rarely_bent_and_its_covariance_is_correct():
    bent, squares = 0, []
    for seed in range(150):
        flatness = assess_flatness(*control_points(np.random.default_rng(seed), 12))
        bent += flatness.chosen.bent
        e = flatness.chosen.coefficients[:3] - [0.002, 0.01, -0.02]
        squares.append(e @ np.linalg.solve(flatness.chosen.covariance[:3, :3], e) / 3)
    assert bent <= 6  # one in a hundred is expected
    assert abs(np.mean(squares) - 1) < 4 * np.sqrt(2 / 3 / 150)


def test_a_bow_of_four_millimetres_is_estimated_within_its_sigma():
    found = [assess_flatness(*control_points(np.random.default_rng(s), 12, (1e-3, 0, 0))).chosen for s in range(40)]
    assert np.mean([f.bent for f in found]) > 0.9
    off = [(f.coefficients[3] - 1e-3) / np.sqrt(f.covariance[3, 3]) for f in found if f.bent]
    assert np.sqrt(np.mean(np.square(off))) < 1.5


def test_the_scatter_of_a_rough_screen_is_estimated():
    rng = np.random.default_rng(1)
    xyz, sigma = control_points(rng, 60)
    xyz[:, 2] += 2e-3 * rng.normal(size=60)
    chosen = assess_flatness(xyz, sigma).chosen
    assert chosen.scatter_m == pytest.approx(2e-3, rel=0.3)
    assert chosen.used.all()


@pytest.mark.parametrize("n", [6, 9, 14])
def test_a_dot_thirty_millimetres_off_is_excluded(n):
    right = 0
    for seed in range(30):
        xyz, sigma = control_points(np.random.default_rng(seed), n)
        xyz[2, 2] += 0.03
        right += np.array_equal(np.flatnonzero(~assess_flatness(xyz, sigma).chosen.used), [2])
    assert right >= 26


def test_three_collinear_dots_determine_no_plane():
    with pytest.raises(ValueError, match="do not determine a plane"):
        fit_surface(np.array([[0.0, 0, 0], [1, 1, 0], [2, 2, 0]]), np.full(3, SIGMA), bent=False)


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6))
def test_a_frame_is_in_the_plane_faces_the_camera_and_has_its_origin_at_the_centre(seed):
    rng = np.random.default_rng(seed)
    world_from_screen = Pose(exp(rng.normal(size=3)), rng.normal(size=3))
    flat = np.column_stack([rng.uniform(-2, 2, (9, 2)), np.zeros(9)])
    eye = world_from_screen.apply(np.array([0.3, 0.2, rng.choice([-3.0, 3.0])]))
    frame = frame_of_extent(world_from_screen.apply(flat), eye)
    seen = frame.inverse().apply(world_from_screen.apply(flat))
    np.testing.assert_allclose(seen[:, 2], 0, atol=1e-12)
    np.testing.assert_allclose(seen[:, :2].min(axis=0), -seen[:, :2].max(axis=0), atol=1e-12)
    assert frame.inverse().apply(eye)[2] > 0
    assert np.linalg.det(frame.rotation) == pytest.approx(1)


def test_named_dots_define_the_frame():
    world_from_screen = Pose(exp(np.array([0.3, -0.2, 0.5])), np.array([1.0, 2, 3]))
    flat = np.array([[0.4, -0.3, 0], [2.4, -0.3, 0], [0.5, 0.7, 0], [2.4, 0.7, 0]])
    p = world_from_screen.apply(flat)
    frame = frame_of_dots(p, p[0], p[1], p[2], np.array([0.4, -0.3]))
    np.testing.assert_allclose(frame.rotation, world_from_screen.rotation, atol=1e-12)
    np.testing.assert_allclose(frame.translation, world_from_screen.translation, atol=1e-12)
    with pytest.raises(ValueError, match="one line"):
        frame_of_dots(p, p[0], p[1], p[0] + 0.5 * (p[1] - p[0]), np.zeros(2))


def test_the_covariance_of_a_frame_is_that_of_its_surface():
    surface = assess_flatness(*control_points(np.random.default_rng(5), 30, (2e-3, 0, 0)), bow="always").chosen
    frame = Pose(exp(np.array([0.3, -0.2, 0.5])), np.array([1.0, 2, 3]))

    def error(delta):
        """Error of the frame of a surface whose coefficients change by a small delta."""
        h, p, q = delta[:3]
        return np.concatenate([frame.rotation[:, 2] * h, [q, -p, 0.0], delta[3:]])

    J = numeric_jacobian(error, np.zeros(6))
    expected = J @ surface.covariance @ J.T
    got = pose_covariance(frame, surface)
    np.testing.assert_allclose(got, expected, atol=2e-12)  # the gauge has sigmas of a micrometre and a microradian
    # moved_to_surface moves a frame in the same way.
    moved = moved_to_surface(frame, surface)
    np.testing.assert_allclose(moved.minus(frame)[:6], error(surface.coefficients)[:6], atol=1e-12)
    lifted = frame.apply(np.array([0.0, 0.0, surface.coefficients[0]]))
    np.testing.assert_allclose(moved.translation, lifted)


def test_a_frame_moved_to_its_surface_has_no_remaining_slope():
    rng = np.random.default_rng(2)
    xyz, sigma = control_points(rng, 200)
    frame = moved_to_surface(Pose.identity(), assess_flatness(xyz, sigma).chosen)
    again = assess_flatness(frame.inverse().apply(xyz), sigma).chosen
    np.testing.assert_allclose(again.coefficients[:3], 0, atol=2e-5)  # of second order in a slope of 0.02


@pytest.mark.parametrize(("count", "words"), [(2, "2 surveyed dots, expected 3 or more"), (12, "are collinear")])
def test_dots_that_determine_no_plane_raise(count, words):
    t = np.linspace(-1, 1, count)
    line = np.stack([np.full(count, -2.5), t, 0.2 * t], axis=1)
    plain = measured(0)
    control_points = replace(
        plain.control_points,
        xyz=line,
        covariance=plain.control_points.covariance[:count],
        screen_of=np.zeros(count, dtype=int),
    )
    with pytest.raises(ValueError, match=words):
        screen_of_dots(replace(plain, control_points=control_points), np.arange(count), ScreenSetup(), None, "left")


def test_resection_tolerates_a_third_of_wrong_names():
    network, rig = measured(4), lab()
    mine = network.point_observations.camera_of == 0
    points, pixels = (
        network.control_points.xyz[network.point_observations.point_of[mine]],
        network.point_observations.pixels[mine],
    )
    mixed = pixels[[1, 2, 0, 4, 3, *range(5, 12)]]
    found = resect(rig.cameras["left"], points, mixed, 8.0)[0]
    np.testing.assert_array_equal(np.flatnonzero(~found.inliers), range(5))
    offset = found.camera_from_world.inverse().translation - rig.cameras["left"].camera_from_world.inverse().translation
    assert np.linalg.norm(offset) < 0.05


def test_a_small_plane_at_a_distance_allows_two_poses():
    rig = lab()
    points = np.array([[-2.5, y, z] for y in (-0.1, 0.1) for z in (-0.1, 0.1)])
    found = resect(rig.cameras["left"], points, rig.cameras["left"].project(points) + 0.2, 8.0)
    assert len(found) == 2


# Scans ------------------------------------------------------------------------------------------------------------


def scan_points(seed=0, bow=0.0, sigma=1e-3, n=12_000):
    """The true pose of a 4 m x 3 m screen before a wall, and a point cloud with clutter."""
    rng = np.random.default_rng(seed)
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    pose = Pose(turn @ exp(0.05 * rng.normal(size=3)), np.array([-2.5, 0.1, 0.2]))
    x, y = rng.uniform(-2, 2, n), rng.uniform(-1.5, 1.5, n)
    screen = np.column_stack([x, y, bow * x * x + sigma * rng.normal(size=n)])
    wall = np.column_stack(
        [rng.uniform(-4, 4, 2 * n), rng.uniform(-1.5, 2.5, 2 * n), -0.4 + sigma * rng.normal(size=2 * n)]
    )
    clutter = rng.uniform([-1, -1, 0.1], [1, 1, 1.0], (400, 3))
    return pose, pose.apply(np.concatenate([screen, wall, clutter]))


@needs_open3d
@pytest.mark.parametrize("bow", [0.0, 1e-3])
def test_a_scanned_screen_before_a_larger_wall_is_found_by_its_size(bow):
    pose, points = scan_points(1, bow)
    scan = facing(clouds.scan_of(points, (4.0, 3.0)), np.zeros(3))
    found, n = scan.world_from_screen, pose.rotation[:, 2]
    assert np.arccos(np.clip(found.rotation[:, 2] @ n, -1, 1)) < 2e-4
    assert abs((found.translation - pose.translation) @ n) < 3e-4
    assert scan.flatness.chosen.bent == (bow > 0)
    assert scan.flatness.chosen.coefficients[3] == pytest.approx(bow, abs=1e-4)
    np.testing.assert_allclose(scan.size_m, (4, 3), rtol=0.04)
    assert 1e-4 < np.sqrt(scan.covariance[0, 0]) < 1e-3  # errors common to the whole scan do not average out


@needs_open3d
def test_without_a_size_the_largest_plane_is_used_and_a_size_that_fits_none_raises():
    pose, points = scan_points(2)
    scan = clouds.scan_of(points)
    assert (scan.world_from_screen.translation - pose.translation) @ pose.rotation[:, 2] == pytest.approx(
        -0.4, abs=0.01
    )
    with pytest.raises(ValueError, match=r"no plane of 9 m x 2 m was found; those in the cloud: "):
        clouds.scan_of(points, (9.0, 2.0))


def test_a_cloud_of_few_points_raises():
    with pytest.raises(ValueError, match="50 points, expected 200"):
        clouds.scan_of(np.zeros((50, 3)))


@needs_open3d
def test_a_scan_turned_to_face_the_camera_is_the_same_surface():
    pose, points = scan_points(3, 1e-3)
    scan = facing(clouds.scan_of(points, (4.0, 3.0)), np.zeros(3))
    other = facing(scan, pose.translation - 3 * pose.rotation[:, 2])
    assert other.world_from_screen.rotation[:, 2] @ pose.rotation[:, 2] < -0.99
    world = [s.world_from_screen.apply(s.xyz) for s in (scan, other)]
    np.testing.assert_allclose(world[0], world[1], atol=1e-12)
    for s in (scan, other):
        a, b, c = s.flatness.chosen.coefficients[3:]
        x, y, z = s.xyz.T
        left = z - (a * x * x + b * x * y + c * y * y)
        np.testing.assert_allclose(
            left - left.mean(), s.flatness.chosen.heights_m - s.flatness.chosen.heights_m.mean(), atol=2e-4
        )
    assert facing(other, np.zeros(3)).world_from_screen.rotation == pytest.approx(scan.world_from_screen.rotation)


def targets(seed=0, n=6):
    rng = np.random.default_rng(seed)
    pose = Pose(exp(rng.normal(size=3)), 3 * rng.normal(size=3))
    world = rng.uniform(-3, 3, (n, 3))
    return pose, world, pose.inverse().apply(world), [f"T{i}" for i in range(n)]


def test_the_covariance_of_a_registration_is_correct():
    squares = []
    for seed in range(60):
        pose, world, cloud, names = targets(seed)
        rng = np.random.default_rng(1000 + seed)
        C = np.tile(np.eye(3) * 1e-6, (6, 1, 1))
        found = register(names, cloud + 2e-3 * rng.normal(size=(6, 3)), world + 1e-3 * rng.normal(size=(6, 3)), C, 2e-3)
        e = found.world_from_cloud.minus(pose)
        squares.append(e @ np.linalg.solve(found.covariance, e) / 6)
    assert 0.7 < np.mean(squares) < 1.2  # scaling by the residuals makes it slightly conservative


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda c: c[:2], "2 targets are in both"),
        (lambda c: c * 1000, "millimetres"),
        (lambda c: c[:, [1, 0, 2]], "mirror images"),
        (lambda c: c + np.eye(6, 3) * [0.3, 0, 0], "target 'T0' does not fit the others"),
        (lambda c: np.outer(np.arange(6.0), [1, 2, 3]), "one line"),
    ],
)
def test_invalid_targets_raise(spoil, words):
    _, world, cloud, names = targets()
    spoilt = spoil(cloud)
    n = len(spoilt)
    with pytest.raises(ValueError, match=words):
        register(names[:n], spoilt, world[:n], np.tile(np.eye(3) * 1e-6, (n, 1, 1)), 1e-3)


def test_the_sigmas_of_a_camera_are_the_scatter_of_its_place_and_attitude_wherever_the_worlds_origin_is():
    camera = next(iter(lab().cameras.values()))
    rng = np.random.default_rng(28)
    root = rng.normal(size=(6, 6)) * 1e-3
    for shift in (np.zeros(3), np.array([20.0, -30.0, 5.0])):
        moved = replace(camera, camera_from_world=camera.camera_from_world @ Pose(np.eye(3), -shift))
        drawn = moved.camera_from_world.plus(rng.normal(size=(4000, 6)) @ root.T)
        place, turn = camera_sigmas(moved, root @ root.T)
        centre = moved.camera_from_world.inverse().translation
        off, angle = drawn.inverse().translation - centre, moved.camera_from_world.inverse() @ drawn
        assert place == pytest.approx(np.sqrt(np.mean(off**2)), rel=0.05)
        assert turn == pytest.approx(np.sqrt(np.mean(log(angle.rotation) ** 2)), rel=0.05)
