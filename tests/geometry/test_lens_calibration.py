"""Derivatives of the lens models by their coefficients, for calibrations, and the fisheye model against OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry import lens
from geometry.arrays import numeric_jacobian
from geometry.camera import FISHEYE, Camera, project_points, project_points_full
from geometry.pose import Pose

seeds = st.integers(0, 2**32 - 1)
WIDE = (0.02, -0.015, 0.006, -0.0011)


@settings(max_examples=50)
@given(seed=seeds, tilted=st.booleans())
def test_coefficient_derivatives_equal_finite_differences(seed, tilted):
    rng = np.random.default_rng(seed)
    coefficients = rng.normal(0, 0.05, 14)
    coefficients[12:] *= tilted
    xy = rng.uniform(-0.5, 0.5, (7, 2))
    expected = numeric_jacobian(lambda c: lens.distort(xy, c)[0], coefficients)
    np.testing.assert_allclose(lens.coefficient_jacobian(xy, coefficients), expected, atol=1e-8)


def test_coefficient_derivatives_broadcast_over_cameras_and_points():
    rng = np.random.default_rng(0)
    coefficients, xy = rng.normal(0, 0.02, (3, 1, 14)), rng.uniform(-0.4, 0.4, (3, 5, 2))
    together = lens.coefficient_jacobian(xy, coefficients)
    assert together.shape == (3, 5, 2, 14)
    for c in range(3):
        np.testing.assert_allclose(together[c], lens.coefficient_jacobian(xy[c], coefficients[c, 0]), atol=1e-14)


@settings(max_examples=50)
@given(seed=seeds)
def test_fisheye_pixels_equal_those_of_opencv(seed):
    rng = np.random.default_rng(seed)
    camera = Camera(
        "wide", "s", (1280, 1024), np.array([[410.0, 0, 641], [0, 405, 509], [0, 0, 1]]), WIDE, Pose.identity(),
        lens=FISHEYE,
    )  # fmt: skip
    points = np.column_stack([rng.uniform(-2, 2, (20, 2)), rng.uniform(0.5, 3, 20)])
    expected, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), camera.matrix, np.array(WIDE))
    np.testing.assert_allclose(camera.project(points), expected.reshape(-1, 2), atol=1e-9)
    origin, rays = camera.rays(camera.project(points))
    np.testing.assert_allclose(rays, points / np.linalg.norm(points, axis=1, keepdims=True), atol=1e-9)
    np.testing.assert_allclose(origin, 0, atol=1e-15)


def test_fisheye_derivatives_equal_finite_differences_also_on_the_axis():
    rng = np.random.default_rng(1)
    k = lens.padded(WIDE)
    xy = np.concatenate([[[0.0, 0.0], [1e-9, 0.0]], rng.uniform(-1.5, 1.5, (8, 2))])
    by_k = numeric_jacobian(lambda c: lens.distort(xy, c, True)[0], k)
    np.testing.assert_allclose(lens.coefficient_jacobian(xy, k, True), by_k, atol=1e-8)
    for one, J in zip(xy, lens.distort(xy, k, True)[1], strict=True):
        by_xy = numeric_jacobian(lambda q: lens.distort(q, k, True)[0], one)
        np.testing.assert_allclose(J, by_xy, atol=1e-7)


def test_a_fisheye_lens_projects_nothing_beyond_its_fold():
    limit = lens.fisheye_fold_limit((0.0, -0.3, 0.0, 0.0))
    theta = np.arctan(np.sqrt(limit))
    # theta (1 - 0.3 theta^4) is steepest where 1 = 1.5 theta^4
    assert theta == pytest.approx((1 / 1.5) ** 0.25, rel=1e-6)
    camera = Camera("w", "s", (100, 100), np.diag([50.0, 50, 1]), (0.0, -0.3, 0.0, 0.0), Pose.identity(), lens=FISHEYE)
    inside, beyond = np.tan(theta * np.array([0.98, 1.02]))
    assert np.isfinite(camera.project(np.array([inside, 0, 1.0]))).all()
    assert np.isnan(camera.project(np.array([beyond, 0, 1.0]))).all()


@pytest.mark.parametrize(("kind", "numbers"), [("fisheye", (0.1,) * 5), ("wide", ())])
def test_an_unknown_lens_or_a_wrong_number_of_coefficients_is_refused(kind, numbers):
    with pytest.raises(ValueError, match=r"lens|fisheye"):
        Camera("c", "s", (10, 10), np.eye(3), numbers, Pose.identity(), lens=kind)


def test_one_call_projects_perspective_and_fisheye_points():
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (6, 2)), np.ones(6)])
    pinhole = np.tile([400.0, 410, 320, 240], (6, 1))
    distortion = np.tile(lens.padded((0.1, -0.05, 0.001, 0.002)), (6, 1))
    distortion[3:] = lens.padded(WIDE)
    fisheye = np.arange(6) >= 3
    folds = np.full(6, np.inf)
    both = project_points_full(points, pinhole, distortion, folds, fisheye)
    for i in range(6):
        alone, J = project_points(points[i], pinhole[i], distortion[i], folds[i], fisheye[i])
        np.testing.assert_allclose(both.pixels[i], alone, atol=1e-12)
        np.testing.assert_allclose(both.d_point[i], J, atol=1e-9)
        by_pinhole = numeric_jacobian(
            lambda q, i=i: project_points(points[i], q, distortion[i], folds[i], fisheye[i])[0], pinhole[i], 1e-4
        )
        np.testing.assert_allclose(both.d_pinhole[i], by_pinhole, atol=1e-6)
        by_lens = numeric_jacobian(
            lambda q, i=i: project_points(points[i], pinhole[i], q, folds[i], fisheye[i])[0], distortion[i]
        )
        np.testing.assert_allclose(both.d_distortion[i][:, :12], by_lens[:, :12], atol=1e-5)


@settings(max_examples=50)
@given(seed=seeds, scale=st.sampled_from([0.1, 1.0, 3.0]))
def test_every_direction_inside_the_fold_of_a_fisheye_lens_is_found_again_and_no_pixel_beyond_it(seed, scale):
    rng = np.random.default_rng(seed)
    numbers = tuple((rng.normal(size=4) * scale * [0.1, 0.05, 0.02, 0.01]).tolist())
    fold = lens.fisheye_fold_limit(numbers)
    limit = np.arctan(np.sqrt(fold))
    angle, turn = rng.uniform(0.0, 0.9999 * limit, 50), rng.uniform(0.0, 2 * np.pi, 50)
    xy = np.tan(angle)[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    bent, _ = lens.distort(xy, lens.padded(numbers), True)
    back = lens.undistort(bent, lens.padded(numbers), fold, True)
    np.testing.assert_allclose(np.arctan(np.linalg.norm(back, axis=1)), angle, atol=1e-11)
    np.testing.assert_allclose(
        back / np.linalg.norm(back, axis=1, keepdims=True), xy / np.tan(angle)[:, None], atol=1e-9
    )
    largest = lens.distort(np.array([[np.tan(0.999999 * limit), 0.0]]), lens.padded(numbers), True)[0]
    assert np.isnan(lens.undistort(1.01 * largest, lens.padded(numbers), fold, True)).all()
