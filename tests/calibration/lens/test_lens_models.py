"""Model selection, lenses that fold, and the effect of lens errors over the picture."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibration.lens.fit.lens_fit import robust_fit
from calibration.lens.fit.lens_models import LENS_MODELS, LensModel, folds_in_picture, rational_of_fisheye
from calibration.lens.fit.lens_parameters import AS_STATED, values_of
from calibration.lens.fit.lens_start import board_poses, start
from calibration.lens.fit.model_selection import PLAUSIBLE
from calibration.lens.fit.projection_map import difference, projection_map
from calibration.lens.intrinsics import Intrinsics, IntrinsicsOptions, calibrate_intrinsics
from geometry.arrays import Array
from geometry.rotations import exp
from tests.calibration.lens.lens_scenes import SIZE, TRUTH, WIDE, Scene, photographs
from tests.calibration.lens.random_lenses import within_boards


def lens_of(numbers: tuple[float, ...]) -> Array:
    return np.array([*numbers, *[0.0] * (18 - len(numbers))])


def test_a_rich_model_that_the_photographs_leave_undetermined_is_not_chosen():
    """Five photographs in the middle of the picture: eight coefficients would leave the corners to chance."""
    table = photographs(Scene(views=5, distance_m=(0.8, 1.2)), 4)
    selection = calibrate_intrinsics(table).selection
    assert selection.chosen.model.coefficients <= 5
    rich = [c for c in selection.candidates if c.model.coefficients >= 8]
    assert all(c.refused or c.error_px > selection.chosen.error_px for c in rich)


def test_a_model_that_folds_in_the_picture_is_not_chosen():
    for seed in range(3):
        selection = calibrate_intrinsics(photographs(Scene(views=6), 30 + seed)).selection
        folding = [c for c in selection.candidates if c.fit and folds_in_picture(c.fit.lens, c.model.fisheye, SIZE)]
        assert selection.chosen not in folding
        assert all("folds" in c.refused for c in folding)


def test_boards_in_the_middle_of_the_picture_give_a_plausible_lens_and_its_focal_length():
    """Every model folds beyond the boards or leaves directions unknown; one without coefficients is improbable."""
    lens = (760.0, 761.0, 639.5, 511.5, 0.1, -0.25, 0.0, 0.0)
    near = Scene(lens, views=25, sigma_px=0.08, distance_m=(0.9, 1.4), at_most=0.15, columns=4, rows=3, square_m=0.054)
    z, unusable = [], 0
    for seed in range(100, 106):
        c = calibrate_intrinsics(photographs(near, seed))
        if all(k.refused for k in c.selection.candidates):
            unusable += 1
            assert c.selection.chosen.probability >= PLAUSIBLE
            assert c.model.coefficients > 0
        z.append((c.fit.lens[0] - lens[0]) / c.sigmas[0])
    assert unusable > 3
    assert np.max(np.abs(z)) < 3


def test_the_weak_prior_on_a_rational_lens_does_not_move_a_wide_one():
    """A lens of 140 deg, whose denominator is large at the picture's corners: fx was several sigmas too small."""
    true = rational_of_fisheye(lens_of((400.0, 401, 624, 511, 0.02, -0.005)), np.deg2rad(72))
    table = photographs(Scene(tuple(true[:12]), views=14, sigma_px=0.03, tilt_rad=0.6, distance_m=(0.1, 0.2)), 3)
    values = values_of(true, board_poses(table, true, False)[0], len(table.board_points))
    found = robust_fit(table, LensModel(8), values, AS_STATED)
    z = (found.lens - true)[:12] / np.sqrt(np.diagonal(found.covariance))
    assert np.max(np.abs(z)) < 3


def test_a_radial_mapping_that_decreases_before_the_corner_folds_in_the_picture():
    assert not folds_in_picture(lens_of(TRUTH), False, SIZE)
    assert folds_in_picture(lens_of((1000.0, 1000, 640, 512, -0.8)), False, SIZE)
    assert not folds_in_picture(lens_of(WIDE), True, SIZE)
    assert folds_in_picture(lens_of((500.0, 500, 640, 512, -0.3)), True, SIZE)


