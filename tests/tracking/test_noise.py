"""The noise model: from a sensor's data sheet, and estimated from pictures."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geometry.camera import SensorNoise
from tests.tracking.rendering import Scene, Spot, photograph
from tracking.noise import ROUNDING_DN2, NoiseModel, guess_noise
from tracking.noise_estimation.photon_transfer import estimate_noise

SPOTS = [
    Spot(60 + 70 * i, 60 + 60 * j, 40.0 + 35 * ((i + j) % 5), 2.4, 1.9, 30.0 * i) for i in range(5) for j in range(4)
]


def test_a_sensor_of_38_electrons_per_dn_scatters_as_its_electrons_do():
    model = NoiseModel.of(SensorNoise(gain_e_per_dn=38.0, read_noise_e=30.0, black_dn=8.0))
    electrons = (108.0 - 8.0) * 38.0
    assert model.variance(108.0) == pytest.approx((electrons + 30.0**2) / 38.0**2 + ROUNDING_DN2)


@given(st.floats(-50, 5000), st.floats(0, 5000))
def test_more_light_never_scatters_less(level, more):
    model = NoiseModel(2.0, 0.03, 10.0)
    assert model.variance(level + more) >= model.variance(level) >= 2.0


@pytest.mark.parametrize(("gain", "read"), [(30.0, 1.5), (10.0, 1.0), (60.0, 3.0)])
def test_noise_is_estimated_from_pictures_of_spots(gain, read):
    rng = np.random.default_rng(1)
    scene = Scene(SPOTS, (400, 300), 15.0, (10.0, 5.0), gain=gain, read=read)
    model = estimate_noise([photograph(scene, rng) for _ in range(6)]).model
    for level in (15.0, 60.0, 120.0):
        truth = level / gain + read**2 + ROUNDING_DN2
        assert 0.8 * truth < model.variance(level) < 1.3 * truth


def test_noise_that_goes_together_over_pixels_is_not_taken_for_less():
    """As in JPEG pictures: smoothed noise is invisible to differences, but not to a spot several pixels wide."""
    rng = np.random.default_rng(2)
    white = rng.normal(0, 6, (400, 600))
    kernel = np.array([0.25, 0.5, 0.25])
    for axis in (0, 1):
        white = np.apply_along_axis(np.convolve, axis, white, kernel, "same")
    image = np.rint(60 + white).astype(np.uint8)
    assert estimate_noise([image]).model.floor_dn2 > 0.8 * white.var()


@pytest.mark.parametrize("bits", [8, 16])
def test_a_quick_guess_knows_the_background_noise(bits):
    scale = 1 if bits == 8 else 100
    rng = np.random.default_rng(3)
    image = np.rint(rng.normal(20 * scale, 2.0 * scale, (300, 400))).astype(np.uint8 if bits == 8 else np.uint16)
    model = guess_noise(image)
    assert model.variance(20 * scale) == pytest.approx((2.0 * scale) ** 2, rel=0.25)


@pytest.mark.parametrize("shape", [(1, 1), (3, 50), (0, 0), (9, 9)])
def test_pictures_too_small_to_tell_leave_the_rounding(shape):
    assert guess_noise(np.zeros(shape, np.uint8)).floor_dn2 == pytest.approx(ROUNDING_DN2)
    assert estimate_noise([np.zeros(shape, np.uint8)]).model.floor_dn2 == pytest.approx(ROUNDING_DN2)


def test_no_picture_and_no_noise_are_refused():
    with pytest.raises(ValueError, match="at least one picture"):
        estimate_noise([])
    with pytest.raises(ValueError, match="floor_dn2 > 0"):
        NoiseModel(0.0, 0.1)
