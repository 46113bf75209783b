"""The strength of the jerk is estimated by axis and by time, and kept where the data do not determine it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geometry.arrays import Array
from tests.marks import further_slow
from tests.tracking.smoothing.test_fixed_interval import Run, drawn
from tracking.smoothing.motion.fixed_interval import smoothed
from tracking.smoothing.motion.process_noise import LOG_RANGE, largest_jumps, next_log_density
from tracking.smoothing.motion.whole_run import GLOBAL_PASSES

FRAMES = 300
START = np.full((FRAMES, 6), 2 * np.log(30.0))


def estimated(run: Run, passes: int = 14, whole_run_first: int = GLOBAL_PASSES) -> tuple[Array, float]:
    """Logarithms (T, 6) of the strengths after so many passes, and the largest change of the last pass."""
    log_density, change = START, np.inf
    usable = np.arange(len(START)) > 0
    for number in range(passes):
        before = log_density
        out = smoothed(run.ref, run.info, np.exp(before), True)
        assert np.isfinite(out.x).all()
        log_density = next_log_density(before, out, usable, local=number >= whole_run_first)
        change = float(np.abs(log_density - before).max())
    return log_density, change


def test_each_axis_converges_to_its_true_jerk():
    # From 5 m/s^3 to 500 rad/s^3 per sqrt(Hz): the range that the spots of this run determine.
    jerk = np.array([5.0, 50.0, 200.0, 20.0, 500.0, 100.0]) ** 2
    of = [np.median(estimated(drawn(seed, FRAMES, jerk=jerk))[0], axis=0) for seed in range(3)]
    # With 12 determined components the sigma of the logarithm is 0.4 per window, and 0.15 for a run of 300 frames.
    np.testing.assert_allclose(np.mean(of, axis=0), np.log(jerk), atol=0.5)


def test_one_strength_for_the_whole_run_converges_to_the_true_jerk():
    jerk = np.array([5.0, 50.0, 200.0, 20.0, 500.0, 100.0]) ** 2
    of = [np.median(estimated(drawn(seed, FRAMES, jerk=jerk), 20, 20)[0], axis=0) for seed in range(3)]
    np.testing.assert_allclose(np.mean(of, axis=0), np.log(jerk), atol=0.4)


def test_with_more_passes_the_strengths_of_one_steady_motion_do_not_drift_apart():
    run = drawn(1, FRAMES, jerk=np.repeat([20.0, 60.0], 3) ** 2)
    few, many = estimated(run, 14)[0], estimated(run, 40)[0]
    # Windows of 12 determined components: their logarithms scatter by 0.4, with pseudo-counts a little less.
    assert np.all(np.std(many, axis=0) < np.std(few, axis=0) + 0.8)
    np.testing.assert_allclose(np.median(many, axis=0), np.log(run.jerk[0]), atol=0.8)


def test_each_half_of_a_run_has_its_own_jerk():
    weak, strong = np.repeat([10.0, 30.0], 3) ** 2, np.repeat([200.0, 600.0], 3) ** 2
    jerk = np.where(np.arange(FRAMES)[:, None] < FRAMES // 2, weak, strong)
    log_density, _ = estimated(drawn(4, FRAMES, jerk=jerk))
    first, second = np.median(log_density[20:130], axis=0), np.median(log_density[170:280], axis=0)
    np.testing.assert_allclose(first, np.log(weak), atol=1.0)
    np.testing.assert_allclose(second, np.log(strong), atol=1.0)


def test_in_uniform_motion_the_jerk_falls_until_the_data_no_longer_determine_it():
    run = drawn(5, FRAMES, jerk=np.zeros(6))
    log_density, _ = estimated(run)
    assert np.all(log_density > LOG_RANGE[0])
    assert np.all(log_density < START)
    out = smoothed(run.ref, run.info, np.exp(log_density), True)
    d = out.x - run.true
    chi2 = [d[k, :6] @ np.linalg.solve(out.pose_P[k], d[k, :6]) / 6 for k in range(0, FRAMES, 10)]
    # In uniform motion all frames share some 18 errors.
    assert np.mean(chi2) < 2.5


def test_velocity_jumps_that_are_allowed_for_say_nothing_about_the_jerk():
    """Steps where a jump is possible but none happens, as about a gap, once pulled the strength down to its floor."""
    ratios = []
    for seed in range(3):
        run = drawn(seed, FRAMES, jerk=np.repeat([5.0, 15.0], 3) ** 2)
        variances = np.array(run.info.velocity_jump)
        variances[np.arange(FRAMES) % 60 < 20] = 1.0
        possible = replace(run, info=run.info._replace(velocity_jump=variances, acceleration_jump=100 * variances))
        ratios.append(np.median(estimated(possible)[0], axis=0) - np.log(run.jerk[0]))
    np.testing.assert_allclose(np.mean(ratios, axis=0), 0, atol=0.8)


def test_a_run_without_spots_keeps_its_jerk():
    run = drawn(6, FRAMES, without_spots=slice(0, FRAMES))
    np.testing.assert_array_equal(estimated(run, 8)[0], START)


def test_steps_with_a_velocity_jump_are_left_out():
    run = drawn(7, FRAMES, jump_at=150)
    out = smoothed(run.ref, run.info, np.exp(START), True)
    usable = np.arange(FRAMES) > 0
    with_jump = next_log_density(START, out, usable, local=True)
    usable[140:160] = False
    without_jump = next_log_density(START, out, usable, local=True)
    assert np.all(with_jump[150] > without_jump[150])


@pytest.mark.parametrize(("amplitude", "largest"), further_slow([(0.3, 1.6), (0.6, 1.5), (0.0, 1.4)]))
def test_covariances_are_right_where_one_axis_moves_less_than_the_noise(amplitude, largest):
    """amplitude: of a sine in the rotation about x, in sigmas of one frame's own pose."""
    jerk = np.array([20.0, 50.0, 50.0, 1e-4, 100.0, 100.0]) ** 2
    squares = []
    for seed in range(60, 64):
        run = drawn(seed, FRAMES, jerk=jerk)
        L = run.info.information
        sigma = np.mean(np.sqrt(np.linalg.inv(L)[:, 3, 3]))
        sine = amplitude * sigma * np.sin(2 * np.pi * (2 + 2 * (seed % 3)) * np.cumsum(run.info.dt))
        run = replace(run, info=run.info._replace(vector=run.info.vector + L[:, :, 3] * sine[:, None]))
        log_density, _ = estimated(run)
        out = smoothed(run.ref, run.info, np.exp(log_density), True)
        squares.append((run.true[:, 3] + sine - out.x[:, 3]) ** 2 / out.pose_P[:, 3, 3])
    assert 0.6 < np.mean(squares) < largest


def test_in_a_gap_the_velocities_may_jump_as_far_as_at_either_of_its_ends():
    """Spots that are seen to turn away at one end come back as fast; the other end is calm."""
    run = drawn(1, FRAMES)
    velocities = np.zeros_like(run.ref.m)
    velocities[95:100, 3] = 7.0
    measured = (np.arange(FRAMES) < 100) | (np.arange(FRAMES) >= 250)
    variance = largest_jumps(run.ref._replace(m=velocities), measured, run.info.dt)
    assert np.all(variance[100:251] == variance[100:251].max(axis=0))
    assert np.all(variance[100:251, 1] >= 7.0**2)
    assert np.all(variance[260:, 1] < 1.0)
