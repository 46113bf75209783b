"""Coloured targets: centroids, hues, and what has no colour."""

from __future__ import annotations

import colorsys

import numpy as np
import pytest

from tests.paths import DATA
from tracking.single_target.blobs import HUES, BlobParameters, find_coloured, has_colour, hue_of, share_of_hue


def scene(bgr, centre=(100.3, 80.6), radius=9.0, light=1.0, noise=2.0, seed=0):
    """A coloured disc on a grey ground with a grey disc beside it, (h, w, 3), 8 bit."""
    v, u = np.mgrid[:180, :240]
    out = np.full((180, 240, 3), 120.0)
    for place, colour in ((centre, bgr), ((180.0, 120.0), (230, 230, 230))):
        cover = np.clip(radius + 0.5 - np.hypot(u - place[0], v - place[1]), 0, 1)[..., None]
        out += cover * (np.asarray(colour, float) - out)
    out = light * out + noise * np.random.default_rng(seed).standard_normal(out.shape)
    return np.clip(np.round(out), 0, 255).astype(np.uint8)


def bgr_of(hue_deg, saturation=0.8, value=200.0):
    return [value * c for c in colorsys.hsv_to_rgb(hue_deg / 360, saturation, 1.0)][::-1]


@pytest.mark.parametrize("name", list(HUES))
@pytest.mark.parametrize("light", [1.0, 0.5])
def test_the_centroid_of_a_coloured_disc_is_its_centre_and_grey_ones_are_none(name, light):
    found = find_coloured(scene(bgr_of(HUES[name]), light=light), HUES[name], BlobParameters())
    assert len(found) == 1
    np.testing.assert_allclose(found.uv_px[0], (100.3, 80.6), atol=0.06)


def test_a_target_of_another_hue_is_none():
    picture = scene(bgr_of(0.0))
    for name in ("yellow", "green", "cyan", "blue", "magenta"):
        assert len(find_coloured(picture, HUES[name], BlobParameters())) == 0


def test_without_the_target_its_hue_is_not_found_in_noise_or_faint_colours():
    wood = scene((112, 120, 128))
    for picture in (scene((120, 120, 120), noise=6.0), wood):
        assert len(find_coloured(picture, HUES["orange"], BlobParameters())) == 0
    assert not has_colour(wood)
    assert has_colour(scene(bgr_of(200.0)))


@pytest.mark.parametrize("hue", [0.0, 77.0, 200.0, 359.0])
def test_the_hue_of_a_colour_is_that_of_hsv_to_two_degrees(hue):
    found = hue_of(tuple(bgr_of(hue)))
    assert found is not None
    assert abs((found - hue + 180) % 360 - 180) < 2.0
    assert hue_of((90.0, 95.0, 92.0)) is None


def test_the_share_is_linear_in_the_light():
    full = share_of_hue(scene(bgr_of(0.0), noise=0.0), 0.0)
    half = share_of_hue(scene(bgr_of(0.0), noise=0.0, light=0.5), 0.0)
    np.testing.assert_allclose(full, 2 * half, atol=2.1)  # rounding


def test_pictures_of_another_kind_are_errors():
    for picture in (np.zeros((10, 10), np.uint8), np.zeros((10, 10, 3), np.uint16)):
        with pytest.raises(ValueError, match="of 8 bits"):
            find_coloured(picture, 0.0, BlobParameters())


def test_red_sweets_of_a_real_picture_are_found_where_their_outlines_are():
    """The outlines are those of `beampose track circle`: 33.1, 228.4; 287.5, 213.4; 219.2, 306.0; 98.5, 259.3."""
    cv2 = pytest.importorskip("cv2")
    path = DATA / "circles_stills" / "smarties.png"
    if not path.is_file():
        pytest.skip("the real pictures are not available: circles_stills is missing")
    found = find_coloured(cv2.imread(str(path)), HUES["red"], BlobParameters(background_px=121))
    for place in ((33.1, 228.4), (287.5, 213.4), (219.2, 306.0), (98.5, 259.3)):
        assert np.hypot(*(found.uv_px - place).T).min() < 1.5
