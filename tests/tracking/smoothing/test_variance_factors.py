"""Factors of the spots' variances: how the residuals vary with the errors that belong to places."""

from __future__ import annotations

import numpy as np
import pytest

from tracking.smoothing.place_errors import PLACE_FACTOR
from tracking.smoothing.variance_factors import Squares, likely_factors


def squares(ratio: np.ndarray, place: np.ndarray, weight: float = 1.0) -> Squares:
    """Squares of residuals of which a share belongs to places."""
    return Squares(ratio, 1 - place, place, np.zeros(len(ratio)), np.full(len(ratio), weight))


@pytest.mark.parametrize("factor", [0.05, 0.2, 1.0])
def test_spots_on_edges_and_on_even_ground_show_how_much_of_the_predicted_errors_is_true(factor):
    rng = np.random.default_rng(1)
    place = rng.choice([0.05, 0.5, 0.95], 400)
    found = []
    for _ in range(40):
        ratio = 0.5 * rng.chisquare(2, 400) * (1 - place * (1 - factor))
        found.append(likely_factors(squares(ratio, place)))
    noise, of_place = np.transpose(found)
    assert np.mean(noise) == pytest.approx(1.0, abs=0.07)
    assert np.mean(of_place) == pytest.approx(factor, rel=0.15, abs=0.03)
    assert np.std(of_place) < 0.1 * factor + 0.02


def test_few_independent_places_leave_the_stated_errors():
    noise, place = likely_factors(squares(np.full(400, 0.3), np.full(400, 0.9), 1 / 4000))
    assert noise == pytest.approx(1.0, abs=0.05)
    assert place == pytest.approx(1.0, abs=0.1)


def test_factors_drawn_from_their_prior_are_found_without_bias_from_few_residuals():
    """The mean ratio of true to found variances is 1, so that NEES stays right; a bound of 95 % makes it 0.6."""
    rng, spread, ratios = np.random.default_rng(2), 2 * np.log(PLACE_FACTOR), []
    for _ in range(400):
        place = np.full(10, 0.9)
        true = np.exp(rng.normal(-0.5 * spread**2, spread))
        variance = 0.1 + 0.9 * true
        noise, of_place = likely_factors(squares(0.5 * rng.chisquare(2, 10) * variance, place))
        ratios.append(variance / (0.1 * noise + 0.9 * of_place))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.12)


def test_a_wrong_label_hardly_changes_the_factors():
    rng = np.random.default_rng(3)
    ratio = 0.5 * rng.chisquare(2, 400)
    ratio[7] = 1e6
    noise, _ = likely_factors(squares(ratio, np.zeros(400)))
    assert noise == pytest.approx(1.0, abs=0.15)
