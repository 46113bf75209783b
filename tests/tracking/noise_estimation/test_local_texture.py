"""The detection threshold follows the structure of the background at each place, not that of the whole picture."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from geometry.arrays import Array
from tests.tracking.rendering import round_lights
from tracking.detection.detect import find_spots
from tracking.noise import Picture
from tracking.noise_estimation.photon_transfer import estimate_noise

SIZE = (360, 480)
BACKGROUND, NOISE = 40.0, 1.0  # DN
FAINT = 6.0  # peak of a spot over the noise of a pixel


def places(seed: int) -> Array:
    """Centres (n, 2) of spots far apart, px."""
    u, v = np.meshgrid(np.arange(40.0, 450, 60), np.arange(40.0, 330, 60))
    return np.stack([u.ravel(), v.ravel()], axis=-1) + np.random.default_rng(seed).uniform(-4, 4, (u.size, 2))


def pictures(background: Array, spots: Array, sigma_px: float, count: int, seed: int) -> list[Picture]:
    rng = np.random.default_rng(seed)
    expected = background + round_lights(SIZE, spots, FAINT * NOISE, sigma_px)
    return [np.rint(expected + NOISE * rng.standard_normal(SIZE)).astype(np.uint8) for _ in range(count)]


def found_at(picture: Picture, noise, spots: Array) -> tuple[Array, int]:
    """Which spots (n,) are found within 3 px, and the number of other points."""
    points = find_spots(picture, noise=noise)
    gap = np.linalg.norm(points.uv_px[:, None] - spots, axis=-1)
    return gap.min(axis=0, initial=np.inf) < 3, int(np.sum(gap.min(axis=1, initial=np.inf) >= 3))


def screen_with_edges() -> Array:
    """A screen whose edge, frame and cables stand out by 25 to 60 % of the background."""
    out = np.full(SIZE, BACKGROUND)
    cv2.fillPoly(out, [np.array([[30, 15], [460, 25], [440, 340], [55, 330]])], 1.25 * BACKGROUND)
    cv2.line(out, (0, 200), (479, 180), 1.5 * BACKGROUND, 3)
    cv2.line(out, (225, 0), (250, 359), 0.4 * BACKGROUND, 5)
    return np.asarray(cv2.GaussianBlur(out, (0, 0), 0.7))


@pytest.mark.parametrize("sigma_px", [1.0, 1.5, 3.0])
def test_edges_elsewhere_in_the_picture_do_not_hide_faint_spots(sigma_px):
    background, seen, total, false = screen_with_edges(), 0, 0, 0
    edges = cv2.dilate(np.abs(cv2.Laplacian(background, cv2.CV_64F)), np.ones((41, 41))) > 1.0
    for seed in range(4):
        spots = places(seed)
        plain = ~edges[np.rint(spots[:, 1]).astype(int), np.rint(spots[:, 0]).astype(int)]
        estimate = estimate_noise(pictures(background, np.zeros((0, 2)), sigma_px, 6, seed))
        found, others = found_at(pictures(background, spots, sigma_px, 1, 50 + seed)[0], estimate.model, spots)
        seen, total, false = seen + int(found[plain].sum()), total + int(plain.sum()), false + others
        everywhere = found_at(
            pictures(background, spots, sigma_px, 1, 50 + seed)[0], replace(estimate.model, local_texture=None), spots
        )[0]
        assert everywhere[plain].mean() < 0.5  # one contrast for the whole picture misses them
    assert total > 60
    assert seen >= 0.97 * total
    assert false <= 8  # in four pictures, at corners of the edges


@pytest.mark.parametrize("sigma_px", [1.5, 4.0, 9.0])
def test_spots_at_rest_do_not_hide_themselves(sigma_px):
    """The map of the texture is taken from pictures that contain the same spots in the same places."""
    background = screen_with_edges()
    spots = places(0)[::3]
    series = pictures(background, spots, sigma_px, 6, 3)
    model = estimate_noise(series).model
    found = found_at(series[0], model, spots)[0]
    everywhere = found_at(series[0], replace(model, local_texture=None), spots)[0]
    assert not np.any(everywhere & ~found)


def test_texture_in_one_half_of_the_picture_hides_nothing_in_the_other():
    """And there are no more false points in the textured half than with one threshold for both."""
    for seed in range(3):
        grains = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal(SIZE), (0, 0), 1.2)
        contrast = np.where(np.arange(SIZE[1]) < SIZE[1] // 2, 0.06, 0.0)
        background = BACKGROUND * (1 + contrast * grains / grains.std())
        model = estimate_noise(pictures(background, np.zeros((0, 2)), 1.2, 6, seed)).model
        spots = places(seed)
        spots = spots[spots[:, 0] > SIZE[1] // 2 + 30]
        picture = pictures(background, spots, 1.2, 1, 9 + seed)[0]
        found, false = found_at(picture, model, spots)
        everywhere, false_everywhere = found_at(picture, replace(model, local_texture=None), spots)
        assert found.mean() > 0.95
        assert everywhere.mean() < 0.3
        assert false <= false_everywhere


@pytest.mark.parametrize("size", [(352, 472), (355, 477), (360, 480)])
def test_the_map_has_the_blocks_of_the_picture(size):
    background = screen_with_edges()[: size[0], : size[1]]
    rng = np.random.default_rng(0)
    series = [np.rint(background + rng.standard_normal(size)).astype(np.uint8) for _ in range(4)]
    local = estimate_noise(series).model.local_texture
    assert local is not None
    assert local.shape == (-(-size[0] // 8), -(-size[1] // 8))
