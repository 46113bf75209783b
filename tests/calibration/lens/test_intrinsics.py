"""Intrinsic calibrations against known truth: chosen model, covariance, findings and errors."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.lens_models import LENS_MODELS, LensModel, named
from calibration.lens.intrinsics import Intrinsics, IntrinsicsError, IntrinsicsOptions, calibrate_intrinsics
from calibration.terms.rig_blocks import INTRINSICS
from geometry.camera import FISHEYE
from lab.calibrate.camera.camera_page import LIMITS, findings_of
from lab.findings.finding import Level, verdict
from tests.calibration.lens.lens_scenes import SIZE, TRUTH, WIDE, Scene, board_points, photographs
from tests.marks import further_slow

FIVE = IntrinsicsOptions(lens=LensModel(5))
QUICK = IntrinsicsOptions(lens=LensModel(4), warp=False)  # the true k3 is too small to be significant


@cache
def typical() -> Intrinsics:
    return calibrate_intrinsics(photographs(Scene(views=10), 1), IntrinsicsOptions())


def errors(result: Intrinsics, lens: tuple[float, ...] = TRUTH) -> np.ndarray:
    """(p,): estimated minus true parameters."""
    truth = np.zeros(18)
    truth[: len(lens)] = lens
    return (result.fit.lens - truth)[result.model.free]


def finding(result: Intrinsics, words: str) -> Level:
    return next(f.level for f in findings_of(result) if words in f.what)


def test_the_lens_is_estimated_within_its_sigmas():
    c = typical()
    assert c.model.coefficients in (4, 5)
    chi2 = errors(c) @ np.linalg.solve(c.covariance, errors(c))
    assert chi2 < 30  # of nine parameters: exceeded with probability 1/2000
    assert c.fit.sigma_px == pytest.approx(0.2, rel=0.05)
    assert c.held_out_rms_px == pytest.approx(0.2, rel=0.08)
    assert verdict(findings_of(c)) < Level.FAIL


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lens", "fisheye", "expected"),
    [
        (TRUTH[:4], False, "0"),
        (TRUTH[:8], False, "4"),
        ((*TRUTH[:4], -0.3, 0.15, 0.0, 0.0, 0.2), False, "5"),
        (WIDE, True, "fisheye"),
    ],
)
def test_the_true_lens_model_is_selected(lens, fisheye, expected):
    near = (0.15, 0.4) if lens[0] < 900 else (0.35, 0.7)
    c = calibrate_intrinsics(photographs(Scene(lens=lens, fisheye=fisheye, views=20, distance_m=near), 3))
    assert c.model == named(expected)
    assert [r.model for r in c.selection.candidates] == list(LENS_MODELS)


def test_a_requested_lens_model_is_used():
    c = calibrate_intrinsics(photographs(Scene(views=6), 5), QUICK)
    assert c.model == LensModel(4)
    assert c.selection.why == "as requested"
    assert c.parameters == ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    assert len(c.distortion) == 4


def bowed(sag_m: float, width_m: float) -> tuple[float, float, float]:
    return (sag_m / (width_m / 2) ** 2, 0.0, 0.0)


@pytest.mark.parametrize("seed", [11])
def test_a_board_bowed_by_1_5_mm_over_0_33_m_does_not_bias_the_focal_length(seed):
    scene = Scene(views=10, warp=bowed(0.0015, 0.33), columns=12, rows=8, distance_m=(0.45, 0.9))
    table = photographs(scene, seed)
    corrected = calibrate_intrinsics(table, FIVE)
    assert corrected.warp is not None
    assert corrected.warp.corrected
    assert np.all(np.abs(errors(corrected)[:2]) < 2 * corrected.sigmas[:2])
    assert corrected.fit.warp[0] == pytest.approx(scene.warp[0], abs=4 * corrected.warp.sigma[0])
    # Without the correction the focal length would be biased significantly.
    flat = calibrate_intrinsics(table, replace(FIVE, warp=False))
    assert abs(errors(flat)[0]) > 5 * np.sqrt(np.diagonal(flat.fit.covariance))[0]


def test_a_flat_board_is_taken_as_flat():
    c = typical()
    assert c.warp is not None
    assert not c.warp.corrected
    assert np.all(c.fit.warp == 0)


def test_four_corners_with_errors_of_8_px_do_not_change_the_result():
    table = photographs(Scene(views=8), 6)
    pixels = table.pixels.copy()
    hit = np.flatnonzero(table.view == 5)[[0, 1, 9, 10]]
    pixels[hit] += 8 / np.sqrt(2)
    clean, found = (calibrate_intrinsics(t, replace(FIVE, warp=False)) for t in (table, replace(table, pixels=pixels)))
    assert np.all(np.abs(found.fit.lens - clean.fit.lens)[:9] < 0.5 * clean.sigmas)
    np.testing.assert_allclose(found.sigmas, clean.sigmas, rtol=0.05)
    assert not found.fit.used[hit].any()


def stretched_differently(seed: int, views: int) -> CornerTable:
    """Corners of a board that is stretched slightly differently in each photograph, like drying paper."""
    table = photographs(Scene(views=views, sigma_px=0.05), seed)
    rng = np.random.default_rng(seed)
    pixels = table.pixels.copy()
    for v in range(table.views):
        mine = table.view == v
        middle = pixels[mine].mean(axis=0)
        pixels[mine] = middle + (pixels[mine] - middle) * (1 + rng.normal(0, 0.002, 2))
    return replace(table, pixels=pixels)


def test_errors_correlated_within_a_photograph_inflate_the_sigmas():
    c = calibrate_intrinsics(stretched_differently(7, 12), QUICK)
    assert c.correlated_noise > 1.5
    assert finding(c, "parameters scatter") is Level.WARN
    assert np.all(c.sigmas > 1.2 * np.sqrt(np.diagonal(c.fit.covariance)))


@pytest.mark.slow
def test_few_photographs_with_errors_of_their_own_give_a_focal_length_within_its_sigmas():
    z = []
    for seed in range(30):
        c = calibrate_intrinsics(stretched_differently(seed, 8), QUICK)
        z.append((c.fit.lens[:2] - TRUTH[:2]) / c.sigmas[:2])
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_halves_taken_with_two_focal_lengths_differ_significantly():
    first, second = (photographs(Scene(views=12, lens=(f, f, *TRUTH[2:])), 8) for f in (1000.0, 1015.0))
    views = []
    for v in range(12):
        t = (first, second)[v % 2]
        views.append((t.point[t.view == v], t.pixels[t.view == v]))
    c = calibrate_intrinsics(CornerTable.of(views, first.board_points, first.middle, SIZE), QUICK)
    assert c.halves is not None
    assert c.halves.p_value < 0.01
    assert finding(c, "Two halves") >= Level.WARN
    agreeing = typical().halves
    assert agreeing is not None
    assert agreeing.p_value > 0.01


def test_an_uncovered_side_of_the_picture_is_a_warning():
    table = photographs(Scene(views=24), 9)
    left = [v for v in range(24) if table.pixels[table.view == v, 0].max() < 0.75 * SIZE[0]]
    c = calibrate_intrinsics(table.only_views(np.array(left)), QUICK)
    assert "right side" in c.coverage.gaps
    assert finding(c, "right side") is Level.WARN


def test_a_stretched_picture_fails_because_of_fx_over_fy():
    c = calibrate_intrinsics(photographs(Scene(views=10, lens=(1000.0, 930.0, *TRUTH[2:])), 10), QUICK)
    assert finding(c, "fx / fy") is Level.FAIL
    assert verdict(findings_of(c)) is Level.FAIL


def test_noisy_corners_fail():
    c = typical()
    noisy = replace(c, fit=replace(c.fit, sigma_px=1.5))
    (level,) = (f.level for f in findings_of(noisy) if f.what.startswith("Corner residuals: 1.5 px"))
    assert level is Level.FAIL


def of_lens(c: Intrinsics, i: int, value: float, variance: float = 0.0) -> Intrinsics:
    """A calibration with another number of its lens."""
    step, covariance = np.zeros((1, len(c.fit.lens))), c.covariance.copy()
    step[0, i], covariance[i], covariance[:, i], covariance[i, i] = value - c.fit.lens[i], 0.0, 0.0, variance
    values = {**c.fit.values, INTRINSICS: c.fit.values[INTRINSICS].plus(step)}
    return replace(c, fit=replace(c.fit, values=values), covariance=covariance)


def with_aspect(c: Intrinsics, away: float, sigma: float = 0.0) -> Intrinsics:
    """A calibration with another fx / fy, known to this sigma."""
    fy = c.fit.lens[1]
    return of_lens(of_lens(c, 1, fy), 0, fy * (1 + away), (sigma * fy * (1 + away)) ** 2)


NUMBERS = {
    "Corner residuals": (LIMITS.noise_px, lambda c, x: replace(c, fit=replace(c.fit, sigma_px=x))),
    "orientations": (LIMITS.spread_deg, lambda c, x: replace(c, coverage=replace(c.coverage, spread_deg=x))),
    "Boards covered": (LIMITS.filled, lambda c, x: replace(c, coverage=replace(c.coverage, filled=x, gaps=()))),
    "Focal length": (LIMITS.focal, lambda c, x: of_lens(c, 0, c.fit.lens[0], (x * c.fit.lens[0]) ** 2)),
    "fx / fy": (LIMITS.aspect, with_aspect),
    "Principal point": (
        LIMITS.off_centre,
        lambda c, x: of_lens(of_lens(c, 2, (SIZE[0] - 1) / 2 + x * SIZE[0]), 3, (SIZE[1] - 1) / 2),
    ),
    "Hold-out": (LIMITS.overfit, lambda c, x: replace(c, held_out_rms_px=x * c.fit.sigma_px)),
}


@pytest.mark.parametrize("words", NUMBERS)
def test_each_number_of_a_lens_is_a_warning_beyond_its_first_limit_and_a_failure_beyond_the_second(words):
    (first, second), with_number = NUMBERS[words]
    worse = (second / first) ** 0.01  # by so much of the way, in either direction
    values = first / worse, first * worse, second / worse, second * worse
    levels = [finding(with_number(typical(), value), words) for value in values]
    assert levels == [Level.PASS, Level.WARN, Level.WARN, Level.FAIL]


def test_pixels_that_are_not_square_are_no_warning_where_the_photographs_do_not_show_it():
    first, second = LIMITS.aspect
    some, much = 2 * first, 2 * second
    assert finding(with_aspect(typical(), some, 0.45 * some), "fx / fy") is Level.WARN
    assert finding(with_aspect(typical(), some, 0.55 * some), "fx / fy") is Level.PASS
    assert finding(with_aspect(typical(), much, much), "fx / fy") is Level.FAIL


@pytest.mark.parametrize("lean", [pytest.param((0.0, 0.0), marks=pytest.mark.slow), (0.5, 0.2)])
def test_parallel_boards_are_rejected_with_the_reason(lean):
    table = photographs(Scene(views=8, tilt_rad=0.01, lean_rad=lean, roll_rad=0.0), 14)
    with pytest.raises(IntrinsicsError, match=r"same orientation .* focal length is not determined"):
        calibrate_intrinsics(table)


def test_three_photographs_are_too_few():
    with pytest.raises(IntrinsicsError, match=r"4 photographs or more .* got 3"):
        calibrate_intrinsics(photographs(Scene(views=3), 15))


def test_a_mirrored_board_is_rejected():
    table = photographs(Scene(), 16)
    with pytest.raises(IntrinsicsError, match="mirror"):
        calibrate_intrinsics(replace(table, pixels=[SIZE[0] - 1, 0] + [-1, 1] * table.pixels))


def test_random_corners_are_rejected():
    points = board_points(Scene())
    rng = np.random.default_rng(17)
    views = [(np.arange(54), rng.uniform(0, 1000, (54, 2))) for _ in range(5)]
    table = CornerTable.of(views, points, points.mean(axis=0), SIZE)
    try:
        result = calibrate_intrinsics(table, QUICK)
    except IntrinsicsError:
        return
    assert verdict(findings_of(result)) is Level.FAIL


def test_every_lens_model_is_found_by_its_title():
    assert [named(m.title) for m in LENS_MODELS] == list(LENS_MODELS)
    assert named("fisheye") == LensModel(4, FISHEYE)
    with pytest.raises(ValueError, match="expected a lens model out of 0, 4, 5, fisheye, 8, 12, got '7'"):
        named("7")


def coverage_and_nees(seeds: range, options: IntrinsicsOptions) -> tuple[np.ndarray, np.ndarray]:
    """Errors in sigmas (n, 9) of fx ... k3 and NEES over the number of parameters (n,)."""
    z, nees = [], []
    for seed in seeds:
        c = calibrate_intrinsics(photographs(Scene(views=12), seed), options)
        e = errors(c)
        z.append(e / c.sigmas)
        nees.append(e @ np.linalg.solve(c.covariance, e) / len(e))
    return np.array(z), np.array(nees)


def test_errors_agree_with_the_covariance():
    _, nees = coverage_and_nees(range(100, 103), replace(FIVE, warp=False))
    # The mean of 27 squared normal numbers is within 0.44 to 1.84 with probability 99 %.
    assert 0.44 < nees.mean() < 1.84


@pytest.mark.slow
def test_sigmas_agree_with_the_scatter_of_200_calibrations():
    z, nees = coverage_and_nees(range(200), FIVE)
    inside = (np.abs(z) < 1).mean(axis=0)
    assert np.all((inside > 0.62) & (inside < 0.75)), inside
    band = 1.96 * np.sqrt(2 / z.size)
    assert abs(nees.mean() - 1) < band


@pytest.mark.slow
def test_400_views_take_less_than_20_s_of_processor_time():
    table = photographs(Scene(views=400), 5)
    start = time.process_time()
    result = calibrate_intrinsics(table)
    assert time.process_time() - start < 20
    assert result.model == LensModel(5)


def test_a_photograph_of_one_row_and_one_corner_more_does_not_stop_the_calibration():
    """No pose of a plane follows from them, as from the few corners of a wide picture that a first lens can flatten."""
    table = photographs(Scene(views=10), 1)
    row = (table.points[:, 1] == 0.0) | (table.point == 9)  # 9: the first corner of the second row
    kept = (table.view > 0) | row
    partial = replace(table, view=table.view[kept], point=table.point[kept], pixels=table.pixels[kept])
    assert np.count_nonzero(partial.view == 0) == 10
    found = calibrate_intrinsics(partial, FIVE)
    assert found.fit.lens[0] == pytest.approx(typical().fit.lens[0], rel=1e-3)


def of_two_lenses(first: tuple[float, ...], second: tuple[float, ...], counts: tuple[int, int]) -> CornerTable:
    """Photographs of two cameras in one folder, those of the second among the first ones of the other."""
    tables = [
        photographs(Scene(views=n, lens=lens, sigma_px=0.05), 8)
        for lens, n in zip((first, second), counts, strict=True)
    ]
    views = [[(t.point[t.view == v], t.pixels[t.view == v]) for v in range(t.views)] for t in tables]
    mixed = [view for pair in zip(*views, strict=False) for view in pair] + views[0][counts[1] :]
    return CornerTable.of(mixed, tables[0].board_points, tables[0].middle, SIZE)


@pytest.mark.parametrize("seed", further_slow([2, 1]))
def test_two_photographs_in_which_a_small_copy_of_the_board_was_found_are_left_out(seed):
    """On a monitor, or pasted: no pose explains them, and the search for outliers hardly converges."""
    table = photographs(Scene(views=14, sigma_px=0.05), seed)
    pixels = table.pixels.copy()
    for view, corner in ((4, (0.0, 576.0)), (10, (768.0, 0.0))):
        pixels[table.view == view] = 0.4 * pixels[table.view == view] + corner
    found = calibrate_intrinsics(replace(table, pixels=pixels))
    assert sorted(found.fit.dropped) == [4, 10]
    assert found.model == LensModel(5)
    assert np.all(np.abs(errors(found)) < 4 * found.sigmas)


@pytest.mark.parametrize(
    ("second", "counts"),
    further_slow([
        ((1010.0, 1010.0, *TRUTH[2:]), (8, 8)),
        ((1000.0, 1003.0, 600.0, 545.0, -0.1, 0.03, 0.0, 0.0, 0.0), (10, 5)),
        ((700.0, 700.0, 640.0, 500.0, -0.05, 0.0, 0.0, 0.0, 0.0), (7, 6)),
    ]),
)  # fmt: skip
def test_photographs_of_two_cameras_are_named_and_give_no_lens(second, counts):
    names = tuple(f"{n:02d}.png" for n in range(sum(counts)))
    with pytest.raises(IntrinsicsError, match="calibrate each set separately") as error:
        calibrate_intrinsics(of_two_lenses(TRUTH, second, counts), IntrinsicsOptions(names=names))
    assert "from two cameras, or focus or zoom was changed" in str(error.value)
    fewer = [name for name in names[1 : 2 * counts[1] : 2] if name in str(error.value)]
    others = [name for name in names if name in str(error.value) and name not in fewer]
    assert (len(fewer) == counts[1] and not others) or (counts[0] == counts[1] and len(others) == counts[0])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_lens_that_refocuses_is_not_taken_for_two_cameras(seed):
    rng = np.random.default_rng(seed)
    scenes = [Scene(views=1, lens=(f, f, *TRUTH[2:]), sigma_px=0.05) for f in 1000 * (1 + rng.uniform(-0.01, 0.01, 14))]
    tables = [photographs(scene, 100 * seed + k) for k, scene in enumerate(scenes)]
    views = [(t.point, t.pixels) for t in tables]
    c = calibrate_intrinsics(CornerTable.of(views, tables[0].board_points, tables[0].middle, SIZE), FIVE)
    assert finding(c, "parameters scatter") is Level.WARN
