"""Scans of a screen and what stands around it: outliers leave, two scans meet, and one plane alone is refused."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.screens import clouds
from calibration.screens.clouds import align, on_surfaces
from geometry.pose import Pose
from geometry.rotations import exp
from tests.marks import needs_open3d

pytestmark = needs_open3d


def room(seed, n=6000, sigma=1e-3):
    """A screen of 3 m x 2 m, the floor and a side wall: points (n, 3), m, with noise along the normals."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-1.5, 1.5, n), rng.uniform(0, 2, n)
    z = sigma * rng.normal(size=n)
    third = n // 3
    return np.concatenate(
        [
            np.column_stack([u, z, v]),
            np.column_stack([u, v - 2, z])[:third],
            np.column_stack([z - 1.5, v - 2, u + 1.5])[:third],
        ]
    )


@pytest.mark.parametrize("seed", range(4))
def test_two_scans_of_a_room_are_aligned_within_the_noise(seed):
    rng = np.random.default_rng(100 + seed)
    far = np.array([20.0, -30.0, 5.0])  # coordinates far from the origin, as of a survey
    true = Pose(exp(0.02 * rng.normal(size=3)), 0.03 * rng.normal(size=3))
    fixed, moving = room(2 * seed), true.inverse().apply(room(2 * seed + 1))
    found = align(moving + far, fixed + far)
    error = found.fixed_from_moving.apply(moving + far) - far - true.apply(moving)
    assert np.linalg.norm(error, axis=1).max() < 1e-3  # the noise of one point
    assert 1.2e-3 < found.sigma_m < 2.2e-3  # both scans' noise, and that of the normals from neighbours
    assert found.overlap > 0.95


def test_an_alignment_is_the_same_each_time():
    first, second = (align(room(1) + np.array([0.02, 0.01, 0]), room(0)).fixed_from_moving for _ in range(2))
    np.testing.assert_array_equal(first.rotation, second.rotation)
    np.testing.assert_array_equal(first.translation, second.translation)


def test_a_single_plane_does_not_determine_an_alignment():
    plane = room(0)[:6000]
    with pytest.raises(ValueError, match="does not determine the alignment"):
        align(room(1)[:6000] + np.array([0.02, 0, 0.01]), plane)


def test_scans_of_different_places_are_refused():
    with pytest.raises(ValueError, match=r"0 % of its points are near the first scan"):
        align(room(1) + np.array([50.0, 0, 0]), room(0))


def test_points_off_all_surfaces_are_removed_and_those_on_them_stay():
    rng = np.random.default_rng(5)
    points = room(0)
    dust = rng.uniform([-1.2, -1.8, 0.3], [1.2, -0.3, 1.8], (60, 3))
    kept = on_surfaces(np.concatenate([points, dust]))
    assert kept[: len(points)].mean() > 0.98
    assert kept[len(points) :].mean() < 0.1


def test_errors_of_the_registration_move_the_screens_plane_as_the_covariance_says():
    """Along its normal and about its own x and y; within the plane the frame is defined by the extent of the scan."""
    rng = np.random.default_rng(4)
    to_world, cloud_from_screen = (Pose.from_ypr(rng.normal(0, 1, 3), rng.normal(0, 3, 3)) for _ in range(2))
    frame, step = to_world @ cloud_from_screen, 1e-6
    J = np.stack([(to_world.plus(step * e) @ cloud_from_screen).minus(frame) / step for e in np.eye(6)], axis=-1)
    J[:3] = np.outer(frame.rotation[:, 2], frame.rotation[:, 2] @ J[:3])
    J[5] = 0.0
    A = 1e-3 * rng.normal(size=(6, 6))
    found = clouds._registration_covariance(to_world, frame, A @ A.T)
    np.testing.assert_allclose(found, J @ A @ A.T @ J.T, rtol=0, atol=1e-4 * np.max(found))
