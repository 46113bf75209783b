"""Lights at rest: each is measured as precisely as by a fit, and searched again where it changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.tracking.rendering import round_lights
from tracking.background.estimation import static_background
from tracking.background.resting_lights import RestingLights
from tracking.detection.detect import find_spots
from tracking.noise import NoiseModel
from tracking.noise_estimation.texture_shift import TextureShift
from tracking.parameters import DetectParameters

SIZE = (320, 400)
NOISE = NoiseModel(1.0 + 1 / 12, 0.02, 20.0)
LAMPS = np.array([  # u, v, peak, sigma
    [60.3, 50.7, 90.0, 1.6], [200.1, 80.4, 140.0, 2.4], [310.8, 60.2, 60.0, 5.0], [120.5, 240.9, 110.0, 1.3],
    [330.2, 250.6, 70.0, 3.1],
])  # fmt: skip
USUAL = DetectParameters(saturation_dn=255.0)


def light(u: float, v: float, peak: float, sigma: float) -> np.ndarray:
    return round_lights(SIZE, (u, v), peak, sigma)


def pictures(spots: np.ndarray, seed: int, shift_px: float = 0.0) -> list[np.ndarray]:
    """Pictures of the lamps, moved by shift_px, with a spot of 90 grey values at each of these places (n, 2)."""
    rng = np.random.default_rng(seed)
    still = 20.0 + sum(light(u + shift_px, v, peak, sigma) for u, v, peak, sigma in LAMPS)
    out = []
    for u, v in spots:
        expected = still + light(u, v, 90.0, 1.5)
        noisy = expected + np.sqrt(1.0 + 0.02 * (expected - 20.0)) * rng.standard_normal(SIZE)
        out.append(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    return out


def along(n: int, row: float = 160.0) -> np.ndarray:
    """A path across the picture, away from the lamps in row 160."""
    return np.column_stack([np.linspace(30, 370, n), np.full(n, row)])


def lamps_of(seen: list[np.ndarray]) -> RestingLights:
    mean = np.mean(seen, axis=0).astype(np.float32)
    found = find_spots(
        np.rint(16 * mean).astype(np.uint16), DetectParameters(), NoiseModel(16**2 * 1.08, 16 * 0.02, 320.0)
    )
    found = replace(found, flux=found.flux / 16, peak=found.peak / 16)
    near = [int(np.argmin(np.hypot(*(found.uv_px - lamp[:2]).T))) for lamp in LAMPS]
    return RestingLights.of(mean, found[np.array(near)], NOISE, 255.0)


@pytest.mark.parametrize("shift_px", [0.0, 0.1, -0.2])
def test_a_step_measures_a_light_as_precisely_as_a_fit(shift_px):
    """Errors over the sigmas that a single fit states, in 60 pictures, also after the light has moved a little."""
    lamps = lamps_of(pictures(along(60), 1))
    truth, errors = LAMPS[:, :2] + [shift_px, 0.0], []
    for picture in pictures(along(60), 2, shift_px):
        found, changed, _ = lamps.in_picture(picture)
        plain = find_spots(picture, USUAL, NOISE)
        rows = [int(np.argmin(np.hypot(*(plain.uv_px - at).T))) for at in truth]
        sigma = np.sqrt(np.trace(plain.cov_px2[rows], axis1=1, axis2=2) / 2)
        errors.append(np.linalg.norm(found.uv_px - truth, axis=1) / sigma / np.sqrt(2))
        assert not changed.any()
    assert 0.8 < np.sqrt(np.mean(np.square(errors))) < 1.25


def test_a_faint_light_has_not_changed_while_a_picture_shows_no_more_than_noise():
    """Its place has an error of a quarter of its width in a single picture; the light that goes out has changed."""
    rng = np.random.default_rng(11)
    faint = 20.0 + light(150.2, 120.6, 5.0, 1.3)
    seen = [
        np.rint(shown + rng.standard_normal(SIZE)).astype(np.uint8) for shown in [faint] * 80 + [0 * faint + 20] * 9
    ]
    mean = np.mean(seen[:20], axis=0).astype(np.float32)
    found = find_spots(np.rint(16 * mean).astype(np.uint16), DetectParameters(), NoiseModel(16.0, 0.0, 320.0))
    found = replace(found, flux=found.flux / 16, peak=found.peak / 16)[:1]
    lamp = RestingLights.of(mean, found, NOISE, 255.0)
    assert not any(lamp.in_picture(picture)[1][0] for picture in seen[20:80])
    assert all(lamp.in_picture(picture)[1][0] for picture in seen[80:])


def test_a_light_that_moves_far_or_dims_or_is_covered_has_changed():
    lamps = lamps_of(pictures(along(40), 3))
    for picture in (
        pictures(along(1), 4, 1.5)[0],
        np.rint(20 + 0.5 * (pictures(along(1), 5)[0].astype(float) - 20)).astype(np.uint8),
        np.full(SIZE, 20, np.uint8),
    ):
        assert lamps.in_picture(picture)[1].all()


def test_lamps_that_stay_in_their_places_are_measured_only_where_a_picture_differs():
    lamps, fixed = lamps_of(pictures(along(40), 3)), np.array([True, True, True, True, False])
    picture = pictures(along(1), 6)[0]
    found, changed, passed = lamps.in_picture(picture, fixed)
    assert np.array_equal(found.uv_px[fixed], lamps.found.uv_px[fixed])
    assert not (changed | passed).any()
    np.testing.assert_allclose(found.uv_px[~fixed], lamps.in_picture(picture)[0].uv_px[~fixed], atol=1e-4)
    rows, columns = slice(30, 72), slice(40, 82)  # the first lamp fails
    picture[rows, columns] = 20
    for known in (fixed, None):
        assert lamps.in_picture(picture, known)[1].tolist() == [True, False, False, False, False]


def test_a_spot_that_passes_a_lamp_is_found_in_each_picture_and_the_lamps_stay():
    path = np.column_stack([np.full(45, 200.1), np.linspace(20, 300, 45)])  # over the second lamp
    seen = pictures(path, 6)
    background = static_background(seen[::3], NOISE, TextureShift.none(), USUAL)
    assert background is not None
    for place, picture in zip(path, seen, strict=True):
        found = background.found_in(picture, USUAL, TextureShift.none())
        assert found is not None
        apart = float(np.hypot(*(place - LAMPS[1, :2])))
        if apart > 9.0:
            assert np.hypot(*(found.uv_px - place).T).min() < 0.3
            assert np.hypot(*(found.uv_px - LAMPS[1, :2]).T).min() < 0.1
        else:  # two lights in one place are a light
            assert np.hypot(*(found.uv_px - 0.5 * (place + LAMPS[1, :2])).T).min() < 6.0
        for lamp in LAMPS[[0, 2, 3, 4]]:
            assert np.sum(np.hypot(*(found.uv_px - lamp[:2]).T) < 1.0) == 1
        assert len(found) <= 6
