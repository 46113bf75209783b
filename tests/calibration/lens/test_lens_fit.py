"""A lens from corners: starts from nothing, outliers that do not pull, what is thrown out and why."""

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


@pytest.mark.parametrize("focal", [450.0, 1000.0, 3500.0])
def test_a_perspective_lens_is_found_from_nothing(focal):
    reach = focal / 1000
    scene = Scene(lens=(focal, focal * 1.003, *TRUTH[2:]), distance_m=(0.35 * reach, 0.7 * reach))
    if focal < 500:
        scene = replace(scene, lens=(focal, focal, 640, 512, -0.05, 0.005, 0, 0, 0))
    found = solved(photographs(scene, 1))
    sigma = np.sqrt(np.diagonal(found.covariance))
    away = (found.lens[:9] - np.array(scene.lens)) / sigma
    assert np.all(np.abs(away) < 3.5)
    assert found.sigma_px == pytest.approx(scene.sigma_px, rel=0.05)


def test_a_fisheye_lens_is_found_from_nothing():
    scene = Scene(lens=WIDE, fisheye=True, distance_m=(0.15, 0.4))
    found = solved(photographs(scene, 2), fisheye=True)
    sigma = np.sqrt(np.diagonal(found.covariance))
    assert np.all(np.abs((found.lens[:8] - np.array(WIDE)) / sigma) < 3.5)


@pytest.mark.parametrize("seed", range(4))
def test_four_corners_off_by_8_px_move_no_parameter_by_half_a_sigma(seed):
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


def test_a_view_whose_corners_are_in_the_wrong_order_is_left_out_with_its_reason():
    table = photographs(Scene(), 5)
    pixels = table.pixels.copy()
    mine = np.flatnonzero(table.view == 2)
    pixels[mine] = pixels[np.random.default_rng(0).permutation(mine)]
    found = solved(replace(table, pixels=pixels))
    assert list(found.dropped) == [2]
    assert not found.used[mine].any()
    assert found.sigma_px == pytest.approx(0.2, rel=0.05)


def test_a_blurred_view_is_left_out_with_how_much_worse_it_is():
    table = photographs(Scene(), 6)
    pixels = table.pixels.copy()
    mine = table.view == 4
    pixels[mine] += np.random.default_rng(1).normal(0, 1.5, (int(mine.sum()), 2))
    found = solved(replace(table, pixels=pixels))
    assert list(found.dropped) == [4]
    assert "times those of the median view" in found.dropped[4]


def test_clean_corners_stay():
    found = solved(photographs(Scene(views=25), 7))
    assert found.used.mean() > 0.999


def test_a_board_seen_as_in_a_mirror_is_refused():
    table = photographs(Scene(), 8)
    mirrored = replace(table, pixels=[SIZE[0] - 1, 0] + [-1, 1] * table.pixels)
    with pytest.raises(StartError, match="mirror"):
        start(mirrored, False)


def test_views_with_a_handful_of_corners_make_no_start():
    points = board_points(Scene())
    table = CornerTable.of([(np.arange(5), np.ones((5, 2)))] * 4, points, points.mean(axis=0), SIZE)
    with pytest.raises(StartError, match="6 corners or more"):
        start(table, False)


def test_nan_pixels_are_refused_by_name():
    points = board_points(Scene())
    with pytest.raises(ValueError, match="nan"):
        CornerTable.of([(np.arange(6), np.full((6, 2), np.nan))], points, points.mean(axis=0), SIZE)
