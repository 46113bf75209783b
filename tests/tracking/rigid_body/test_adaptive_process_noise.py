"""Online estimates of the process noise, and of the ratio of the spots' errors to their stated sigmas."""

from __future__ import annotations

import numpy as np
import pytest

from tracking.parameters import TrackerParameters
from tracking.rigid_body.online_estimates import MAX_P, MIN_P, RANGE, AdaptiveProcessNoise, VarianceFactor

RESTING = np.zeros(6)


def test_a_jerk_set_by_hand_is_not_adapted():
    noise = AdaptiveProcessNoise(TrackerParameters(learn_jerk=False, jerk_m_s3=7.0, jerk_rad_s3=11.0))
    for _ in range(50):
        noise.update(RESTING, False, np.repeat([2.0, -1.0], 3))
    np.testing.assert_allclose(np.sqrt(noise.dynamics.jerk), np.repeat([7.0, 11.0], 3))


def test_each_jerk_follows_its_own_score_and_stays_in_its_range():
    noise = AdaptiveProcessNoise(TrackerParameters())
    start = noise.dynamics.jerk
    scores = np.array([1.0, -0.5, 0.2, -0.1, 2.0, -0.7])
    noise.update(RESTING, False, scores)
    np.testing.assert_array_equal(np.sign(noise.dynamics.jerk - start), np.sign(scores))
    for _ in range(2000):
        noise.update(RESTING, False, 5 * np.sign(scores))
    np.testing.assert_allclose(np.sqrt(noise.dynamics.jerk), np.tile([RANGE[1], RANGE[0]], 3))


def test_the_jerk_converges_to_where_the_score_is_zero():
    # The score of a log-likelihood with its maximum at 3 to 200 m/s^3 or rad/s^3, with the noise of single frames.
    rng = np.random.default_rng(1)
    noise, goal = AdaptiveProcessNoise(TrackerParameters()), 2 * np.log([3.0, 200.0, 20.0, 9.0, 150.0, 60.0])
    settled = []
    for k in range(800):
        score = 0.2 * (goal - np.log(noise.dynamics.jerk)) + 0.3 * rng.normal(size=6)
        noise.update(RESTING, False, score)
        if k > 200:
            settled.append(0.5 * np.log(noise.dynamics.jerk))
    np.testing.assert_allclose(np.mean(settled, axis=0), goal / 2, atol=0.1)


def test_a_manoeuvre_does_not_change_the_jerk_of_the_steady_motion():
    noise = AdaptiveProcessNoise(TrackerParameters())
    start = noise.dynamics.jerk
    noise.update(RESTING, True, np.full(6, 3.0))
    np.testing.assert_array_equal(noise.dynamics.jerk, start)


def test_the_manoeuvres_frequency_is_estimated_within_limits():
    noise = AdaptiveProcessNoise(TrackerParameters())
    for k in range(4000):
        noise.update(RESTING, k % 20 == 0, np.zeros(6))
    assert noise.dynamics.p_manoeuvre == pytest.approx(1 / 20, rel=0.2)
    for _ in range(4000):
        noise.update(RESTING, False, np.zeros(6))
    assert noise.dynamics.p_manoeuvre == MIN_P
    for _ in range(4000):
        noise.update(RESTING, True, np.zeros(6))
    assert noise.dynamics.p_manoeuvre == MAX_P


def test_a_manoeuvre_can_reverse_the_recent_fastest_motion():
    noise = AdaptiveProcessNoise(TrackerParameters())
    at_rest = noise.dynamics.velocity_jump
    velocities = np.array([3.0, 0, 4.0, 0, 0, 10.0])
    noise.update(velocities, False, np.zeros(6))
    # A reversal changes a velocity by twice itself: within two sigmas of a jump along the axis it happens on.
    assert np.all(2 * np.sqrt(noise.dynamics.velocity_jump) > 2 * np.array([5.0, 10.0]))
    np.testing.assert_allclose(noise.fastest, [5.0, 10.0])
    for _ in range(3000):
        noise.update(RESTING, False, np.zeros(6))
    np.testing.assert_allclose(noise.dynamics.velocity_jump, at_rest, rtol=1e-3)  # it decays ...
    np.testing.assert_allclose(noise.fastest, [5.0, 10.0])  # ... but not for the search after a blackout


def scales(ratio, dof, fits, seed):
    """The noise scale before each of the fits of spots whose errors are `ratio` times their sigmas."""
    factor, out = VarianceFactor(), []
    for chi2 in ratio**2 * np.random.default_rng(seed).chisquare(dof, fits):
        out.append(factor.noise_scale)
        factor.update(float(chi2), dof)
    return np.array(out)


@pytest.mark.parametrize("ratio", [1.3, 1.5, 2.0])
def test_larger_errors_are_known_after_few_frames(ratio):
    after = np.array([scales(ratio, 6, 300, seed)[[25, 299]] for seed in range(40)])
    assert np.mean(after[:, 0]) == pytest.approx(ratio, rel=0.12)
    assert np.mean(after[:, 1]) == pytest.approx(ratio, rel=0.04)


@pytest.mark.parametrize("dof", [2, 6, 18])
def test_stated_sigmas_that_are_right_stay(dof):
    changed = np.array([scales(1.0, dof, 300, seed) != 1.0 for seed in range(40)])
    assert changed.mean() < 0.02
