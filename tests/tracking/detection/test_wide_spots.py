"""Wide spots with speckle and texture: one light is one detection, however ragged it is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from geometry.arrays import Array
from tracking.detection.detect import find_spots
from tracking.detections import Detections
from tracking.noise import NoiseModel
from tracking.parameters import DetectParameters

WIDTH, HEIGHT = 240, 200
BACKGROUND, FLOOR, SLOPE = 60.0, 1.5, 0.027  # DN, DN^2, DN


def grain(rng: np.random.Generator, contrast: float, px: float) -> Array:
    """A pattern (h, w) of mean 1 with this contrast and this correlation length."""
    smooth = cv2.GaussianBlur(rng.standard_normal((HEIGHT, WIDTH)), (0, 0), px)
    return np.asarray(1 + contrast * smooth / smooth.std())


def light(u: float, v: float, sigma: tuple[float, float], power: int = 1) -> Array:
    """A spot (h, w) of peak 1; power 1: a Gaussian, 2 and more: with a flat top."""
    x, y = np.meshgrid(np.arange(WIDTH) - u, np.arange(HEIGHT) - v)
    return np.asarray(np.exp(-0.5 * ((x / sigma[0]) ** 2 + (y / sigma[1]) ** 2) ** power))


def seen(bright: Array, contrast: float, seed: int, background: float | Array = BACKGROUND) -> Detections:
    """The detections in a picture of these lights, DN, on a screen that makes speckle of this contrast."""
    rng = np.random.default_rng(seed)
    screen = cv2.GaussianBlur(bright * grain(rng, contrast, 0.6), (0, 0), 0.6) + background * grain(rng, 0.03, 0.7)
    noisy = screen + rng.standard_normal(screen.shape) * np.sqrt(FLOOR + SLOPE * np.maximum(screen - BACKGROUND, 0))
    return find_spots(np.rint(noisy).clip(0, 255).astype(np.uint8), noise=NoiseModel(FLOOR, SLOPE, BACKGROUND, 0.02))


def near(found: Detections, u: float, v: float, px: float) -> int:
    return int(np.count_nonzero(np.linalg.norm(found.uv_px - [u, v], axis=1) < px))


@pytest.mark.parametrize(
    ("sigma", "contrast", "power"),
    [((5.0, 4.0), 0.3, 1), ((9.0, 6.0), 0.27, 1), ((13.0, 13.0), 0.3, 1), ((12.0, 9.0), 0.1, 2)],
)
def test_a_wide_spot_with_speckle_is_one_detection_at_its_centre(sigma, contrast, power):
    for seed in range(15):
        found = seen(60.0 * light(120.3, 100.6, sigma, power), contrast, seed)
        assert near(found, 120.3, 100.6, 0.2 * sigma[0]) == 1
        assert near(found, 120.3, 100.6, 3 * sigma[0]) == 1


@pytest.mark.parametrize("ratio", [1.0, 0.6])
def test_two_wide_spots_beside_each_other_stay_two(ratio):
    for seed in range(6):
        both = 60.0 * light(105.0, 100.0, (7.0, 7.0)) + 60.0 * ratio * light(133.0, 104.0, (7.0, 7.0))
        found = seen(both, 0.15, seed)
        assert near(found, 105.0, 100.0, 1.5) == 1
        assert near(found, 133.0, 104.0, 1.5) == 1


def test_a_narrow_spot_on_the_light_of_a_reflection_keeps_its_width():
    reflection = BACKGROUND + 30.0 * light(110.0, 95.0, (30.0, 25.0))
    for seed in range(6):
        found = seen(25.0 * light(125.2, 104.4, (2.3, 2.3)), 0.0, seed, reflection)
        spot = np.argmin(np.linalg.norm(found.uv_px - [125.2, 104.4], axis=1))
        assert np.linalg.norm(found.uv_px[spot] - [125.2, 104.4]) < 0.4
        assert found.major_px[spot] < 4.0


def test_a_wide_faint_spot_on_the_slope_of_a_reflection_is_found():
    """Windows that grow with the light run up the slope; the fit starts again from the peak."""
    found = 0
    for seed in range(6):
        rng = np.random.default_rng([seed, 7])
        bright = 6.0 * light(130.3, 90.6, (10.0, 10.0)) + 20.0 * light(30.0, 170.0, (60.0, 60.0))
        screen = (16.0 + bright) * grain(rng, 0.03, 3.3)
        noisy = screen + rng.standard_normal(screen.shape) * np.sqrt(0.22 + 0.0124 * screen)
        picture = np.rint(noisy).clip(0, 255).astype(np.uint8)
        found += near(find_spots(picture, noise=NoiseModel(0.22, 0.0124, 0.0, 0.028)), 130.3, 90.6, 5.0)
    assert found >= 5


def test_grains_of_a_textured_screen_are_not_compact_lights():
    count = 0
    for seed in range(6):
        rng = np.random.default_rng([seed, 8])
        screen = BACKGROUND * grain(rng, 0.09, 0.9) + np.sqrt(FLOOR) * rng.standard_normal((HEIGHT, WIDTH))
        picture = np.rint(screen).clip(0, 255).astype(np.uint8)
        count += len(find_spots(picture, noise=NoiseModel(FLOOR, SLOPE, BACKGROUND, 0.066)))
    assert count <= 1


def test_grain_of_the_light_widens_the_sigmas_also_where_it_is_in_a_few_cells_only():
    """The mean over all cells of the window hardly shows the speckle of a spot's core; the centre moves by it."""
    errors = []
    for seed in range(60):
        found = seen(100.0 * light(120.3, 100.6, (4.0, 4.0)), 0.04, seed, background=6.0)
        row = int(np.argmin(np.linalg.norm(found.uv_px - [120.3, 100.6], axis=1)))
        error = found.uv_px[row] - [120.3, 100.6]
        errors.append(error @ np.linalg.solve(found.cov_px2[row], error) / 2)
    assert np.mean(errors) < 3.3


