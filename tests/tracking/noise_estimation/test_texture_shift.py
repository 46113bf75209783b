"""Errors of spots by the texture of the screen, predicted from the background alone."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from geometry.arrays import Array
from tests.marks import further_slow
from tests.tracking.rendering import round_lights
from tracking.detection.detect import find_spots
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture
from tracking.noise_estimation.photon_transfer import NoiseEstimate, estimate_noise
from tracking.noise_estimation.texture_shift import (
    LARGEST_SHARE,
    TextureShift,
    lights_and_lines,
    local_shifts,
    shifts_at_rest,
)
from tracking.parameters import DetectParameters

SIZE = (400, 500)
BACKGROUND, NOISE = 600.0, 3.0  # DN


@cache
def screen(contrast: float, grain_px: float, seed: int) -> Array:
    """The reflectance (h, w) of a textured screen."""
    smooth = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal(SIZE), (0, 0), grain_px)
    return np.asarray(1 + contrast * smooth / smooth.std())


def pictures(reflectance: Array, light: Array | float, count: int) -> list[Picture]:
    rng = np.random.default_rng(7)
    expected = reflectance * (BACKGROUND + light)
    return [np.rint(expected + NOISE * rng.standard_normal(SIZE)).astype(np.uint16) for _ in range(count)]


@cache
def estimated(contrast: float, grain_px: float, seed: int) -> NoiseEstimate:
    """From four pictures of a screen without spots."""
    return estimate_noise(pictures(screen(contrast, grain_px, seed), 0.0, 4))


def spots(sigma_px: float, peak: float, seed: int) -> tuple[Array, Array]:
    """Centres (n, 2) of Gaussian spots far apart, and their light (h, w)."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.arange(50.0, 460, 80), np.arange(50.0, 360, 80))
    centres = np.stack([u.ravel(), v.ravel()], axis=-1) + rng.uniform(-0.5, 0.5, (u.size, 2))
    return centres, round_lights(SIZE, centres, peak, sigma_px)


@pytest.mark.parametrize(
    ("sigma_px", "grain_px"), further_slow([(1.5, 1.0), (9.0, 1.0), (3.0, 1.5), (6.0, 1.0)], fast=2)
)
@pytest.mark.parametrize("peak", [6000.0, 300.0])
def test_the_background_predicts_the_errors_of_bright_and_of_faint_spots(sigma_px, grain_px, peak):
    errors, expected = [], []
    for seed in range(2):
        reflectance = screen(0.04, grain_px, seed)
        estimate = estimated(0.04, grain_px, seed)
        centres, light = spots(sigma_px, peak, seed)
        found = find_spots(pictures(reflectance, light, 1)[0], noise=NoiseModel(NOISE**2, 0.0, BACKGROUND))
        for centre in centres:
            gap = found.uv_px - centre
            nearest = int(np.argmin(np.hypot(*gap.T)))
            errors.append(gap[nearest])
        sigma = estimate.texture_shift.sigma_px(np.array([sigma_px]), np.array([peak / BACKGROUND]))
        expected.append(float(sigma[0]))
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.mean(expected), rel=0.4)


@pytest.mark.parametrize("brightness", further_slow([3.0, 10.0]))
@pytest.mark.parametrize(("sigma_px", "grain_px"), further_slow([(1.6, 1.2), (1.6, 6.0), (3.0, 1.5)], fast=2))
def test_fits_that_give_bright_pixels_less_weight_have_smaller_errors_on_fine_texture(sigma_px, grain_px, brightness):
    """As a share of those of fits with equal weights; coarse texture shifts all of a spot, whatever the weights."""
    errors, expected, peak = np.zeros((2, 0)), [], 6000.0
    for seed in range(2):
        reflectance = screen(0.04, grain_px, seed)
        shift = estimated(0.04, grain_px, seed).texture_shift
        centres, light = spots(sigma_px, peak, seed)
        picture = pictures(reflectance, light, 1)[0]
        of_both = []
        for slope in (0.0, brightness * NOISE**2 / peak):
            found = find_spots(picture, noise=NoiseModel(NOISE**2, slope, BACKGROUND))
            nearest = [int(np.argmin(np.hypot(*(found.uv_px - centre).T))) for centre in centres]
            of_both.append((found.uv_px[nearest] - centres).ravel())
        errors = np.concatenate([errors, of_both], axis=1)
        at = np.array([sigma_px]), np.array([peak / BACKGROUND])
        expected.append(float(shift.sigma_px(*at, brightness)[0] / shift.sigma_px(*at)[0]))
    seen = np.sqrt(np.mean(errors[1] ** 2) / np.mean(errors[0] ** 2))
    assert seen == pytest.approx(np.mean(expected), abs=0.1)


