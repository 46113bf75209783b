"""Lenses that the models follow, and such that none follows: what is chosen, and that the claim holds."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.lens.fit.lens_models import LensModel, rational_of_fisheye, undistorted
from calibration.lens.intrinsics import IntrinsicsOptions, calibrate_intrinsics
from tests.calibration.lens.random_lenses import corners_of, judged, random_lens


@pytest.mark.slow
def test_a_wide_rational_lens_is_not_taken_for_a_fisheye():
    true = random_lens(2, "rational")
    c = calibrate_intrinsics(corners_of(true, 2, views=12), IntrinsicsOptions(warp=False, stretch=False, folds=3))
    assert c.model == LensModel(8)
    j = judged(true, c)
    assert j.error_px < 2.5 * j.claimed_px
    assert j.error_px < 0.2


def test_a_rational_lens_is_made_that_draws_as_a_fisheye_does():
    wide = np.array([500.0, 501, 640, 505, 0.02, -0.01, 0.002, 0.0, *[0.0] * 10])
    made = rational_of_fisheye(wide, np.deg2rad(60))
    r = 500 * np.deg2rad(np.linspace(5, 50, 10))
    pixels = np.array([640, 505]) + np.stack([r * 0.6, r * 0.8], axis=1)
    np.testing.assert_allclose(undistorted(pixels, made, False), undistorted(pixels, wide, True), atol=2e-3)


@pytest.mark.slow
def test_claims_hold_for_most_random_lenses():
    ratios, unsaid = [], 0
    for seed in range(400, 412):
        true = random_lens(seed)
        c = calibrate_intrinsics(corners_of(true, seed))
        j = judged(true, c)
        ratios.append(j.error_px / j.claimed_px)
        unsaid += ratios[-1] > 3 and c.verdict.name == "PASS"
    # One honest sigma is exceeded 1.3 times by one lens in five: a few modes make most of the error.
    assert np.mean(np.array(ratios) <= 1.3) >= 0.6, ratios
    assert unsaid == 0
