"""Calibration from grids of circles, whose centroids are not the images of the circles' centres."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from calibration.boards.board_types import CircleGrid, parse
from calibration.boards.circle_detection import fit_ellipses
from calibration.least_squares.adjustment import Vectors
from calibration.lens.fit.corner_table import CircleAreas, CornerTable
from calibration.lens.fit.lens_adjustment import with_circle_radius
from calibration.lens.fit.lens_models import LensModel
from calibration.lens.intrinsics import Intrinsics, IntrinsicsOptions, calibrate_intrinsics
from geometry.arrays import Array
from geometry.camera import FISHEYE, Camera
from geometry.pose import Pose
from geometry.rotations import exp
from lab.calibrate.camera.camera_page import findings_of
from lab.findings.finding import Level
from lab.simulate.board_photo import photograph
from tests.calibration.lens.rendered_circles import LENS, CircleScene, outlines, projected, shots, table_of

QUICK = IntrinsicsOptions(lens=LensModel(5), warp=False, stretch=False)
SCENE = CircleScene(parse("acircles:4x9:20mm"), views=8)
SYMMETRIC = CircleGrid(9, 7, 0.03, asymmetric=False)


@cache
def pictures() -> CornerTable:
    return table_of(SCENE, 3)


def nees(c: Intrinsics) -> float:
    truth = np.zeros(18)
    truth[: len(LENS)] = LENS
    off = (c.fit.lens - truth)[c.model.free]
    return float(off @ np.linalg.solve(c.covariance, off)) / len(off)


def test_centres_are_the_centroids_of_blobs_that_distortion_makes_unlike_ellipses():
    lens = (430.0, 431.0, 630.0, 520.0, 0.02, 0.003, -0.001, 0.0)
    scene = CircleScene(parse("circles:4x3:30mm"), lens, fisheye=True, views=1, noise_dn=0.0, fill=(0.5, 0.7))
    (shot,) = shots(scene, 1)
    ring = projected(scene, shot.rotation, shot.translation, outlines(scene, 500).reshape(-1, 3)).reshape(-1, 500, 2)
    centroids, areas = centroids_and_areas(ring)
    found = fit_ellipses(shot.image, shot.centres, shot.radii_px[:, None, None] * np.eye(2))
    assert np.sqrt(np.mean((found.centres - centroids) ** 2)) < 0.003  # px; of ellipses from tangents .024
    np.testing.assert_allclose(found.areas, areas, rtol=1e-3)


def centroids_and_areas(ring: Array) -> tuple[Array, Array]:
    """Of outlines (n, k, 2), px, by Green's theorem."""
    following = np.roll(ring, -1, axis=1)
    parts = ring[..., 0] * following[..., 1] - ring[..., 1] * following[..., 0]
    area = np.sum(parts, axis=1) / 2
    return np.sum((ring + following) * parts[..., None], axis=1) / (6 * area[:, None]), np.abs(area)


@pytest.mark.slow
def test_blur_does_not_displace_oblique_circles_under_a_wide_lens_towards_its_middle():
    board, K = SYMMETRIC, np.array([[447.0, 0, 640.0], [0, 447.0, 490.0], [0, 0, 1]])
    camera = Camera("", "", (1280, 960), K, (0.01, 0.003, 0.0, 0.0), Pose.identity(), lens=FISHEYE)
    turn = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    ring = board.diameter_m / 2 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    inward = []
    for turned, at in (((-0.266, 0.008, 0.425), (-0.134, -0.082, 0.125)), ((0.266, 0.0, 0.2), (0.12, 0.08, 0.125))):
        R = exp(np.array(turned))
        pose = Pose(R, np.array(at) - R @ board.middle)
        outline = camera.project(pose.apply((board.points[:, None] + ring).reshape(-1, 3))).reshape(-1, 200, 2)
        centroids, _ = centroids_and_areas(outline)
        away = outline - centroids[:, None]
        shapes = np.linalg.cholesky(2 * np.swapaxes(away, 1, 2) @ away / 200)
        found = fit_ellipses(photograph(board, camera, pose).image, centroids, shapes).centres
        to_middle = K[:2, 2] - centroids
        inward.append(np.sum((found - centroids) * to_middle, axis=1) / np.linalg.norm(to_middle, axis=1))
    # px, ± .00007 by the renderer; .0006 if the curvature of the outline is taken for that of an ellipse.
    assert abs(np.mean(inward)) < 0.0003


def test_lens_and_circle_size_are_estimated_within_their_sigmas():
    c = calibrate_intrinsics(pictures(), QUICK)
    assert nees(c) < 2.9  # of nine parameters: exceeded with probability 1/500
    assert 2 * c.fit.radius_m == pytest.approx(SCENE.board.diameter_m, rel=0.005)
    assert 0 < c.fit.radius_sigma_m < 0.006 * c.fit.radius_m
    assert c.fit.sigma_px < 0.01
    smaller = replace(c.table.circles, diameter_m=1.6 * c.fit.radius_m)
    found = {f.what.split(", ")[-1]: f.level for f in findings_of(replace(c, table=replace(c.table, circles=smaller)))}
    assert found[f"+25.0 % against the {1600 * c.fit.radius_m:.4g} mm stated."] is Level.WARN


def test_circles_treated_as_points_would_bias_the_lens_far_beyond_its_sigmas():
    c = calibrate_intrinsics(replace(pictures(), circles=None), QUICK)
    assert nees(c) > 3  # although scatter between photographs has inflated the sigmas


def test_an_unknown_circle_size_is_estimated():
    c = calibrate_intrinsics(replace(pictures(), circles=CircleAreas()), QUICK)
    assert nees(c) < 2.9
    assert abs(2 * c.fit.radius_m - SCENE.board.diameter_m) < 4 * 2 * c.fit.radius_sigma_m
    assert c.fit.radius_sigma_m > 0.005 * c.fit.radius_m  # less precise than with areas


@pytest.mark.parametrize(("before", "after"), [(0.0, None), (0.003, 0.003)])
def test_an_unknown_circle_size_is_searched_from_the_last_one_or_from_the_spacing(before, after):
    table = replace(pictures(), circles=CircleAreas(None, None))
    values = {"radius": Vectors(np.array([[before]]))}
    found, prior = with_circle_radius(table, np.ones(len(table), dtype=bool), LensModel(5), values)
    assert found["radius"].array[0, 0] == (after or table.spacing_m / 4)
    assert not prior


@pytest.mark.slow
def test_a_stated_size_that_the_pictures_contradict_is_reported_and_not_used():
    areas = pictures().circles
    assert areas is not None
    c = calibrate_intrinsics(replace(pictures(), circles=replace(areas, diameter_m=0.012)), QUICK)
    assert nees(c) < 2.9
    about = next(f for f in findings_of(c) if f.what.startswith("The circles have a diameter"))
    assert about.level is Level.WARN
    assert "against the 12 mm stated" in about.what


@pytest.mark.slow
def test_a_stated_size_is_used_if_areas_are_unknown():
    c = calibrate_intrinsics(replace(pictures(), circles=CircleAreas(None, SCENE.board.diameter_m)), QUICK)
    assert nees(c) < 2.9


@pytest.mark.slow
@pytest.mark.parametrize("text", ["acircles:4x11:20mm", "circles:9x7:25mm"])
def test_the_covariance_of_circle_calibrations_is_correct(text):
    found = [nees(calibrate_intrinsics(table_of(CircleScene(parse(text)), seed), QUICK)) for seed in range(50, 58)]
    assert 0.6 < np.mean(found) < 1.5  # 72 numbers: exceeded with probability 1/1000
