"""Allan deviations of noise with a known level and slope, and the coverage of the confidence limits."""

from __future__ import annotations

import numpy as np
import pytest

from tracking.comparison.differences import allan_deviation


def test_white_noise_falls_with_the_root_of_the_averaging_time():
    a = allan_deviation(np.random.default_rng(1).normal(5.0, 0.3, 20_000), 0.01)
    few = a.averaged <= 256
    np.testing.assert_allclose(a.deviation[few], 0.3 / np.sqrt(a.averaged[few]), rtol=0.12)
    np.testing.assert_allclose(a.tau_s, 0.01 * a.averaged)
    assert np.polyfit(np.log(a.tau_s[few]), np.log(a.deviation[few]), 1)[0] == pytest.approx(-0.5, abs=0.03)


def test_a_random_walk_rises_with_the_root_of_the_averaging_time():
    steps = np.random.default_rng(2).normal(0.0, 0.1, 20_000)
    a = allan_deviation(np.cumsum(steps), 0.01)
    some = (a.averaged >= 8) & (a.averaged <= 256)
    assert np.polyfit(np.log(a.tau_s[some]), np.log(a.deviation[some]), 1)[0] == pytest.approx(0.5, abs=0.08)
    # Long averages of m steps: sigma^2 = m q^2 / 3 (NIST SP 1065, random walk FM).
    np.testing.assert_allclose(a.deviation[some], 0.1 * np.sqrt(a.averaged[some] / 3), rtol=0.15)


def test_a_linear_drift_rises_in_proportion():
    a = allan_deviation(0.02 * np.arange(1000), 1.0)
    np.testing.assert_allclose(a.deviation, 0.02 * a.averaged / np.sqrt(2), rtol=1e-9)


@pytest.mark.parametrize(("kind", "level"), [("white", -0.5), ("walk", 0.5)])
def test_the_limits_contain_the_true_deviation_in_about_95_of_100_cases(kind, level):
    rng = np.random.default_rng(3)
    inside = []
    for _ in range(150):
        noise = rng.standard_normal(512)
        a = allan_deviation(noise if kind == "white" else np.cumsum(noise), 1.0)
        m = a.averaged.astype(float)
        # The variance of the difference of neighbouring averages; for a walk with its discrete correction.
        true = m**-0.5 if kind == "white" else np.sqrt((2 * m**2 + 1) / (6 * m))
        inside.append((a.low <= true) & (true <= a.high))
    coverage = np.mean(inside, axis=0)
    assert np.all(coverage[:-1] > 0.85)
    assert 0.9 < coverage[: len(coverage) // 2 + 1].mean() < 0.99


@pytest.mark.parametrize("readings", [np.zeros(5), np.full(100, np.nan)])
def test_too_few_or_unknown_readings_are_refused(readings):
    with pytest.raises(ValueError, match="finite readings"):
        allan_deviation(readings, 1.0)


def test_equal_readings_have_no_deviation():
    assert np.all(allan_deviation(np.full(64, 3.0), 1.0).deviation == 0.0)
