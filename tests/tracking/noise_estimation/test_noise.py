"""The noise model: from a sensor's data sheet and estimated from pictures."""

import warnings
from dataclasses import dataclass, replace
from statistics import NormalDist

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geometry.camera import SensorNoise
from tests.tracking.rendering import Scene, Spot, photograph, round_lights
from tracking.detection.detect import find_spots
from tracking.noise import ROUNDING_DN2, NoiseModel, guess_noise
from tracking.noise_estimation.grey_values import block_step, saturation_level
from tracking.noise_estimation.photon_transfer import estimate_noise
from tracking.rounding import clipped_normal, unrounded

SPOTS = [
    Spot(60 + 70 * i, 60 + 60 * j, 40.0 + 35 * ((i + j) % 5), 2.4, 1.9, 30.0 * i) for i in range(5) for j in range(4)
]


@dataclass
class Lab:
    """A static scene recorded by a sensor: texture, a gradient, bright details, and moving spots."""

    bits: int = 8
    shift: int = 0  # unused low bits of the file's values
    gain: float = 40.0  # electrons per DN
    read_e: float = 6.0
    black: float = 4.0
    background: float = 18.0
    texture: float = 0.04
    spot_peak: float = 150.0
    flicker: float = 0.0
    speed_px: float = 9.0
    details: int = 8
    quality: int | None = None  # of JPEG

    def pictures(self, seed: int, count: int = 6) -> list[np.ndarray]:
        rng = np.random.default_rng(seed)
        h, w = 400, 520
        v, u = np.mgrid[:h, :w]
        grain = cv2.GaussianBlur(rng.standard_normal((h, w)), (0, 0), 1.5)
        albedo = 1 + self.texture * grain / grain.std()
        light = self.background * (1 + 0.4 * (u / w - 0.5)) * albedo
        for x, y in rng.uniform([20, 20], [w - 20, h - 20], (self.details, 2)):
            light += 5 * self.background * (np.hypot(u - x, v - y) < 5)
        start, step = rng.uniform(60, 300, (5, 2)), rng.normal(0, self.speed_px, (5, 2))
        out = []
        for k in range(count):
            lit = light.copy()
            lit += round_lights((h, w), start + k * step, self.spot_peak, 2.2) * albedo
            lit *= 1 + self.flicker * rng.standard_normal()
            noise = np.sqrt(np.maximum(lit, 0) * self.gain + self.read_e**2) / self.gain * rng.standard_normal((h, w))
            grey = np.clip(np.rint(lit + self.black + noise), 0, 2**self.bits - 1)
            picture = (grey * 2**self.shift).astype(np.uint8 if self.bits == 8 else np.uint16)
            if self.quality is not None:
                picture = cv2.imdecode(
                    cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, self.quality])[1], cv2.IMREAD_GRAYSCALE
                )
            out.append(picture)
        return out

    def variance(self, level: float) -> float:
        """Variance, in units of the file, of a pixel at this level, in units of the sensor."""
        own = (max(level - self.black, 0.0) * self.gain + self.read_e**2) / self.gain**2 + ROUNDING_DN2
        return own * 4.0**self.shift


def test_the_variance_of_a_sensor_of_38_electrons_per_dn_is_that_of_its_electrons():
    model = NoiseModel.of(SensorNoise(gain_e_per_dn=38.0, read_noise_e=30.0, black_dn=8.0))
    electrons = (108.0 - 8.0) * 38.0
    assert model.variance(108.0) == pytest.approx((electrons + 30.0**2) / 38.0**2 + ROUNDING_DN2)


@given(st.floats(-50, 5000), st.floats(0, 5000))
def test_more_light_never_has_a_smaller_variance(level, more):
    model = NoiseModel(2.0, 0.03, 10.0)
    assert model.variance(level + more) >= model.variance(level) >= 2.0


@pytest.mark.parametrize(("gain", "read"), [(30.0, 1.5), (10.0, 1.0), (60.0, 3.0)])
def test_noise_is_estimated_from_pictures_of_spots_at_rest(gain, read):
    rng = np.random.default_rng(1)
    scene = Scene(SPOTS, (400, 300), 15.0, (10.0, 5.0), gain=gain, read=read)
    model = estimate_noise([photograph(scene, rng) for _ in range(6)]).model
    for level in (15.0, 60.0, 120.0):
        truth = level / gain + read**2 + ROUNDING_DN2
        assert 0.8 * truth < model.variance(level) < 1.3 * truth


