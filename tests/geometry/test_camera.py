"""The camera: world points to pixels and back, and the limits of the picture."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geometry.arrays import numeric_jacobian
from geometry.camera import Camera, pinhole_numbers, project_points
from geometry.lens import padded
from geometry.pose import Pose
from tests.geometry.scenes import LENSES, random_pose

seeds = st.integers(0, 2**32 - 1)
K = np.array([[1180.0, 0, 650.25], [0, 1175.0, 500.5], [0, 0, 1]])


def camera(lens: tuple[float, ...] = (), camera_from_world: Pose | None = None) -> Camera:
    return Camera("left", "screen", (1280, 1024), K, lens, camera_from_world or Pose.identity())


@given(seed=seeds, n_numbers=st.sampled_from(list(LENSES)))
def test_world_points_project_to_the_pixels_of_opencv(seed, n_numbers):
    rng = np.random.default_rng(seed)
    c = camera(LENSES[n_numbers], random_pose(rng))
    depth = rng.uniform(0.5, 5, (20, 1))
    points = c.camera_from_world.inverse().apply(np.column_stack([rng.uniform(-0.5, 0.5, (20, 2)) * depth, depth]))
    rotvec = Rotation.from_matrix(c.camera_from_world.rotation).as_rotvec()
    numbers = np.array(c.distortion) if c.distortion else None
    expected, _ = cv2.projectPoints(points, rotvec, c.camera_from_world.translation, K, numbers)
    np.testing.assert_allclose(c.project(points), expected[:, 0], rtol=0, atol=1e-9)


@given(seed=seeds, n_numbers=st.sampled_from(list(LENSES)))
def test_points_on_the_ray_of_a_pixel_project_to_that_pixel(seed, n_numbers):
    rng = np.random.default_rng(seed)
    c = camera(LENSES[n_numbers], random_pose(rng))
    pixels = rng.uniform(-0.5, [1279.5, 1023.5], (4, 5, 2))
    origin, rays = c.rays(pixels)
    assert rays.shape == (4, 5, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, rtol=1e-14)
    points = origin + rng.uniform(0.1, 20, (4, 5, 1)) * rays
    np.testing.assert_allclose(c.project(points), pixels, rtol=0, atol=1e-8)


def test_rays_begin_at_the_cameras_centre():
    c = camera(LENSES[5], random_pose(np.random.default_rng(2)))
    origin, _ = c.rays(np.array([3.0, 4.0]))
    np.testing.assert_allclose(c.camera_from_world.apply(origin), 0, atol=1e-15)


def test_the_principal_point_is_straight_ahead_u_points_right_and_v_down():
    _, rays = camera(LENSES[4]).rays(np.array([[650.25, 500.5], [700, 500.5], [650.25, 600]]))
    np.testing.assert_allclose(rays[0], [0, 0, 1], atol=1e-12)
    assert rays[1, 0] > 0
    assert rays[2, 1] > 0


@pytest.mark.parametrize("lens", LENSES.values(), ids=str)
@pytest.mark.parametrize("z", [0.0, -1e-12, -2.0])
def test_a_point_beside_or_behind_the_camera_has_no_pixel(lens, z, recwarn):
    pixels = camera(lens).project(np.array([[0.0, 0.0, z], [0.1, 0.2, z], [0.1, 0.2, 2.0]]))
    assert np.isfinite(pixels).all(axis=-1).tolist() == [False, False, True]
    assert not recwarn.list


@pytest.mark.parametrize(
    ("u", "v", "seen"),
    [
        (-0.5, -0.5, True),
        (np.nextafter(-0.5, -1), 10.0, False),
        (10.0, np.nextafter(-0.5, -1), False),
        (np.nextafter(1279.5, 0), np.nextafter(1023.5, 0), True),
        (1279.5, 10.0, False),
        (10.0, 1023.5, False),
        (np.nan, 10.0, False),
        (np.inf, 10.0, False),
    ],
)
def test_the_picture_ends_half_a_pixel_beyond_the_centres_of_its_outer_pixels(u, v, seen):
    assert camera().sees(np.array([u, v])) == seen


def test_a_margin_widens_the_picture_on_every_side():
    pixels = np.array([[-3.5, 5.0], [5.0, -3.5], [1282.4, 5.0], [5.0, 1026.4], [-3.6, 5.0], [1282.5, 5.0]])
    assert camera().sees(pixels, margin_px=3.0).tolist() == [True, True, True, True, False, False]
    assert not camera().sees(pixels).any()


@settings(max_examples=30)
@given(seed=seeds)
def test_one_call_projects_points_of_several_cameras_with_the_jacobian_of_differences(seed):
    rng = np.random.default_rng(seed)
    cameras = [camera(lens) for lens in LENSES.values()]
    depth = rng.uniform(0.5, 5, (len(cameras), 1))
    points = np.column_stack([rng.uniform(-0.5, 0.5, (len(cameras), 2)) * depth, depth])
    pinholes = np.array([pinhole_numbers(c) for c in cameras])
    lenses = np.array([padded(c.distortion) for c in cameras])
    folds = np.array([c.fold_r2 for c in cameras])
    pixels, J = project_points(points, pinholes, lenses, folds, np.asarray(False))
    for i, c in enumerate(cameras):
        np.testing.assert_allclose(pixels[i], c.project(points[i]), rtol=0, atol=1e-10)
        differences = numeric_jacobian(c.project, points[i])
        np.testing.assert_allclose(J[i], differences, rtol=1e-6, atol=1e-3)  # px/m, of values of thousands


@pytest.mark.parametrize("n", [1, 2, 3, 6, 13, 15])
def test_a_wrong_number_of_distortion_coefficients_is_refused_with_the_name_of_the_camera(n):
    with pytest.raises(ValueError, match=f"camera 'left': {n} distortion numbers, OpenCV's models have 0, 4, 5"):
        camera((0.1,) * n)


@given(seed=seeds, n_numbers=st.sampled_from(list(LENSES)))
def test_what_a_camera_shows_moves_with_its_rotation_as_the_derivative_says(seed, n_numbers):
    rng = np.random.default_rng(seed)
    c = camera(LENSES[n_numbers], random_pose(rng))
    pixels = rng.uniform([300, 250], [1000, 750], (5, 2))
    origin, rays = c.rays(pixels)

    def seen(turn):
        pose = c.camera_from_world
        R = Rotation.from_rotvec(turn).as_matrix()
        turned = camera(c.distortion, Pose(R @ pose.rotation, R @ pose.translation))
        return turned.project(origin + 2.0 * rays).ravel()

    expected = numeric_jacobian(seen, np.zeros(3)).reshape(5, 2, 3)
    np.testing.assert_allclose(c.by_turns(pixels), expected, rtol=1e-5, atol=1e-3)