@pytest.mark.parametrize("angle_deg", [0.0, 35.0, 90.0])
def test_elongated_spots_have_larger_errors_along_their_major_axis(angle_deg):
    """Variances along the axes are in proportion to the half axes."""
    major, minor, peak = 4.5, 1.8, 4000.0
    p, q = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    shape = np.array([[p, -q], [q, p]]) @ np.diag([major**-2, minor**-2]) @ np.array([[p, q], [-q, p]])
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    errors, claimed = [], []
    for seed in range(2):
        reflectance = screen(0.05, 1.0, seed)
        estimate = estimated(0.05, 1.0, seed)
        centres, _ = spots(1.0, 1.0, seed)
        light = sum(
            np.exp(
                -0.5 * (shape[0, 0] * (x - a) ** 2 + 2 * shape[0, 1] * (x - a) * (y - b) + shape[1, 1] * (y - b) ** 2)
            )
            for a, b in centres
        )
        picture = pictures(reflectance, peak * np.asarray(light), 1)[0]
        found = estimate.texture_shift.added_to(find_spots(picture, noise=estimate.model), estimate.model)
        for centre in centres:
            nearest = int(np.argmin(np.hypot(*(found.uv_px - centre).T)))
            errors.append((found.uv_px[nearest] - centre) @ np.array([[p, -q], [q, p]]))
            rotated = np.array([[p, q], [-q, p]]) @ found.cov_px2[nearest] @ np.array([[p, -q], [q, p]])
            claimed.append(np.diag(rotated))
    rms, sigma = np.sqrt(np.mean(np.square(errors), axis=0)), np.sqrt(np.median(claimed, axis=0))
    assert rms[0] > 1.3 * rms[1]
    assert rms == pytest.approx(sigma, rel=0.35)


@pytest.mark.parametrize(("contrast", "least", "most"), [(0.04, 0.05, 0.3), (0.0, 0.0, 0.02)])
def test_texture_above_the_steps_of_a_quiet_sensor_counts(contrast, least, most):
    """Nearly without noise, rounding makes plateaus of grey values; it does not hide texture of half a grey value."""
    rng = np.random.default_rng(4)
    expected = 16.0 * screen(contrast, 3.0, 1) if contrast else np.full(SIZE, 16.3)
    quiet = [np.rint(expected + 0.25 * rng.standard_normal(SIZE)).astype(np.uint8) for _ in range(6)]
    sigma = estimate_noise(quiet).texture_shift.sigma_px(np.array([2.5]), np.array([1.0]))[0]
    assert least <= sigma <= most


def seams(contrast: float) -> Array:
    """The reflectance (h, w) of a plain screen with two seams, a cable and its lower edge."""
    light = np.ones(SIZE, np.float32)
    lines = (((0, 90), (499, 160), 2, -0.4), ((120, 0), (60, 399), 4, contrast), ((300, 399), (499, 210), 3, contrast))
    for begin, end, width, change in lines:
        drawn = cv2.line(np.zeros(SIZE, np.float32), begin, end, 1.0, width, cv2.LINE_AA)
        light *= 1 + change * drawn
    light[340:] *= 0.3
    return np.asarray(light, float)


@pytest.mark.parametrize("contrast", [0.1, 0.3, 1.0])
def test_seams_and_the_edge_of_a_screen_are_not_texture(contrast):
    shift = estimate_noise(pictures(seams(contrast), 0.0, 4)).texture_shift
    errors = shift.sigma_px(np.array([1.5, 3.0, 5.0]), np.full(3, 10.0))
    assert np.all(errors < 0.004 * np.array([1.5, 3.0, 5.0]))


def test_texture_beside_seams_counts_as_without_them():
    at = np.array([1.5, 3.0, 5.0]), np.full(3, 10.0)
    alone = estimated(0.05, 1.0, 3).texture_shift.sigma_px(*at)
    both = estimate_noise(pictures(screen(0.05, 1.0, 3) * seams(0.3), 0.0, 4)).texture_shift.sigma_px(*at)
    np.testing.assert_allclose(both, alone, rtol=0.2)