@pytest.mark.parametrize("read_e", [3.0, 12.0])
def test_black_places_of_a_scene_have_the_noise_of_their_light(read_e):
    """A board whose black squares have an eighth of the light: a photon noise of a third."""
    lab = Lab(texture=0.0, details=0, background=64.0, gain=20.0, read_e=read_e)
    rng, light = np.random.default_rng(4), np.full((400, 520), lab.background)
    light[:, 320:] /= 8
    noise = np.sqrt(light * lab.gain + lab.read_e**2) / lab.gain
    pictures = [np.rint(light + lab.black + noise * rng.standard_normal(light.shape)) for _ in range(6)]
    model = estimate_noise([p.astype(np.uint8) for p in pictures]).model
    for level in (68.0, 12.0):
        assert lab.variance(level) / 1.3 < model.variance(level) < 1.3 * lab.variance(level)


@pytest.mark.parametrize(
    "lab",
    [
        Lab(),
        Lab(texture=0.0, details=0),
        Lab(speed_px=0.0),
        Lab(flicker=0.03),
        Lab(bits=12, gain=3.0, background=300.0, black=60.0, spot_peak=2400.0),
        Lab(bits=12, shift=4, gain=3.0, background=300.0, black=60.0, spot_peak=2400.0),
        Lab(bits=10, gain=12.0, background=60.0, black=20.0, spot_peak=500.0),
        Lab(bits=16, gain=0.4, read_e=3.0, background=5000.0, black=1000.0, spot_peak=38_000.0),
        Lab(gain=160.0, read_e=3.0),
        Lab(background=80.0, texture=0.06, spot_peak=300.0),
    ],
    ids=["usual", "plain", "at rest", "flicker", "12 bit", "12 of 16", "10 bit", "16 bit", "fine steps", "clipped"],
)
def test_the_structure_of_a_scene_does_not_count_as_noise(lab):
    """Texture of 4 %, edges, moving spots and changing light: within 1.3 at the background, 2 at half of full scale."""
    model = estimate_noise(lab.pictures(3)).model
    level, half = lab.background + lab.black, 0.5 * (2**lab.bits - 1)
    at = 2.0**lab.shift
    assert lab.variance(level) / 1.3 < model.variance(level * at) < 1.3 * lab.variance(level)
    assert lab.variance(half) / 2 < model.variance(half * at) < 2 * lab.variance(half)


def test_without_light_between_background_and_spots_the_prior_bounds_the_slope():
    """Texture of 8 % in 16 bits is 500 times the shot noise of a spot: its residuals do not determine the slope."""
    lab = Lab(bits=16, gain=0.4, read_e=3.0, background=20.0, black=500.0, details=0, texture=0.08, spot_peak=30_000.0)
    for seed in range(2, 6):
        assert 0.1 < estimate_noise(lab.pictures(seed)).model.slope_dn * lab.gain < 10


@pytest.mark.parametrize("quality", [70, 95])
def test_the_model_from_compressed_pictures_finds_their_spots(quality):
    lab = Lab(quality=quality)
    pictures = lab.pictures(5)
    model = estimate_noise(pictures).model
    assert min(len(find_spots(p, noise=model)) for p in pictures) >= 5


def test_the_noise_of_a_background_clipped_at_black_is_recovered():
    rng = np.random.default_rng(6)
    model = estimate_noise(
        [np.clip(np.rint(rng.normal(0.3, 2.0, (300, 400))), 0, 255).astype(np.uint8) for _ in range(4)]
    ).model
    assert model.variance(0.0) == pytest.approx(4.0, rel=0.25)


@given(st.floats(-1.0, 3.0), st.floats(1.0, 6.0))
def test_mean_and_sigma_of_clipped_values_are_recovered(mean, sigma):
    places = (np.arange(4000) + 0.5) / 4000
    values = np.rint([NormalDist(mean, sigma).inv_cdf(p) for p in places]).clip(0)
    got = clipped_normal(values)
    assert got == pytest.approx((mean, sigma), abs=0.15 * sigma)


@pytest.mark.parametrize("mean", [0.0, 0.2, 0.45, 0.55, 0.8])
@pytest.mark.parametrize("sigma", [0.15, 0.3, 0.5, 1.0])
def test_a_quiet_background_near_black_is_not_taken_for_a_noisy_one(mean, sigma):
    """It has two grey values only, of which one share follows. A variance of 77 times the true one hid the spots."""
    values = np.clip(np.rint(np.random.default_rng(3).normal(mean, sigma, 20_000)), 0, None)
    found = clipped_normal(values)[1] ** 2 + ROUNDING_DN2
    assert 0.7 < found / (sigma**2 + ROUNDING_DN2) < 3.5


