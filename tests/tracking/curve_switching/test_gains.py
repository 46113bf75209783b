"""The gains g1, g2, g3: their bounds, their limits, and the cases in which the paper's forms are 0/0."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracking.curve_switching.matching import combined, direction_and_speed, nearness, picture_scale

FLOOR_PX = 1.0
WEIGHTS = (0.6, 0.2, 0.2)
pixel = st.tuples(st.floats(-2000, 2000), st.floats(-2000, 2000)).map(np.array)


@given(last=pixel, predicted=pixel, candidate=pixel, alpha=st.floats(0, 1))
def test_direction_speed_and_smoothness_lie_between_0_and_1(last, predicted, candidate, alpha):
    direction, speed = direction_and_speed(last, predicted, candidate, FLOOR_PX)
    g2 = combined(last, predicted, candidate, (0.0, alpha, 1 - alpha), 1.0, FLOOR_PX)
    for g in (direction, speed, g2):
        assert -1e-12 <= g <= 1 + 1e-12


@given(last=pixel, predicted=pixel, angle=st.floats(-np.pi, np.pi), share=st.floats(0, 1), p=st.floats(1, 4))
def test_all_gains_lie_between_0_and_1_within_the_search_radius(last, predicted, angle, share, p):
    radius = 10.0
    away = np.array([np.cos(angle), np.sin(angle)])
    candidate = predicted + share * radius * away / np.sum(np.abs(away) ** p) ** (1 / p)  # on the p-norm's circle
    assert -1e-9 <= nearness(predicted, candidate, radius, p) <= 1
    assert -1e-9 <= combined(last, predicted, candidate, WEIGHTS, radius, FLOOR_PX, p) <= 1 + 1e-12


@given(last=pixel, predicted=pixel)
def test_at_the_prediction_every_gain_is_1(last, predicted):
    assert nearness(predicted, predicted, 10.0) == 1
    assert combined(last, predicted, predicted, (0.0, 0.5, 1 - 0.5), 1.0, FLOOR_PX) == pytest.approx(1, abs=1e-12)
    assert combined(last, predicted, predicted, WEIGHTS, 10.0, FLOOR_PX) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize(("w2", "w3"), [(0.2, 0.2), (0.3, 0.1), (0.1, 0.3)])
def test_a_full_reversal_scores_only_its_speed_in_the_second_search(w2, w3):
    """Direction 0, speed 1: omega3 / (omega2 + omega3), which epsilon2 must not exceed."""
    last = np.array([500.0, 400.0])
    ahead = np.array([12.0, -5.0])
    g = combined(last, last + ahead, last - ahead, (0.0, w2, w3), 1.0, FLOOR_PX)
    assert g == pytest.approx(w3 / (w2 + w3))


def test_a_right_angle_is_half_a_direction():
    last = np.zeros(2)
    direction, speed = direction_and_speed(last, np.array([8.0, 0]), np.array([0, 8.0]), FLOOR_PX)
    assert direction == pytest.approx(0.5)
    assert speed == pytest.approx(1.0)


def test_speed_is_the_geometric_over_the_arithmetic_mean_of_the_lengths():
    _, speed = direction_and_speed(np.zeros(2), np.array([16.0, 0]), np.array([4.0, 0]), FLOOR_PX)
    assert speed == pytest.approx(8.0 / 10.0)


def test_equations_7_to_9_agree_with_a_hand_calculation():
    """A detection 3 px to the side of a prediction 4 px ahead: a 3-4-5 triangle."""
    last, predicted, candidate = np.zeros(2), np.array([4.0, 0]), np.array([4.0, 3.0])
    g1, direction, speed = 1 - 3 / 10, 0.5 + 0.5 * 0.8, 2 * np.sqrt(20) / 9
    assert nearness(predicted, candidate, 10.0) == pytest.approx(g1)
    assert combined(last, predicted, candidate, (0.0, 0.3, 1 - 0.3), 1.0, FLOOR_PX) == pytest.approx(
        0.3 * direction + 0.7 * speed
    )
    g3 = combined(last, predicted, candidate, WEIGHTS, 10.0, FLOOR_PX)
    assert g3 == pytest.approx(0.6 * g1 + 0.2 * direction + 0.2 * speed)


def test_only_the_ratios_of_the_weights_matter():
    args = np.zeros(2), np.array([4.0, 0]), np.array([5.0, 3.0])
    assert combined(*args, (0.6, 0.2, 0.2), 10.0, FLOOR_PX) == pytest.approx(
        combined(*args, (3.0, 1.0, 1.0), 10.0, FLOOR_PX)
    )


@given(point=pixel, other=pixel)
def test_a_zero_displacement_gives_a_finite_gain(point, other):
    """Predicted at rest, observed at rest, or both: 0/0 in the paper's eqs. (8) and (9)."""
    for last, predicted, candidate in ((point, point, point), (point, point, other), (point, other, point)):
        g = combined(last, predicted, candidate, WEIGHTS, 10.0, FLOOR_PX)
        assert np.isfinite(g)
        assert np.isfinite(combined(last, predicted, candidate, (0.0, 0.5, 1 - 0.5), 1.0, FLOOR_PX))