def test_only_the_coefficients_of_the_model_are_kept():
    everything = np.arange(1.0, 19.0)
    assert np.count_nonzero(LensModel(4).cut(everything)) == 8
    assert [int(m.free.sum()) for m in LENS_MODELS] == [4, 8, 9, 8, 12, 16]


def test_the_map_excludes_rotations_of_the_camera():
    """Near the centre of a long lens, a shift of the principal point has the effect of a rotation of the camera."""
    model, lens = LensModel(0), lens_of((20000.0, 20000, 640, 512))
    at = projection_map(model, lens, SIZE, 1.0)
    by_cx, by_fx = at.by_parameter[..., 2], at.by_parameter[..., 0]
    assert np.abs(by_cx).max() < 0.002  # of the 1 px that cx moves every pixel
    assert np.abs(by_fx).max() > 0.03  # a change of focal length is not a rotation
    # This rotation compensates for a shift of cx by 1 px.
    turn = exp(np.array([0.0, -1.0 / 20000, 0.0]))
    assert (turn @ [0, 0, 1])[0] * 20000 + 641 == pytest.approx(640, abs=1e-6)


def test_directions_where_corners_were_seen_are_as_uncertain_as_after_the_best_rotation_there():
    """Eight coefficients leave the corners of the picture open, and a rotation that fits there turns the middle."""
    true = rational_of_fisheye(lens_of((400.0, 401, 624, 511, 0.02, -0.005)), np.deg2rad(62))
    scene = Scene(tuple(true[:12]), views=8, sigma_px=0.03, tilt_rad=0.6, distance_m=(0.12, 0.25), at_most=0.2)
    for seed in range(2):
        c = calibrate_intrinsics(photographs(scene, seed), IntrinsicsOptions(lens=LensModel(8)))
        seen = within_boards(c, c.map.pixels.reshape(-1, 2)).reshape(c.map.pixels.shape[:2])
        rays = c.map.rays[seen]

        def pixels(turn: Array, rays: Array = rays, c: Intrinsics = c) -> Array:
            out = cv2.projectPoints(rays[:, None], turn, np.zeros(3), c.matrix, np.array(c.distortion))[0]
            return np.asarray(out).ravel()

        by_turn = np.stack([(pixels(d) - pixels(-d)) / 2e-5 for d in 1e-5 * np.eye(3)], axis=1)
        rows = c.map.by_parameter[seen].reshape(len(by_turn), -1)
        aligned = rows - by_turn @ np.linalg.lstsq(by_turn, rows, rcond=None)[0]
        stated, least = (np.sqrt(np.trace(A @ c.covariance @ A.T) / len(rays)) for A in (rows, aligned))
        assert least <= stated * 1.001
        assert stated < 1.05 * least


def test_sigmas_on_the_screen_are_those_in_the_picture_times_the_distance_over_the_focal_length():
    model, lens = LensModel(0), lens_of((1000.0, 1000, 639.5, 511.5))
    at = projection_map(model, lens, SIZE, 2.5)
    C = np.diag([1.0, 1.0, 0.0, 0.0])
    np.testing.assert_allclose(at.sigma_mm(C), at.sigma_px(C) * 2.5, rtol=1e-9)


def test_the_map_predicts_the_scatter_of_pixels_between_calibrations():
    """Pixel differences of independent calibrations, after the best rotation, against the sigmas of the map."""
    fits = []
    for seed in range(6):
        table = photographs(Scene(views=8), 50 + seed)
        _, values = start(table, False)
        fits.append(robust_fit(table, LensModel(4), values, AS_STATED))
    at = projection_map(fits[0].model, lens_of(TRUTH), SIZE, 1.0, columns=8)
    found = [
        difference(at, (b.lens - a.lens)[b.model.free], a.covariance + b.covariance)
        for a, b in zip(fits[::2], fits[1::2], strict=True)
    ]
    ratios = [d.rms_px / d.expected_rms_px for d in found]
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.6
    same = difference(at, np.zeros(8), fits[0].covariance)
    assert same.rms_px == 0
    assert same.p_value == 1