def test_reflections_over_half_of_a_black_picture_are_not_noise():
    rng = np.random.default_rng(4)
    light = np.zeros((400, 520))
    light[:, 180:] = np.linspace(0, 25, 340)
    pictures = [
        np.rint(0.4 + light + 0.3 * rng.standard_normal(light.shape)).clip(0).astype(np.uint8) for _ in range(4)
    ]
    assert float(estimate_noise(pictures).model.floor_dn2) < 2.5 * (0.3**2 + ROUNDING_DN2)


@pytest.mark.parametrize("sigma", [0.1, 0.25, 0.4, 0.7, 2.0])
def test_the_rounding_error_that_is_constant_in_time_is_added(sigma):
    rng = np.random.default_rng(7)
    level = rng.uniform(0, 50, 60_000)
    a, b = (np.rint(level + sigma * rng.standard_normal(level.size)) for _ in range(2))
    assert unrounded(float(np.mean((a - b) ** 2) / 2), ROUNDING_DN2) == pytest.approx(sigma**2 + 1 / 12, rel=0.06)


@pytest.mark.parametrize(("bits", "shift"), [(10, 0), (12, 0), (12, 4)])
def test_the_clipping_level_is_the_largest_value_of_the_sensor(bits, shift):
    """Not 65535, which no 12-bit camera writes."""
    full = 2**bits - 1
    lab = Lab(
        bits=bits, shift=shift, gain=20_000 / full, background=0.05 * full, black=0.01 * full, spot_peak=2.0 * full
    )
    assert estimate_noise(lab.pictures(8)).saturation_dn == full * 2**shift


def test_a_bright_picture_that_does_not_clip_has_no_saturation_level():
    lab = Lab(bits=12, gain=5.0, background=300.0, spot_peak=3000.0)
    assert saturation_level(lab.pictures(9), 1.0) is None


def test_copies_of_one_picture_do_not_count_as_a_noiseless_sensor():
    """Recorders repeat the previous picture in place of a dropped one."""
    picture = Lab().pictures(10, 1)[0]
    estimate = estimate_noise([picture, picture.copy()])
    assert not estimate.temporal
    assert estimate.model.variance(22.0) > 0.7 * Lab().variance(22.0)


def test_noise_that_is_correlated_between_pixels_is_not_underestimated():
    """As in JPEG pictures: differences of neighbours underestimate smoothed noise, which affects wide spots."""
    rng = np.random.default_rng(2)
    white = rng.normal(0, 6, (400, 600))
    kernel = np.array([0.25, 0.5, 0.25])
    for axis in (0, 1):
        white = np.apply_along_axis(np.convolve, axis, white, kernel, "same")
    image = np.rint(60 + white).astype(np.uint8)
    assert estimate_noise([image]).model.floor_dn2 > 0.8 * white.var()


@pytest.mark.parametrize("bits", [8, 16])
def test_the_quick_model_has_the_noise_of_the_background(bits):
    scale = 1 if bits == 8 else 100
    rng = np.random.default_rng(3)
    image = np.rint(rng.normal(20 * scale, 2.0 * scale, (300, 400))).astype(np.uint8 if bits == 8 else np.uint16)
    model = guess_noise(image)
    assert model.variance(20 * scale) == pytest.approx((2.0 * scale) ** 2, rel=0.25)


@pytest.mark.parametrize("background", [-1.0, 0.0, 1.0])
@pytest.mark.parametrize("sigma", [1.0, 2.0, 4.0])
def test_the_quick_model_sees_the_noise_that_is_clipped_at_black(background, sigma):
    """Otherwise the longer tail of the pixels above zero looks like spots."""
    rng = np.random.default_rng(4)
    image = np.clip(np.rint(rng.normal(background, sigma, (600, 800))), 0, 255).astype(np.uint8)
    assert guess_noise(image).floor_dn2 == pytest.approx(sigma**2, rel=0.35)
    assert len(find_spots(image)) == 0


