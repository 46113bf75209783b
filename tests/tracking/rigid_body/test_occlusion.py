"""Whether spots are hidden: chances that stay chances, and Bayes' rule by trying every state."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geometry.arrays import Array
from tracking.rigid_body.occlusion import BLACKOUT, MISSED, joint_log_likelihood, marginal, predict, update

GROUP = np.array([0, 0, 0, 1, 1])
N, GROUPS = len(GROUP), 2
DETECT = 0.95
NOT_LOOKED_FOR = -2
chance = st.floats(1e-6, 1 - 1e-6)
chances_of_all = st.lists(chance, min_size=N + GROUPS, max_size=N + GROUPS).map(np.array)
outcome = st.lists(st.sampled_from([0, MISSED, NOT_LOOKED_FOR]), min_size=N, max_size=N)


def by_trying(chances: Array, assigned: Array) -> tuple[float, Array]:
    """Probability of an outcome, and of each spot being shown and each screen lit given it, over all 2^7 states."""
    total, each = 0.0, np.zeros(N + GROUPS)
    for state in product((0, 1), repeat=N + GROUPS):
        on = np.array(state, dtype=bool)
        p = float(np.prod(np.where(on, chances, 1 - chances)))
        for i in range(N):
            if assigned[i] == NOT_LOOKED_FOR:
                continue
            detected = DETECT if on[i] and on[N + GROUP[i]] else 0.0
            p *= detected if assigned[i] >= 0 else 1 - detected
        total += p
        each += p * on
    return total, each / total


def log_probability(chances: Array, assigned: Array) -> float:
    """As the tracker adds it up: each spot by itself, and what they gain together."""
    p = DETECT * marginal(chances, GROUP)
    apart = np.where(assigned >= 0, np.log(p), np.log(1 - p))[assigned != NOT_LOOKED_FOR]
    return float(apart.sum()) + joint_log_likelihood(chances, GROUP, assigned, DETECT)


@given(chances_of_all)
def test_the_outcomes_of_a_frame_have_the_probability_one(chances):
    total = sum(np.exp(log_probability(chances, np.array(a))) for a in product((0, MISSED), repeat=N))
    # A blackout of everything has a small chance on top: that of seeing nothing is not below it.
    assert total == pytest.approx(1 + BLACKOUT, rel=1e-9)


@given(chances_of_all, outcome)
def test_an_outcome_is_as_likely_as_the_sum_over_all_states_says(chances, assigned):
    a = np.array(assigned)
    expected = by_trying(chances, a)[0]
    if np.all(a < 0) and np.any(a == MISSED):
        expected += BLACKOUT
    assert log_probability(chances, a) == pytest.approx(np.log(expected), abs=1e-6)


@given(chances_of_all, outcome)
def test_what_is_learnt_is_bayes_rule(chances, assigned):
    a = np.array(assigned)
    after = update(chances, GROUP, a, DETECT)
    if np.any(a >= 0):  # else the blackout has its say
        np.testing.assert_allclose(after, by_trying(chances, a)[1], atol=3e-6)


@given(chances_of_all, st.lists(outcome, min_size=1, max_size=30))
def test_chances_stay_chances(chances, outcomes):
    for assigned in outcomes:
        chances = update(predict(chances, N), GROUP, np.array(assigned), DETECT)
        assert np.all((chances > 0) & (chances < 1))
        assert np.all((marginal(chances, GROUP) > 0) & (marginal(chances, GROUP) < 1))


def after(outcomes: list[list[int]]) -> Array:
    chances = np.full(N + GROUPS, 0.95)
    for assigned in outcomes:
        chances = predict(update(chances, GROUP, np.array(assigned), DETECT), N)
    return chances


def test_on_a_screen_gone_dark_one_lone_point_is_no_spot():
    lit, dark = [0, 0, 0, 0, 0], [MISSED, MISSED, MISSED, 0, 0]
    chances = after([lit] * 5 + [dark] * 5)

    def against_nothing(assigned: list[int]) -> float:
        return log_probability(chances, np.array(assigned)) - log_probability(chances, np.array(dark))

    # A false point would need a likelihood of thousands to one; the paper's clutter gives a good match e^9.
    lone, whole = against_nothing([0, MISSED, MISSED, 0, 0]), against_nothing(lit)
    assert lone < -6
    assert whole > lone + 4  # the screen's light returns to all of its spots
    # The same without screens, each spot hidden by itself: the lone point would be believed.
    alone = np.concatenate([chances[:N], np.full(GROUPS, 1 - 1e-6)])
    alone[:3] = 0.14  # where spots settle that are missed frame after frame
    odds = np.log(DETECT * 0.14) - np.log(1 - DETECT * 0.14)
    assert lone < odds - 4


def test_a_spot_missed_while_its_neighbours_shine_is_hidden_and_not_its_screen():
    chances = after([[0] * 5] * 3 + [[MISSED, 0, 0, 0, 0]] * 3)
    assert chances[0] < 0.35
    assert np.all(chances[1:] > 0.9)


def test_light_that_returns_for_one_screen_says_nothing_of_the_other():
    everything_dark = [[MISSED] * 5] * 4
    chances = after([[0] * 5] * 3 + everything_dark)
    seen = update(chances, GROUP, np.array([0, 0, 0, NOT_LOOKED_FOR, NOT_LOOKED_FOR]), DETECT)
    assert seen[N] > 0.99
    assert seen[N + 1] == pytest.approx(chances[N + 1])
    np.testing.assert_array_equal(seen[3:N], chances[3:N])
