"""The pattern: its place and size to a fraction of a pixel, and what it does not match."""

from __future__ import annotations

import numpy as np
import pytest

from tests.tracking.light_tracker.targets import picture, texture
from tracking.light_tracker.pattern import Pattern, unexplained


def started(diameter: float, u: float = 90.3, v: float = 70.8) -> Pattern:
    pattern = Pattern.started(picture([(u, v, diameter)]), u, v, diameter)
    assert pattern is not None
    return pattern


@pytest.mark.parametrize("diameter", [9.0, 15.0, 40.0, 110.0])
def test_a_target_that_moved_and_grew_is_measured_to_a_fraction_of_a_pixel(diameter):
    u, v, growth = 96.85, 73.15, 1.06
    later = picture([(u, v, growth * diameter)], seed=3, gain=0.8)
    match = started(diameter).find(later, 91.0, 70.0, diameter, 9.0)
    assert match is not None
    # The noise of 2 DN in 9 px allows 0.02 px; a large target is reduced to 24 px, so the error grows with it.
    assert np.hypot(match.u_px - u, match.v_px - v) < max(0.15, 0.01 * diameter)
    assert match.diameter_px == pytest.approx(growth * diameter, rel=0.03)
    assert match.correlation > 0.95


def test_the_sigma_of_a_match_is_the_scatter_of_its_errors():
    pattern = started(15.0)
    errors, sigmas = [], []
    for seed in range(60):
        u = 90.3 + 0.37 * (seed % 7)
        match = pattern.find(picture([(u, 70.8, 15.0)], seed=seed, noise=6.0), 91.0, 71.0, 15.0, 4.0)
        assert match is not None
        errors.append(match.u_px - u)
        sigmas.append(np.sqrt(match.covariance[0, 0]))
    # Cubic interpolation and the noise of the pattern itself add to the noise of the picture.
    assert 0.5 < np.std(errors) / np.mean(sigmas) < 2.0


def test_a_change_of_gain_and_background_does_not_move_it():
    later = picture([(90.3, 70.8, 15.0)], gain=0.6, background=texture(9) + 25)
    match = started(15.0).find(later, 90.3, 70.8, 15.0, 4.0)
    assert match is not None
    assert np.hypot(match.u_px - 90.3, match.v_px - 70.8) < 0.2


def test_of_a_target_half_hidden_the_visible_half_is_matched():
    later = picture([(93.3, 70.8, 40.0)], hidden=(119.0, 70.8, 40.0), seed=4)
    pattern = started(40.0)
    plain = pattern.find(later, 90.3, 70.8, 40.0, 8.0)
    match = pattern.find(later, 90.3, 70.8, 40.0, 8.0, usual=0.02)
    assert plain is not None
    assert match is not None
    assert plain.visible == 1.0
    assert 0.4 < match.visible < 0.95
    assert np.hypot(match.u_px - 93.3, match.v_px - 70.8) < 0.5


def test_the_sigma_of_a_half_hidden_target_is_the_scatter_of_its_errors():
    pattern, errors, sigmas = started(40.0), [], []
    for seed in range(40):
        u = 90.3 + 0.37 * (seed % 7)
        later = picture([(u, 70.8, 40.0)], seed=seed, noise=6.0, hidden=(u + 26, 70.8, 40.0))
        match = pattern.find(later, 91.0, 71.0, 40.0, 4.0, usual=0.1)
        assert match is not None
        assert match.visible < 0.95
        errors.append(match.u_px - u)
        sigmas.append(np.sqrt(match.covariance[0, 0]))
    assert 0.5 < np.std(errors) / np.mean(sigmas) < 2.0


def test_where_the_target_is_not_the_correlation_is_low():
    match = started(15.0).find(picture([]), 90.3, 70.8, 15.0, 10.0)
    assert match is None or match.correlation < 0.8


def test_a_flat_picture_has_no_pattern_and_no_match():
    flat = np.full((160, 200), 90, np.uint8)
    assert Pattern.started(flat, 90.0, 70.0, 15.0) is None
    assert started(15.0).find(flat, 90.0, 70.0, 15.0, 5.0) is None


def test_a_target_at_the_border_is_matched_and_a_place_outside_is_none():
    pattern = Pattern.started(picture([(12.0, 70.8, 15.0)]), 12.0, 70.8, 15.0)
    assert pattern is not None
    match = pattern.find(picture([(6.5, 70.8, 15.0)], seed=2), 9.0, 70.8, 15.0, 4.0)
    assert match is not None
    assert abs(match.u_px - 6.5) < 0.3
    assert pattern.find(picture([]), -5.0, 70.8, 15.0, 4.0) is None


def test_a_second_target_in_the_window_is_reported():
    pattern = started(15.0)
    alone = pattern.find(picture([(90.3, 70.8, 15.0)]), 90.3, 70.8, 15.0, 30.0)
    two = pattern.find(picture([(90.3, 70.8, 15.0), (112.0, 70.8, 15.0)]), 90.3, 70.8, 15.0, 30.0)
    assert alone is not None
    assert two is not None
    assert two.second > 0.9 > alone.second


def test_even_a_perfect_match_leaves_a_variance():
    assert 0 < unexplained(1.0) < 1e-5
    assert unexplained(0.5) == 3.0
    assert unexplained(-0.2) == unexplained(0.0) < np.inf