def test_black_pictures_with_spots_give_a_model_without_warnings():
    """Only the pixels of the spots are above zero, as behind a filter."""
    pictures = [np.zeros((300, 400), np.uint8) for _ in range(4)]
    for k, picture in enumerate(pictures):
        cv2.circle(picture, (100 + 40 * k, 120), 3, 140, -1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = estimate_noise(pictures).model
    assert model.floor_dn2 == pytest.approx(ROUNDING_DN2, rel=0.5)
    assert all(len(find_spots(p, noise=model)) == 1 for p in pictures)


@pytest.mark.parametrize("value", [0, 255])
@pytest.mark.parametrize("shape", [(1, 1), (3, 50), (0, 0), (9, 9), (40, 40), (300, 400)])
def test_the_noise_of_uniform_pictures_is_that_of_rounding(shape, value):
    image = np.full(shape, value, np.uint8)
    assert guess_noise(image).floor_dn2 == pytest.approx(ROUNDING_DN2)
    for pictures in ([image], [image, image.copy(), image.copy()]):
        model = estimate_noise(pictures).model
        assert model.floor_dn2 == pytest.approx(ROUNDING_DN2)
        assert np.isfinite(model.variance(200.0))


def test_an_empty_list_and_a_model_without_noise_are_rejected():
    with pytest.raises(ValueError, match="at least one picture"):
        estimate_noise([])
    with pytest.raises(ValueError, match="floor_dn2 > 0"):
        NoiseModel(0.0, 0.1)


@pytest.mark.parametrize("size", [(40, 32), (100, 60), (160, 120)])
def test_the_noise_of_pictures_too_small_for_levels_is_estimated(size):
    rng = np.random.default_rng(5)
    scene = Scene([Spot(size[0] / 2, size[1] / 2, 3000.0, 1, 1)], size=size, background=200.0, read=20.0)
    estimate = estimate_noise([photograph(scene, rng, bits=16) for _ in range(2)])
    true = 20.0**2 + 200.0 / scene.gain
    assert 1 / 1.6 < float(estimate.model.variance(200.0)) / true < 1.6
    assert not estimate.temporal  # no differences in time


def test_steps_of_compressed_blocks_are_not_spots():
    """Noise below the quantisation of JPEG: whole blocks of 8x8 pixels are one grey value brighter in some pictures."""
    lab = Lab(gain=27.0, read_e=7.6, texture=0.0, details=0, background=8.0, speed_px=0.0, spot_peak=0.0, quality=80)
    pictures = lab.pictures(5)
    assert block_step(pictures) == 1.0
    model = estimate_noise(pictures).model
    assert sum(len(find_spots(p, noise=replace(model, banding_dn=0.0))) for p in pictures) > 5
    assert sum(len(find_spots(p, noise=model)) for p in pictures) == 0


def test_places_of_spots_in_compressed_pictures_have_the_stated_sigmas():
    """NEES/2 is .96 to 1.55 on four seeds; .3 without the variance of the compression, and with nine times as much."""
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(60 + 80.0 * np.arange(5), 60 + 70.0 * np.arange(4)), axis=-1).reshape(-1, 2)
    places = grid + rng.uniform(-8, 8, (6, len(grid), 2))
    pictures = []
    for at in places:
        light = 8.0 + round_lights((340, 440), at, 100.0, 1.5)
        grey = np.rint(light + 4 + np.sqrt(light * 27 + 7.6**2) / 27 * rng.standard_normal(light.shape))
        coded = cv2.imencode(".jpg", grey.clip(0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
        pictures.append(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE))
    model = estimate_noise(pictures).model
    assert model.compression_dn2 > 0
    chi2 = []
    for picture, at in zip(pictures, places, strict=True):
        found = find_spots(picture, noise=model)
        offset = found.uv_px - at[:, None]
        nearest = np.argmin(np.linalg.norm(offset, axis=-1), axis=1)
        e, C = offset[np.arange(len(at)), nearest], found.cov_px2[nearest]
        chi2.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(C), e))
    assert 0.6 < np.mean(chi2) / 2 < 1.7


@pytest.mark.parametrize("lab", [Lab(), Lab(gain=160.0, read_e=3.0), Lab(speed_px=0.0), Lab(flicker=0.03)])
def test_pictures_without_compression_have_no_steps_of_blocks(lab):
    assert block_step(lab.pictures(3)) == 0.0


def test_black_objects_of_a_photograph_are_no_clipped_noise():
    """A few of their pixels are zero, and the grey values of the darkest quarter scatter by 6; the noise is 1."""
    rng = np.random.default_rng(3)
    light = np.full((480, 640), 45.0)
    light[:, :240] = 12.0 + cv2.GaussianBlur(rng.normal(0.0, 140.0, (480, 240)), (0, 0), 6.0)
    still = np.clip(light, 0.0, None)
    pictures = [np.rint(still + rng.normal(0.0, 1.0, still.shape)).clip(0, 255).astype(np.uint8) for _ in range(4)]
    assert 0.005 < np.mean(pictures[0] == 0) < 0.05
    assert estimate_noise(pictures).model.floor_dn2 == pytest.approx(1.0, rel=0.3)
    assert guess_noise(pictures[0]).floor_dn2 < 2.0
