"""Interpolation and rates of recorded motions, their differences and statistics."""

from __future__ import annotations

import numpy as np
import pytest

from geometry import rotations
from tests.tracking.comparison.motions import TRUTH, recordings, smooth
from tracking.comparison.differences import chi_square, differences, longest_still, statistic
from tracking.comparison.estimation import Freedom, estimate_alignment
from tracking.comparison.frame_alignment import PoseSeries, interpolate, rates


def exact(t):
    return PoseSeries(t, *smooth(t), np.zeros((len(t), 6, 6)))


def test_the_cubic_reproduces_a_smooth_motion():
    motion = exact(np.arange(0, 4, 0.05))
    t = np.random.default_rng(1).uniform(0.1, 3.8, 200)
    there = interpolate(motion, t)
    R, p = smooth(t)
    assert np.max(rotations.angle(np.swapaxes(R, -1, -2) @ there.rotation)) < 1e-5
    np.testing.assert_allclose(there.position_m, p, atol=1e-5)


def test_samples_are_returned_as_they_are_and_gaps_are_not_bridged():
    t = np.delete(np.arange(0, 2, 0.1), [8, 9, 10])
    motion = exact(t)
    there = interpolate(motion, np.concatenate([t, [0.85, 0.95, -1.0, 5.0]]))
    np.testing.assert_allclose(there.position_m[: len(t)], motion.position_m, atol=1e-9)
    assert there.known.tolist() == [True] * len(t) + [False] * 4
    assert np.all(np.isnan(there.position_m[-4:]))


def test_rates_are_the_derivatives():
    t = np.arange(0, 4, 0.01)
    found = rates(exact(t))[10:-10]
    R, p = smooth(t)
    np.testing.assert_allclose(found[:, :3], np.gradient(p, t, axis=0)[10:-10], atol=2e-4)
    turned = rotations.log(np.swapaxes(R[:-2], -1, -2) @ R[2:]) / 0.02
    np.testing.assert_allclose(found[:, 3:], turned[9:-9], atol=5e-3)


def test_an_interpolated_pose_and_a_rate_depend_on_the_samples_around_them_alone():
    t = np.arange(12) * 0.1
    known = exact(t)
    between, on = np.array([0.52]), 5
    for k in range(len(t)):
        position = known.position_m.copy()
        position[k] += 1.0
        covariance = known.covariance.copy()
        covariance[k] += np.eye(6)
        other = PoseSeries(t, known.rotation, position, covariance)
        there = interpolate(other, between)
        assert bool(np.any(there.position_m != interpolate(known, between).position_m)) == (4 <= k <= 7)
        assert bool(there.covariance.any()) == (k == 5)  # of the nearest
        moved = np.abs(rates(other)[on] - rates(known)[on]).max() > 1e-12
        assert bool(moved) == (k in (2, 3, 4, 6, 7, 8))


def test_a_motion_needs_content_and_rising_times():
    with pytest.raises(ValueError, match="attitudes, positions"):
        PoseSeries(np.arange(3.0), None, None, np.zeros((3, 6, 6)))
    with pytest.raises(ValueError, match="rising"):
        PoseSeries(np.zeros(3), None, np.zeros((3, 3)), np.zeros((3, 6, 6)))


def test_differences_at_the_true_alignment_agree_with_the_stated_covariances():
    result, reference = recordings(4, frames=600)
    found = differences(result, reference, TRUTH)
    c = chi_square(found.chi2, found.freedom, found.known, Freedom())
    assert found.freedom == 6
    # Interpolation averages the reference's noise, which is a fifth of the variance: slightly below 1.
    assert 0.8 < c.factor < 1.05
    assert 0.93 < c.within <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("alike", "frames"),
    [pytest.param(0.0, 120, marks=pytest.mark.slow), (4.0, 120), pytest.param(8.0, 240, marks=pytest.mark.slow)],
)
def test_poses_with_errors_that_are_alike_for_many_frames_agree_with_their_covariances(alike, frames):
    """Each parameter takes as many degrees of freedom as frames are alike: without them chi-square is .5 or less."""
    factors, sigmas = [], []
    for seed in range(24):
        result, reference = recordings(seed, frames=frames, reference_sigmas=(1e-6, 1e-6), alike=alike)
        e = estimate_alignment(result, reference, offset_s=TRUTH.offset_s)
        found = differences(result, reference, e.alignment)
        c = chi_square(found.chi2, found.freedom, found.known & e.inliers, e.freedom)
        factors.append(c.factor)
        sigmas.append(c.sigma)
    assert np.mean(factors) == pytest.approx(1.0, abs=0.12)
    assert np.mean(sigmas) == pytest.approx(np.std(factors), rel=0.5)


def test_the_sigmas_of_statistics_are_those_of_repeated_experiments():
    rng = np.random.default_rng(5)
    figures = [statistic(rng.normal(0.5, 2.0, 900)) for _ in range(120)]
    for value, sigma in (("mean", "mean_sigma"), ("rms", "rms_sigma"), ("median", "median_sigma")):
        scatter = np.std([getattr(f, value) for f in figures])
        assert np.mean([getattr(f, sigma) for f in figures]) == pytest.approx(scatter, rel=0.25)


def test_unknown_values_are_left_out_of_statistics():
    f = statistic(np.array([np.nan, 1.0, -4.0, 1.0, 1.0, np.nan]))
    assert (f.largest, f.largest_index, f.median) == (4.0, 2, 1.0)
    assert statistic(np.full(9, np.nan)) is None


def test_the_longest_stationary_stretch_is_found():
    t = np.arange(0, 12, 0.02)
    yaw = np.where(t < 3, 0.0, np.where(t < 5, 0.1 * (t - 3), 0.2))
    noise = 1e-4 * np.random.default_rng(6).standard_normal((len(t), 3))
    rotation = rotations.exp(np.stack([0 * t, 0 * t, yaw], -1)) @ rotations.exp(noise)
    covariance = np.zeros((len(t), 6, 6))
    covariance[:] = 1e-8 * np.eye(6)
    where = longest_still(PoseSeries(t, rotation, None, covariance), 64)
    assert 5.0 <= t[where][0] < 5.5
    assert t[where][-1] == t[-1]
    assert longest_still(PoseSeries(t, rotation, None, covariance), 5000) is None
