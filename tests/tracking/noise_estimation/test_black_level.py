"""The black level of a sensor, from the texture of an unevenly lit background."""

import cv2
import numpy as np
import pytest

from tracking.noise_estimation.black_level import level_over_light

SIZE = (512, 640)
FULL = 255.0


def scene(light: float, black: float, uneven: float, contrast: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The texture, DN, with noise of 0.3 DN, and the smooth level (h, w), DN."""
    rng = np.random.default_rng(seed)
    level = light * (1 + uneven * np.linspace(-0.5, 0.5, SIZE[1]))[None, :] * np.ones((SIZE[0], 1))
    grain = cv2.GaussianBlur(rng.standard_normal(SIZE), (0, 0), 1.2)
    texture = contrast * level * grain / grain.std()
    return texture + 0.3 * rng.standard_normal(SIZE), level + black


@pytest.mark.parametrize(("light", "black"), [(20.0, 0.0), (20.0, 10.0), (12.0, 12.0), (60.0, 6.0)])
def test_texture_of_an_unevenly_lit_screen_shows_the_black_level(light, black):
    ratios = [level_over_light(*scene(light, black, 0.8, 0.04, seed), 0.09, FULL) for seed in range(4)]
    assert np.mean(ratios) == pytest.approx((light + black) / light, rel=0.15)


@pytest.mark.parametrize("contrast", [0.0, 0.04])
def test_without_uneven_light_a_usual_black_level_is_assumed(contrast):
    """Between 0 and 5 % of full scale: the mean ratio is L / (L - b) averaged over b."""
    level, most = 40.0, 0.05 * FULL
    usual = level / most * np.log(level / (level - most))
    ratio = level_over_light(*scene(level, 0.0, 0.0, contrast, 1), 0.09, FULL)
    assert ratio > 1.0
    assert ratio == pytest.approx(usual, rel=0.1)


def test_a_picture_without_room_or_light_changes_nothing():
    assert level_over_light(np.zeros((40, 40)), np.full((40, 40), 10.0), 0.1, FULL) == 1.0
    assert level_over_light(np.zeros(SIZE), np.zeros(SIZE), 0.1, FULL) == 1.0


def test_a_known_black_level_decides():
    """At most as far as a background that is nearly black still shows texture."""
    nothing, level = np.zeros(SIZE), np.full(SIZE, 14.0)
    assert level_over_light(nothing, level, 0.1, FULL, 8.0) == pytest.approx(14 / 6)
    assert level_over_light(nothing, level, 0.1, FULL, 13.9) == pytest.approx(1 / 0.35)
    assert level_over_light(nothing, np.zeros(SIZE), 0.1, FULL, 8.0) == 1.0