def test_a_faint_spot_far_above_the_grains_of_its_screen_is_found():
    """Fine texture has more light in its window than the spot; beside the spot it is the same."""
    found = 0
    for seed in range(20):
        rng = np.random.default_rng([seed, 9])
        spot = 2.6 * light(130.3, 100.6, (1.5, 1.5))
        screen = (7.0 + spot) * (1 + 0.06 * rng.standard_normal((HEIGHT, WIDTH)))
        picture = np.rint(screen + 0.2 * rng.standard_normal((HEIGHT, WIDTH))).clip(0, 255).astype(np.uint8)
        points = find_spots(picture, noise=NoiseModel(0.12, 0.005, 7.0, 0.02))
        found += bool(len(points)) and float(np.linalg.norm(points.uv_px - [130.3, 100.6], axis=1).min()) < 1.5
    assert found >= 19


@pytest.mark.parametrize("corner", [(-9, -2), (-11, 3), (-8, 30)])
@pytest.mark.parametrize("radius_px", [5, 7, 8])
def test_a_saturated_spot_beside_the_edge_of_an_object_is_found(corner, radius_px):
    """A disc with a halo on a card, beside a black box: a Gaussian that grows over the edge of the box fits better."""
    v, u = np.mgrid[:320, :400].astype(float)
    away = np.hypot(u - 200.3, v - 199.8)
    light = np.where((u < 200 + corner[0]) & (v < 200 + corner[1]), 18.0, 85.0)
    light += 300 / (1 + np.exp(2.2 * (away - radius_px))) + 25 * np.exp(-0.5 * (away / (1.3 * radius_px)) ** 2)
    noise = 0.5 * np.random.default_rng(1).standard_normal(light.shape)
    picture = np.clip(np.rint(cv2.GaussianBlur(light, (0, 0), 0.7) + noise), 0, 255).astype(np.uint8)
    found = find_spots(picture, DetectParameters(saturation_dn=255.0))
    assert len(found) == 1
    error = float(np.hypot(*(found.uv_px[0] - [200.3, 199.8])))
    assert error < min(1.2, 3 * float(np.sqrt(found.variance_px2[0])))
