"""The slope of a sensor's noise from the residuals of fitted spots, whose light may have a grain."""

import numpy as np
import pytest

from tracking.noise_estimation.photon_transfer import _Lines
from tracking.noise_estimation.spot_residuals import SpotResiduals

FLOOR, SLOPE, BACKGROUND = 2.0, 0.05, 10.0  # DN^2, DN, DN


@pytest.mark.parametrize(("contrast", "known_to"), [(0.0, 0.13), (0.02, 0.23), (0.05, 0.23)])
def test_spots_without_grain_determine_the_slope_and_grain_is_not_taken_for_it(contrast, known_to):
    """By the prior alone its logarithm has a sigma of 0.38 here. The grain's own scatter is not determined either."""
    off = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        light = rng.uniform(2, 200, 6000)
        variance = FLOOR + SLOPE * light + (contrast * light) ** 2
        lines = _Lines.from_point(BACKGROUND, FLOOR, 255.0)
        lines.add(SpotResiduals(BACKGROUND + light, light, light, variance * rng.chisquare(1, 6000)))
        slope, sigma = lines.slope(1 / 12)
        assert sigma < known_to
        off.append(np.log(slope / SLOPE) / sigma)
    assert np.abs(off).max() < 3.0
