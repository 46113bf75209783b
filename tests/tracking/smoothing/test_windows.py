"""Moving windows against scipy.ndimage."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from tracking.smoothing.motion.process_noise import largest_near, window_mean


@pytest.mark.parametrize("frames", [1, 2, 7, 50, 301])
@pytest.mark.parametrize("half", [0, 1, 2, 3, 7, 20, 1000])
def test_the_moving_maximum_is_scipys(frames, half):
    rng = np.random.default_rng(frames)
    for values in (rng.normal(size=frames), rng.normal(size=(frames, 3))):
        np.testing.assert_array_equal(
            largest_near(values, half), maximum_filter1d(values, 2 * half + 1, axis=0, mode="nearest")
        )
    some = rng.random(frames) < 0.1
    wanted = maximum_filter1d(some.astype(np.int8), 2 * half + 1, mode="constant")
    got = largest_near(some, half)
    assert got.dtype == bool
    np.testing.assert_array_equal(got, wanted)


def test_the_moving_maximum_of_an_empty_series_is_empty():
    assert largest_near(np.empty(0), 3).shape == (0,)


@pytest.mark.parametrize("frames", [1, 2, 7, 50, 301])
@pytest.mark.parametrize("width", [1, 2, 3, 4, 9, 50])
def test_the_moving_mean_is_bit_identical_to_scipys(frames, width):
    if width > frames:
        pytest.skip("no wider than the series")
    values = 10 ** np.random.default_rng(width).uniform(-5, 5, frames)
    np.testing.assert_array_equal(window_mean(values, width), uniform_filter1d(values, width, mode="constant"))
