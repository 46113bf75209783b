"""Triangulation, Horn's pose and the joint fit agree with independent ways to the same numbers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geometry.arrays import numeric_jacobian
from geometry.rotations import ypr_from_matrix
from geometry.uncertainty.rig_uncertainty import RigCovariance
from studies.zhou2020 import PRINTED_ROTATION, pose_errors
from tests.tracking.binocular.scenes import MODEL, NOISE_PX, PAIR, pose_at
from tracking.binocular.joint_fit import (
    MarkerObservations,
    fit_pose,
    linear_points,
    pose_of_points,
    quaternion_matrix,
    triangulate,
    undistorted_pixels,
)
from tracking.binocular.marker_model import StereoPair, calibration_jacobian, project, project_markers

COV = np.broadcast_to(NOISE_PX**2 * np.eye(2), (2, len(MODEL), 2, 2))


def test_horns_quaternion_is_the_rotation_of_scipys_alignment():
    rng = np.random.default_rng(1)
    for _ in range(20):
        body = rng.normal(size=(5, 3))
        pose = pose_at(10, int(rng.integers(1000)))
        seen = pose.apply(body) + rng.normal(0, 0.05, body.shape)
        expected = Rotation.align_vectors(seen - seen.mean(axis=0), body - body.mean(axis=0))[0].as_matrix()
        np.testing.assert_allclose(pose_of_points(body, seen).rotation, expected, atol=1e-12)


def test_the_quaternion_form_is_the_sum_of_products_of_equation_14():
    rng = np.random.default_rng(2)
    body, seen, q = rng.normal(size=(4, 3)), rng.normal(size=(4, 3)), rng.normal(size=4)
    q /= np.linalg.norm(q)
    R = Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix()
    assert q @ quaternion_matrix(body, seen) @ q == pytest.approx(np.sum(seen * (body @ R.T)), abs=1e-12)


def test_three_points_suffice_for_horns_pose():
    pose = pose_at(8, 3)
    found = pose_of_points(MODEL.positions[:3], pose.apply(MODEL.positions[:3]))
    np.testing.assert_allclose(found.minus(pose), 0, atol=1e-12)


def test_both_triangulations_are_exact_without_noise():
    points = pose_at(12, 4).apply(MODEL.positions)
    uv = project(PAIR, points)[0]
    flat = np.stack([undistorted_pixels(c, u) for c, u in zip(PAIR.cameras, uv, strict=True)])
    np.testing.assert_allclose(linear_points(PAIR, flat), points, atol=1e-8)
    np.testing.assert_allclose(triangulate(PAIR, uv, COV).points, points, atol=1e-8)


def test_the_covariance_of_a_triangulated_point_is_its_scatter():
    rng = np.random.default_rng(5)
    points = np.repeat(pose_at(10, 5).apply(MODEL.positions[:1]), 2000, axis=0)
    cov = np.broadcast_to(NOISE_PX**2 * np.eye(2), (2, 2000, 2, 2))
    found = triangulate(PAIR, project(PAIR, points)[0] + rng.normal(0, NOISE_PX, (2, 2000, 2)), cov)
    apart = found.points - points
    nees = np.einsum("ni,nij,nj->n", apart, np.linalg.inv(found.covariance), apart)
    assert nees.mean() == pytest.approx(3, abs=0.25)  # sigma of the mean: 0.055
    assert found.chi2.mean() == pytest.approx(1, abs=0.15)  # sigma of the mean: 0.03


def test_points_behind_the_cameras_are_nan():
    uv = project(PAIR, np.array([[0.2, 0.0, 8.0]]))[0]
    crossed = np.stack([uv[1] - [60, 0], uv[0] + [60, 0]])  # rays that diverge
    found = triangulate(PAIR, crossed, COV[:, :1])
    assert not found.points[0, 2] > 0


def test_the_jacobians_are_those_of_differences():
    pose, points_only = pose_at(9, 6), replace(MODEL, radius_m=np.full(len(MODEL), np.nan))
    J = project_markers(PAIR, points_only, pose)[1]
    numeric = numeric_jacobian(lambda d: project_markers(PAIR, points_only, pose.plus(d))[0], np.zeros(6))
    np.testing.assert_allclose(J, numeric, atol=2e-4)
    names = ("cameras.left.fx", "cameras.right.k1", "cameras.right.x_m", "cameras.right.rot_y_rad")
    pair = StereoPair(PAIR.cameras, RigCovariance(names, np.eye(4)))
    points = pose.apply(MODEL.positions)

    def moved(d):
        left, right = PAIR.cameras
        K = left.matrix + np.diag([d[0], 0, 0])
        distortion = (right.distortion[0] + d[1], *right.distortion[1:])
        place = right.camera_from_world.plus(np.array([d[2], 0, 0, 0, d[3], 0]))
        cameras = (replace(left, matrix=K), replace(right, distortion=distortion, camera_from_world=place))
        return project(StereoPair(cameras), points)[0]

    np.testing.assert_allclose(calibration_jacobian(pair, points), numeric_jacobian(moved, np.zeros(4)), atol=2e-3)


def test_the_image_of_a_tilted_disc_is_predicted_at_its_centroid_not_at_its_centre():
    pose = pose_at(3, 1).plus(np.array([0, 0, 0, 0.5, -0.4, 0]))
    centred = MODEL.positions - MODEL.positions.mean(axis=0)
    across = np.linalg.svd(centred)[2][:2]
    rho, angle = np.meshgrid(0.03 * np.sqrt((np.arange(100) + 0.5) / 100), 2 * np.pi * np.arange(60) / 60)
    disc = np.stack([rho * np.cos(angle), rho * np.sin(angle)], axis=-1).reshape(-1, 2) @ across
    for k in range(len(MODEL)):
        points = pose.apply(MODEL.positions[k] + disc)
        for c, camera in enumerate(PAIR.cameras):
            weight = camera.camera_from_world.apply(points)[:, 2] ** -3  # of equal areas of the disc in the picture
            centroid = weight @ camera.project(points) / weight.sum()
            predicted = project_markers(PAIR, MODEL, pose)[0][c, k]
            centre = camera.project(pose.apply(MODEL.positions[k]))
            assert np.linalg.norm(centroid - centre) > 0.02
            np.testing.assert_allclose(predicted, centroid, atol=0.002)


def test_the_joint_fit_beats_horns_pose_and_states_its_errors():
    e = pose_errors(16, NOISE_PX, np.random.default_rng(7))
    turn = [np.sqrt((d[:, 3:] ** 2).sum(axis=1).mean()) for d in (e.joint, e.horn)]
    assert turn[0] < 0.3 * turn[1]
    assert 0.6 < e.nees.mean() / 6 < 1.5  # sigma of the mean: 0.14; the slow test has 1500 poses


@pytest.mark.slow
def test_the_joint_fit_reaches_the_bound_with_seven_markers_at_10_m():
    e = pose_errors(1500, NOISE_PX, np.random.default_rng(8))
    assert max(e.ratios()) < 1.05
    assert 0.9 < e.nees.mean() / 6 < 1.1


def test_a_calibration_error_within_its_covariance_is_within_the_covariance_of_the_pose():
    names = tuple(f"cameras.right.{p}" for p in ("x_m", "y_m", "z_m", "rot_x_rad", "rot_y_rad", "rot_z_rad"))
    sigma = np.array([1e-4] * 3 + [2e-4] * 3)
    rng, nees = np.random.default_rng(9), []
    for i in range(25):
        pose = pose_at(10, i)
        left, right = PAIR.cameras
        wrong = replace(right, camera_from_world=right.camera_from_world.plus(sigma * rng.normal(size=6)))
        uv = project_markers(PAIR, MODEL, pose)[0] + rng.normal(0, NOISE_PX, (2, len(MODEL), 2))
        pair = StereoPair((left, wrong), RigCovariance(names, np.diag(sigma**2)))
        fit = fit_pose(pair, MODEL, MarkerObservations(uv, COV), pose)
        delta = pose.minus(fit.world_from_body)
        nees.append(delta @ np.linalg.solve(fit.covariance, delta))
        assert np.linalg.eigvalsh(fit.covariance - fit.systematic)[0] > 0
    assert 0.65 < np.mean(nees) / 6 < 1.4  # sigma of the mean: 0.12; without the calibration's part: 16


def test_the_printed_rotation_is_a_rotation_with_the_corrected_entry():
    assert abs(np.linalg.det(PRINTED_ROTATION) - 1) < 0.01
    assert np.abs(PRINTED_ROTATION @ PRINTED_ROTATION.T - np.eye(3)).max() < 0.01
    # The printed yaw is an arc tangent without the quadrant: 165.8 deg, not -14.2.
    assert np.rad2deg(ypr_from_matrix(PRINTED_ROTATION))[2] == pytest.approx(180 - 14.2, abs=0.5)