def test_a_brushed_screen_has_texture_though_it_consists_of_lines():
    rng = np.random.default_rng(5)
    brushed = 1 + 0.05 * np.tile(cv2.GaussianBlur(rng.standard_normal((SIZE[0], 1)), (0, 0), 1.0), (1, SIZE[1]))
    turned = cv2.warpAffine(
        brushed, cv2.getRotationMatrix2D((250, 200), 20, 1.5), SIZE[::-1], borderMode=cv2.BORDER_REFLECT
    )
    errors = estimate_noise(pictures(turned, 0.0, 4)).texture_shift.sigma_px(np.array([3.0]), np.array([10.0]))
    assert errors[0] > 0.02


def test_a_light_covers_its_square_also_in_the_corners_of_the_picture():
    at = np.array([[3.0, 2.0], [60.0, 40.0], [76.0, 60.0], [40.0, -9.0], [-9.0, 30.0]])  # two are beside it
    shape = np.ones(5)
    points = replace(Detections.at(at, np.tile(np.eye(2), (5, 1, 1))), major_px=shape, minor_px=shape)
    expected = np.zeros((64, 80), np.uint8)
    expected[0:9, 0:10] = expected[35:47, 55:67] = expected[55:, 71:] = 1
    np.testing.assert_array_equal(lights_and_lines(np.zeros((64, 80), np.float32), [points]), expected)


def test_lights_that_move_over_the_screen_are_not_texture():
    moving = [pictures(np.ones(SIZE), spots(4.0, 3000.0, seed)[1], 1)[0] for seed in range(6)]
    errors = estimate_noise(moving).texture_shift.sigma_px(np.array([1.5, 3.0]), np.array([5.0, 5.0]))
    assert np.all(errors < 0.01)


def test_offsets_of_the_sensors_columns_do_not_multiply_the_light():
    """They shift faint spots, as any structure of the background does, and not bright ones."""
    offsets = np.tile(6.0 * np.random.default_rng(6).standard_normal(SIZE[1]), (SIZE[0], 1))
    seen = [np.clip(p + np.rint(offsets), 0, None).astype(np.uint16) for p in pictures(np.ones(SIZE), 0.0, 4)]
    shift = estimate_noise(seen).texture_shift
    bright, faint = (shift.sigma_px(np.array([2.0]), np.array([c]))[0] for c in (100.0, 0.5))
    assert bright < 0.003
    assert faint > 0.03


