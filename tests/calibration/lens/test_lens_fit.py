"""Fit of a lens to corners: start values, outliers, and excluded views with their reasons."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.lens_fit import robust_fit
from calibration.lens.fit.lens_parameters import AS_STATED
from calibration.lens.fit.lens_start import StartError, start
from tests.calibration.lens.lens_scenes import SIZE, TRUTH, WIDE, Scene, board_points, photographs


def solved(table: CornerTable, fisheye: bool = False):
    model, values = start(table, fisheye)
    return robust_fit(table, model, values, AS_STATED)


@pytest.mark.parametrize("focal", [450.0, pytest.param(1000.0, marks=pytest.mark.slow), 3500.0])
def test_a_perspective_lens_is_estimated_without_start_values(focal):
    reach = focal / 1000
    scene = Scene(lens=(focal, focal * 1.003, *TRUTH[2:]), distance_m=(0.35 * reach, 0.7 * reach))
    if focal < 500:
        scene = replace(scene, lens=(focal, focal, 640, 512, -0.05, 0.005, 0, 0, 0))
    found = solved(photographs(scene, 1))
    sigma = np.sqrt(np.diagonal(found.covariance))
    errors = (found.lens[:9] - np.array(scene.lens)) / sigma
    assert np.all(np.abs(errors) < 3.5)
    assert found.sigma_px == pytest.approx(scene.sigma_px, rel=0.05)


def test_a_fisheye_lens_is_estimated_without_start_values():
    scene = Scene(lens=WIDE, fisheye=True, distance_m=(0.15, 0.4))
    found = solved(photographs(scene, 2), fisheye=True)
    sigma = np.sqrt(np.diagonal(found.covariance))
    assert np.all(np.abs((found.lens[:8] - np.array(WIDE)) / sigma) < 3.5)


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2, 3))])
def test_four_corners_with_errors_of_8_px_change_no_parameter_by_half_a_sigma(seed):
    table = photographs(Scene(), seed)
    clean = solved(table)
    pixels = table.pixels.copy()
    hit = np.flatnonzero(table.view == 3)[[0, 1, 9, 10]]  # a square of the board
    pixels[hit] += 8 / np.sqrt(2)
    found = solved(replace(table, pixels=pixels))
    moved = (found.lens - clean.lens)[:9] / np.sqrt(np.diagonal(clean.covariance))
    assert np.all(np.abs(moved) < 0.5)
    assert not found.used[hit].any()
    assert found.dropped == {}


def test_a_view_with_corners_in_the_wrong_order_is_excluded():
    table = photographs(Scene(), 5)
    pixels = table.pixels.copy()
    mine = np.flatnonzero(table.view == 2)
    pixels[mine] = pixels[np.random.default_rng(0).permutation(mine)]
    found = solved(replace(table, pixels=pixels))
    assert list(found.dropped) == [2]
    assert not found.used[mine].any()
    assert found.sigma_px == pytest.approx(0.2, rel=0.05)


def test_a_blurred_view_is_excluded_with_its_reason():
    table = photographs(Scene(), 6)
    pixels = table.pixels.copy()
    mine = table.view == 4
    pixels[mine] += np.random.default_rng(1).normal(0, 1.5, (int(mine.sum()), 2))
    found = solved(replace(table, pixels=pixels))
    assert list(found.dropped) == [4]
    assert "times those of the median view" in found.dropped[4]


def test_corners_without_outliers_are_all_used():
    found = solved(photographs(Scene(views=25), 7))
    assert found.used.mean() > 0.999


def test_a_mirrored_board_has_no_start():
    table = photographs(Scene(), 8)
    mirrored = replace(table, pixels=[SIZE[0] - 1, 0] + [-1, 1] * table.pixels)
    with pytest.raises(StartError, match="mirror"):
        start(mirrored, False)


def test_views_with_few_corners_give_no_start():
    points = board_points(Scene())
    table = CornerTable.of([(np.arange(5), np.ones((5, 2)))] * 4, points, points.mean(axis=0), SIZE)
    with pytest.raises(StartError, match="6 corners or more"):
        start(table, False)


def test_nan_pixels_raise():
    points = board_points(Scene())
    with pytest.raises(ValueError, match="nan"):
        CornerTable.of([(np.arange(6), np.full((6, 2), np.nan))], points, points.mean(axis=0), SIZE)
