"""Occlusion model, against Bayes' rule summed over all states."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geometry.arrays import Array
from tracking.rigid_body.models.occlusion import MISSED, P_BLACKOUT, joint_log_likelihood, marginal, predict, update

GROUP = np.array([0, 0, 0, 1, 1])
N, GROUPS = len(GROUP), 2
DETECT = 0.95
NOT_LOOKED_FOR = -2
probability = st.floats(1e-6, 1 - 1e-6)
all_probabilities = st.lists(probability, min_size=N + GROUPS, max_size=N + GROUPS).map(np.array)
outcome = st.lists(st.sampled_from([0, MISSED, NOT_LOOKED_FOR]), min_size=N, max_size=N)


def over_all_states(p_visible: Array, assigned: Array) -> tuple[float, Array]:
    """Probability of an outcome, and posterior of each spot and each screen being visible, over all 2^7 states."""
    total, each = 0.0, np.zeros(N + GROUPS)
    for state in product((0, 1), repeat=N + GROUPS):
        on = np.array(state, dtype=bool)
        p = float(np.prod(np.where(on, p_visible, 1 - p_visible)))
        for i in range(N):
            if assigned[i] == NOT_LOOKED_FOR:
                continue
            detected = DETECT if on[i] and on[N + GROUP[i]] else 0.0
            p *= detected if assigned[i] >= 0 else 1 - detected
        total += p
        each += p * on
    return total, each / total


def log_probability(p_visible: Array, assigned: Array) -> float:
    """The log-likelihood as the tracker computes it."""
    return joint_log_likelihood(p_visible, GROUP, assigned, np.full(N, DETECT))


@given(all_probabilities)
def test_the_outcomes_of_a_frame_have_the_probability_one(p_visible):
    total = sum(np.exp(log_probability(p_visible, np.array(a))) for a in product((0, MISSED), repeat=N))
    # The probability of a blackout is added to that of finding nothing.
    assert total == pytest.approx(1 + P_BLACKOUT, rel=1e-9)


@given(all_probabilities, outcome)
def test_the_likelihood_of_an_outcome_is_the_sum_over_all_states(p_visible, assigned):
    a = np.array(assigned)
    expected = over_all_states(p_visible, a)[0]
    if np.all(a < 0) and np.any(a == MISSED):
        expected += P_BLACKOUT
    assert log_probability(p_visible, a) == pytest.approx(np.log(expected), abs=1e-6)


@given(all_probabilities, outcome)
def test_the_update_follows_bayes_rule(p_visible, assigned):
    a = np.array(assigned)
    after = update(p_visible, GROUP, a, np.full(N, DETECT))
    if np.any(a >= 0):  # else P_BLACKOUT contributes
        np.testing.assert_allclose(after, over_all_states(p_visible, a)[1], atol=3e-6)


@given(all_probabilities, st.lists(outcome, min_size=1, max_size=30))
def test_probabilities_stay_between_0_and_1(p_visible, outcomes):
    for assigned in outcomes:
        p_visible = update(predict(p_visible, N), GROUP, np.array(assigned), np.full(N, DETECT))
        assert np.all((p_visible > 0) & (p_visible < 1))
        assert np.all((marginal(p_visible, GROUP) > 0) & (marginal(p_visible, GROUP) < 1))


def after(outcomes: list[list[int]]) -> Array:
    p_visible = np.full(N + GROUPS, 0.95)
    for assigned in outcomes:
        p_visible = predict(update(p_visible, GROUP, np.array(assigned), np.full(N, DETECT)), N)
    return p_visible


def test_a_single_point_on_an_occluded_screen_is_not_taken_for_a_spot():
    visible, occluded = [0, 0, 0, 0, 0], [MISSED, MISSED, MISSED, 0, 0]
    p_visible = after([visible] * 5 + [occluded] * 5)

    def log_ratio(assigned: list[int]) -> float:
        return log_probability(p_visible, np.array(assigned)) - log_probability(p_visible, np.array(occluded))

    # A false point would need a likelihood of thousands to one; the paper's clutter gives a good match e^9.
    single, whole = log_ratio([0, MISSED, MISSED, 0, 0]), log_ratio(visible)
    assert single < -6
    assert whole > single + 4  # all spots of a screen reappear together
    # Without the occlusion of whole screens the single point would be accepted.
    alone = np.concatenate([p_visible[:N], np.full(GROUPS, 1 - 1e-6)])
    alone[:3] = 0.14  # the limit for spots that are missed in frame after frame
    odds = np.log(DETECT * 0.14) - np.log(1 - DETECT * 0.14)
    assert single < odds - 4


def test_a_spot_missed_while_its_neighbours_are_found_is_occluded_but_not_its_screen():
    p_visible = after([[0] * 5] * 3 + [[MISSED, 0, 0, 0, 0]] * 3)
    assert p_visible[0] < 0.35
    assert np.all(p_visible[1:] > 0.9)


def test_a_screen_that_reappears_gives_no_information_about_the_other():
    all_occluded = [[MISSED] * 5] * 4
    p_visible = after([[0] * 5] * 3 + all_occluded)
    seen = update(p_visible, GROUP, np.array([0, 0, 0, NOT_LOOKED_FOR, NOT_LOOKED_FOR]), np.full(N, DETECT))
    assert seen[N] > 0.99
    assert seen[N + 1] == pytest.approx(p_visible[N + 1])
    np.testing.assert_array_equal(seen[3:N], p_visible[3:N])
