"""How vehemently a vehicle moves, learnt as the run goes on."""

from __future__ import annotations

import numpy as np
import pytest

from tracking.parameters import TrackerParameters
from tracking.rigid_body.adaptive_process_noise import LEAST_P, MOST_P, RANGE, AdaptiveProcessNoise

RESTING = np.zeros(6)


def test_a_jerk_set_by_hand_stays():
    temper = AdaptiveProcessNoise(TrackerParameters(learn_jerk=False, jerk_m_s3=7.0, jerk_rad_s3=11.0))
    for _ in range(50):
        temper.learn(RESTING, False, np.repeat([2.0, -1.0], 3))
    np.testing.assert_allclose(np.sqrt(temper.dynamics.jerk), np.repeat([7.0, 11.0], 3))


def test_each_jerk_follows_its_own_slope_and_stays_in_its_range():
    temper = AdaptiveProcessNoise(TrackerParameters())
    start = temper.dynamics.jerk
    slopes = np.array([1.0, -0.5, 0.2, -0.1, 2.0, -0.7])
    temper.learn(RESTING, False, slopes)
    np.testing.assert_array_equal(np.sign(temper.dynamics.jerk - start), np.sign(slopes))
    for _ in range(2000):
        temper.learn(RESTING, False, 5 * np.sign(slopes))
    np.testing.assert_allclose(np.sqrt(temper.dynamics.jerk), np.tile([RANGE[1], RANGE[0]], 3))


def test_the_jerk_settles_where_the_slope_is_zero():
    # The slope of a log-likelihood that is largest at 3 to 200 m/s^3 or rad/s^3, with the noise of single frames.
    rng = np.random.default_rng(1)
    temper, goal = AdaptiveProcessNoise(TrackerParameters()), 2 * np.log([3.0, 200.0, 20.0, 9.0, 150.0, 60.0])
    settled = []
    for k in range(800):
        slope = 0.2 * (goal - np.log(temper.dynamics.jerk)) + 0.3 * rng.normal(size=6)
        temper.learn(RESTING, False, slope)
        if k > 200:
            settled.append(0.5 * np.log(temper.dynamics.jerk))
    np.testing.assert_allclose(np.mean(settled, axis=0), goal / 2, atol=0.1)


def test_a_manoeuvre_teaches_nothing_of_the_steady_motion():
    temper = AdaptiveProcessNoise(TrackerParameters())
    start = temper.dynamics.jerk
    temper.learn(RESTING, True, np.full(6, 3.0))
    np.testing.assert_array_equal(temper.dynamics.jerk, start)


def test_manoeuvres_are_as_frequent_as_they_were_within_limits():
    temper = AdaptiveProcessNoise(TrackerParameters())
    for k in range(4000):
        temper.learn(RESTING, k % 20 == 0, np.zeros(6))
    assert temper.dynamics.p_manoeuvre == pytest.approx(1 / 20, rel=0.2)
    for _ in range(4000):
        temper.learn(RESTING, False, np.zeros(6))
    assert temper.dynamics.p_manoeuvre == LEAST_P
    for _ in range(4000):
        temper.learn(RESTING, True, np.zeros(6))
    assert temper.dynamics.p_manoeuvre == MOST_P


def test_a_manoeuvre_can_reverse_the_fastest_motion_lately():
    temper = AdaptiveProcessNoise(TrackerParameters())
    at_rest = temper.dynamics.jump
    moved = np.array([3.0, 0, 4.0, 0, 0, 10.0])
    temper.learn(moved, False, np.zeros(6))
    # A reversal changes a velocity by twice itself: within two sigmas of a jump along the axis it happens on.
    assert np.all(2 * np.sqrt(temper.dynamics.jump) > 2 * np.array([5.0, 10.0]))
    np.testing.assert_allclose(temper.fastest, [5.0, 10.0])
    for _ in range(3000):
        temper.learn(RESTING, False, np.zeros(6))
    np.testing.assert_allclose(temper.dynamics.jump, at_rest, rtol=1e-3)  # it fades ...
    np.testing.assert_allclose(temper.fastest, [5.0, 10.0])  # ... but the search after a blackout remembers
