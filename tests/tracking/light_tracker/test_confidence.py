"""The confidence: its inputs act in the direction of their meaning."""

from __future__ import annotations

import numpy as np
import pytest

from tracking.light_tracker.frames import COEFFICIENTS, features, logit, probability, within

GOOD = {"support": 2.0, "confirmed": 5, "diameter_px": 9.0, "gap": 0}


def confidence(**changed: float) -> float:
    return probability(features(**{**GOOD, **changed}))  # type: ignore[arg-type]  # some are counts


def test_a_good_match_that_the_detector_confirmed_is_almost_sure():
    assert confidence() > 0.9


@pytest.mark.parametrize(
    "worse",
    [{"support": -1.5}, {"confirmed": 1}, {"diameter_px": 14.0}, {"gap": 4}],
)
def test_a_worse_input_lowers_the_confidence(worse):
    assert confidence(**worse) < confidence()


def test_a_track_that_checks_do_not_confirm_is_not_believed():
    assert confidence(confirmed=1, support=-1.9) < 0.5


@pytest.mark.parametrize("diameter_px", [35.0, 150.0])
def test_a_large_object_of_which_the_detector_is_never_sure_is_not_believed_however_often_it_is_found(diameter_px):
    """It is sure of a drogue of that size; of one of 9 px it is not."""
    assert confidence(support=0.0, confirmed=10, diameter_px=diameter_px) < 0.5
    assert confidence(support=0.0, confirmed=10) > 0.9
    assert confidence(support=4.0, diameter_px=diameter_px) > 0.99


def test_what_was_detected_once_is_as_sure_as_that_detection():
    assert confidence(support=0.5, confirmed=1) == pytest.approx(1 / (1 + np.exp(-0.5)))
    assert confidence(support=0.5, confirmed=2) > 0.9


def test_the_coefficients_have_the_signs_of_their_meaning():
    signs = (0, 1, 1, -1, 1, -1)  # of 1, support, confirmed, size, size x support, gap
    assert all(c * s >= 0 for c, s in zip(COEFFICIENTS, signs, strict=True))


def test_a_prediction_is_right_as_often_as_its_sigma_says():
    rng = np.random.default_rng(2)
    for sigma in (0.5, 2.0, 8.0):
        away = np.hypot(*(sigma * rng.standard_normal((2, 20_000))))
        assert within(sigma, 12.0) == pytest.approx(float((away <= 3.0).mean()), abs=0.01)


def test_log_odds_are_finite_and_odd():
    assert logit(0.0) == pytest.approx(-logit(1.0)) == pytest.approx(-6.9, abs=0.1)
    assert logit(0.5) == 0.0
