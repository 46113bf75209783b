"""Factors of the spots' variances: how the residuals vary with the errors that belong to places."""

from __future__ import annotations

import numpy as np
import pytest

from tracking.smoothing.error_scale import Squares, likely_factors
from tracking.smoothing.place_errors import PLACE_FACTOR


def squares(ratio: np.ndarray, place: np.ndarray, weight: float = 1.0, least: np.ndarray | float = 0.0) -> Squares:
    """Squares of residuals of which shares belong to places: as stated for each, and what each has at least."""
    least = np.broadcast_to(least, ratio.shape)
    return Squares(ratio, 1 - place - least, place, least, np.zeros(len(ratio)), np.full(len(ratio), weight))


@pytest.mark.parametrize("factor", [0.05, 0.2, 1.0])
def test_spots_on_edges_and_on_even_ground_show_how_much_of_the_predicted_errors_is_true(factor):
    rng = np.random.default_rng(1)
    place = rng.choice([0.05, 0.5, 0.95], 400)
    found = []
    for _ in range(40):
        ratio = 0.5 * rng.chisquare(2, 400) * (1 - place * (1 - factor))
        found.append(likely_factors(squares(ratio, place)))
    noise, of_place, _ = np.transpose(found)
    assert np.mean(noise) == pytest.approx(1.0, abs=0.07)
    assert np.mean(of_place) == pytest.approx(factor, rel=0.15, abs=0.03)
    assert np.std(of_place) < 0.1 * factor + 0.02


def test_a_least_error_that_no_spot_has_does_not_make_spots_on_edges_certain():
    """Objects in the pictures suggest that each light has an error of a fifth of its width; two of 120 are on edges."""
    rng, place, least = np.random.default_rng(4), np.zeros(120), np.full(120, 0.999)
    place[[30, 40]], least[[30, 40]] = 0.999, 0.0
    of_place, of_least = [], []
    for _ in range(40):
        ratio = 0.5 * rng.chisquare(2, 120) * (0.001 + place)
        factors = likely_factors(squares(ratio, place, 0.2, least))
        of_place.append(factors[1])
        of_least.append(factors[2])
    assert 0.4 < np.median(of_place) < 1.5
    assert np.median(of_least) < 0.02


def test_few_independent_places_leave_the_stated_errors():
    noise, place, _ = likely_factors(squares(np.full(400, 0.3), np.full(400, 0.9), 1 / 4000))
    assert noise == pytest.approx(1.0, abs=0.05)
    assert place == pytest.approx(1.0, abs=0.1)


def test_factors_drawn_from_their_prior_are_found_without_bias_from_few_residuals():
    """The mean ratio of true to found variances is 1, so that NEES stays right; a bound of 95 % makes it 0.6."""
    rng, spread, ratios = np.random.default_rng(2), 2 * np.log(PLACE_FACTOR), []
    for _ in range(400):
        place = np.full(10, 0.9)
        true = np.exp(rng.normal(-0.5 * spread**2, spread))
        variance = 0.1 + 0.9 * true
        noise, of_place, _ = likely_factors(squares(0.5 * rng.chisquare(2, 10) * variance, place))
        ratios.append(variance / (0.1 * noise + 0.9 * of_place))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.12)


def test_a_wrong_label_hardly_changes_the_factors():
    rng = np.random.default_rng(3)
    ratio = 0.5 * rng.chisquare(2, 400)
    ratio[7] = 1e6
    noise, _, _ = likely_factors(squares(ratio, np.zeros(400)))
    assert noise == pytest.approx(1.0, abs=0.15)