def test_the_fall_of_the_light_towards_the_corners_shifts_wide_spots():
    """Vignetting of lens and sensor multiplies the laser's light; a plane of ambient light does not shift a spot."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    r2 = ((x - 250) ** 2 + (y - 200) ** 2) / 250**2
    plane = 1 + 0.3 * (x - 250) / 500
    width, contrast = np.array([12.0, 20.0]), np.array([20.0, 20.0])
    level = estimate_noise(pictures(plane, 0.0, 4)).texture_shift.sigma_px(width, contrast)
    falling = estimate_noise(pictures(1 - 0.2 * r2, 0.0, 4)).texture_shift.sigma_px(width, contrast)
    usual = width**2 * 2 * 0.2 * 125 / 250**2  # px, at half the distance to the edge
    assert np.all(level < 0.1 * usual)
    assert np.all(np.abs(np.log(falling / usual)) < np.log(2))


@pytest.mark.parametrize("sigma_px", [2.0, 3.0])
def test_the_fall_of_the_light_towards_the_corners_is_in_the_sigmas_of_precise_narrow_spots(sigma_px):
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    fall = 1 - 0.2 * ((x - 250) ** 2 + (y - 200) ** 2) / (250**2 + 200**2)
    shift = estimate_noise(pictures(fall, 0.0, 4)).texture_shift
    centres, light = spots(sigma_px, 30000.0, 1)
    model, square = NoiseModel(NOISE**2, 0.0, BACKGROUND), []
    found = shift.added_to(find_spots(pictures(fall, light, 1)[0], noise=model), model)
    for centre in centres:
        gap = found.uv_px - centre
        i = int(np.argmin(np.hypot(*gap.T)))
        square.append(gap[i] @ np.linalg.solve(found.cov_px2[i], gap[i]) / 2)
    assert 0.3 < np.mean(square) < 1.5
    even = estimate_noise(pictures(np.ones(SIZE), 0.0, 4)).texture_shift
    assert np.all(even.added_to(found, model).place_px2 < 0.2 * found.place_px2)


@pytest.mark.parametrize("width_px", [1.2, 2.5])
def test_where_the_background_is_not_known_spots_have_the_errors_of_the_surroundings(width_px):
    background = (BACKGROUND * screen(0.04, 1.5, 2)).astype(np.float32)
    usual = local_shifts(background, 0.0, width_px)
    hidden = np.zeros(SIZE, bool)
    hidden[60::100, 60::100] = True
    hidden = cv2.dilate(hidden.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    variance = np.where(hidden, np.float32((10 * BACKGROUND) ** 2), np.float32(1.0))
    for wrong in (-BACKGROUND, 20 * BACKGROUND):
        there = local_shifts(np.where(hidden, np.float32(wrong), background), variance, width_px)[60::100, 60::100]
        assert np.all(np.abs(np.log(there / np.sqrt(np.mean(usual**2)))) < np.log(1.7))


def test_noise_alone_predicts_next_to_nothing():
    shift = estimate_noise(pictures(np.ones(SIZE), 0.0, 4)).texture_shift
    assert max(shift.light_px) < 0.002
    assert max(shift.background_px) < 0.004


def test_a_prediction_is_limited_and_pictures_without_room_have_none():
    rough = TextureShift((1.0, 10.0), (0.5, 5.0), (1.0, 10.0))
    assert rough.sigma_px(np.array([2.0]), np.array([0.1]))[0] == pytest.approx(2.0 * LARGEST_SHARE)
    small = [np.full((60, 60), 20, np.uint8) + np.eye(60, dtype=np.uint8) * k for k in (0, 1)]
    assert estimate_noise(small).texture_shift.sigma_px(np.array([3.0]), np.array([1.0]))[0] == 0.0


def lights(widths_px: list[float], peaks: list[float], misfits: list[float]) -> Detections:
    """Points of these widths, peaks and shares of misfits, with centres known to 1 % of their widths."""
    width = np.array(widths_px)
    points = Detections.at(np.zeros((len(width), 2)), (0.01 * width[:, None, None]) ** 2 * np.eye(2))
    return replace(points, major_px=width, minor_px=width, peak=np.array(peaks), misfit=np.array(misfits))


@pytest.mark.parametrize("spot_px", [1.6, 3.0])
def test_wide_reflections_do_not_show_the_grain_of_the_spots(spot_px):
    of_spots = lights([spot_px] * 3, [150.0] * 3, [0.5] * 3)
    with_reflections = lights([spot_px] * 3 + [28.0] * 3, [150.0] * 3 + [20.0] * 3, [0.5] * 3 + [1.0] * 3)
    alone, both = (TextureShift.none().with_lights([found] * 6).misfit_share for found in (of_spots, with_reflections))
    assert both == pytest.approx(alone, nan_ok=True)
    assert np.isnan(both) == (spot_px < 1.8)  # narrower ones do not show it at all


def test_a_light_at_rest_beside_the_picture_has_the_errors_of_its_border():
    """Only the slope of a lamp outside is in the picture, and its fit lies there."""
    beside, border = np.array([[-12.0, 80.0], [470.0, 411.5]]), np.array([[0.0, 80.0], [470.0, SIZE[0] - 1.0]])
    background = (BACKGROUND * screen(0.04, 1.5, 2)).astype(np.float32)
    lights = [replace(Detections.at(at, np.tile(np.eye(2), (2, 1, 1))), major_px=w, minor_px=w)
              for at in (beside, border) for w in (np.full(2, 2.0),)]  # fmt: skip
    found, expected = (shifts_at_rest(background, np.ones_like(background), some) for some in lights)
    assert np.all(found == expected)
    assert found.min() > 0


def test_wide_lights_on_an_even_wall_are_not_known_better_than_an_oblique_view_allows():
    """A round light of 12 px in a plane at 30 degrees, 1,000 px before a pinhole: its axis is not where the fit is."""
    even = estimated(0.0, 1.0, 5).texture_shift
    y, x = np.mgrid[-60:60:0.1, -60:60:0.1]
    depth = 1000.0 + x * np.sin(np.pi / 6)
    u, v = 1000.0 * x * np.cos(np.pi / 6) / depth, 1000.0 * y / depth
    weight = np.exp(-0.5 * (x**2 + y**2) / 12.0**2)
    light = np.histogram2d(v.ravel(), u.ravel(), bins=[np.arange(-70.5, 71)] * 2, weights=weight.ravel())[0]
    noise = np.random.default_rng(3).standard_normal(light.shape)
    picture = np.rint(20 + 40 * light / light.max() + noise).astype(np.uint8)
    model = NoiseModel(1.0, 0.0, 20.0)
    found = find_spots(picture, DetectParameters(), model)
    assert len(found) == 1
    away = float(np.hypot(*(found.uv_px[0] - 70.0)))
    assert away > 3.5 * np.sqrt(found.variance_px2[0])
    assert away < 2.5 * np.sqrt(even.added_to(found, model).variance_px2[0])