def test_the_direction_of_noise_does_not_affect_a_spot_at_rest():
    """Predicted 0.1 px to one side, detected 0.1 px to the other: noise, not a reversal."""
    last, step = np.array([300.0, 200.0]), np.array([0.1, 0.0])
    direction, speed = direction_and_speed(last, last + step, last - step, FLOOR_PX)
    assert direction == pytest.approx(1.0)
    assert speed == pytest.approx(1.0)


def test_the_direction_term_of_a_reversal_falls_smoothly_with_the_displacement():
    """It falls from 1 to 0 as the displacement grows from zero to twice the floor."""
    last = np.zeros(2)
    scores = [
        float(direction_and_speed(last, np.array([d, 0]), np.array([-d, 0]), FLOOR_PX)[0])
        for d in np.linspace(0, 2, 201)
    ]
    assert scores[0] == 1.0
    assert scores[-1] == 0.0
    assert np.all(np.diff(scores) <= 1e-12)
    assert np.abs(np.diff(scores)).max() < 0.05


def test_divided_by_the_image_diagonal_nearness_has_no_effect():
    """10 px from the prediction lower g1 by 0.006 with the paper's scale, and by 1 with the search radius."""
    scale = picture_scale(np.array([1280.0, 1024.0]))
    assert scale == pytest.approx(1639.2, abs=0.05)
    predicted, beside = np.array([600.0, 500.0]), np.array([610.0, 500.0])
    assert nearness(predicted, beside, scale) == pytest.approx(1 - 0.0061, abs=1e-4)
    assert nearness(predicted, beside, 10.0) == pytest.approx(0.0)


@pytest.mark.parametrize(("p", "value"), [(1.0, 2304.0), (2.0, 1639.2), (4.0, 1394.7)])
def test_the_scale_of_g1_is_the_p_norm_of_the_image_size(p, value):
    """The paper's sqrt(Sx^p + Sy^p) is the p-norm for p = 2 only: for p = 1 it would be 48 px."""
    assert picture_scale(np.array([1280.0, 1024.0]), p) == pytest.approx(value, abs=0.1)


def test_one_call_gives_the_gains_of_all_tracks_and_points():
    rng = np.random.default_rng(1)
    last, predicted, points = rng.uniform(0, 100, (3, 2)), rng.uniform(0, 100, (3, 2)), rng.uniform(0, 100, (4, 2))
    scale = np.array([5.0, 10.0, 20.0])
    g = combined(last[:, None], predicted[:, None], points[None], WEIGHTS, scale[:, None], FLOOR_PX)
    for i in range(3):
        for j in range(4):
            one = combined(last[i], predicted[i], points[j], WEIGHTS, scale[i], FLOOR_PX)
            assert g[i, j] == pytest.approx(one)
