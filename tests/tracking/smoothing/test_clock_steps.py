"""Steps of the clocks' numbers between estimates of the motion: where they end, and where nothing is known."""

import numpy as np
import pytest

from tracking.smoothing.motion.clocks import MAX_CLOCK_STEPS, clock_step
from tracking.smoothing.motion.run_detections import ClockSolution

PRIOR_S = np.array([0.01, 1e-5])
SIGMA_S = 0.02 * PRIOR_S


def solution(correction_s, sigma_s=SIGMA_S):
    zero = np.zeros((2, 2))
    return ClockSolution(np.asarray(correction_s), np.diag(np.square(sigma_s)), zero, np.zeros((1, 12, 2)))


def test_a_long_first_step_is_shortened_and_negligible_ones_are_not_taken():
    np.testing.assert_allclose(clock_step(solution(-0.8 * PRIOR_S), PRIOR_S, 0), -0.5 * PRIOR_S)
    np.testing.assert_array_equal(clock_step(solution(0.01 * SIGMA_S), PRIOR_S, 1), 0.0)
    np.testing.assert_array_equal(clock_step(solution(0.9 * SIGMA_S), PRIOR_S, MAX_CLOCK_STEPS), 0.0)


def test_turns_that_change_with_each_step_do_not_keep_the_clocks_moving():
    """Steps of .2 to .4 sigmas went on until turns became others: a step of three sigmas, and nothing was known."""
    short = solution(0.4 * SIGMA_S)
    for step in range(MAX_CLOCK_STEPS):
        np.testing.assert_allclose(clock_step(short, PRIOR_S, step), (step < 2) * 0.4 * SIGMA_S)


@pytest.mark.parametrize("step", range(MAX_CLOCK_STEPS + 1))
def test_from_the_third_step_on_a_step_longer_than_its_sigma_allows_leaves_nothing_known(step):
    """A turntable's turns and the clocks followed each other for steps of five sigmas each, to 83 sigmas."""
    one = np.array([1.0, 0.0])
    limit = 1.0 if step == MAX_CLOCK_STEPS else 3.0
    for times, sigma_s, ends in (
        (limit - 0.1, SIGMA_S, True), (limit + 0.1, SIGMA_S, False), (1.1, 0.28 * PRIOR_S, False),
    ):  # fmt: skip
        change = clock_step(solution(times * sigma_s * one, sigma_s), PRIOR_S, step)
        assert (change is None) == (step >= 2 and not ends)
    of_open_numbers = clock_step(solution(0.9 * PRIOR_S * one, [PRIOR_S[0], SIGMA_S[1]]), PRIOR_S, step)
    assert of_open_numbers is not None


def test_errors_of_places_do_not_widen_the_prior_of_a_number_that_keeps_it():
    """It was 1.7 times as wide, and so were the poses of all its camera's pictures."""
    found = ClockSolution(np.zeros(2), np.diag([1e-8, PRIOR_S[1] ** 2]), np.zeros((2, 2)), np.zeros((1, 12, 2)))
    wider = found.with_excess(3.0, PRIOR_S)
    np.testing.assert_allclose(np.diagonal(wider), [3e-8, PRIOR_S[1] ** 2], rtol=1e-12)
    np.testing.assert_array_equal(found.with_excess(0.5, PRIOR_S), found.noise)
