"""Spots that the pixels hardly resolve: whatever their place within a pixel, they are found, and hot pixels are not."""

from statistics import NormalDist

import numpy as np
import pytest

from geometry.camera import SensorNoise
from tests.tracking.rendering import Scene, Spot, photograph
from tracking.detection.detect import find_spots
from tracking.detection.measuring import _drop_background
from tracking.detection.table import CANDIDATE
from tracking.noise import NoiseModel

NOISE = SensorNoise(gain_e_per_dn=30.0, read_noise_e=45.0)
SIZE = (400, 320)


def grid(rng: np.random.Generator) -> np.ndarray:
    """Places (n, 2) px, far apart and anywhere within a pixel."""
    u, v = np.meshgrid(np.arange(30.0, 380, 40), np.arange(30.0, 300, 40))
    return np.stack([u.ravel(), v.ravel()], axis=-1) + rng.uniform(-0.5, 0.5, (u.size, 2))


@pytest.mark.parametrize(("sigma", "peak"), [(0.3, 250.0), (0.36, 120.0), (0.45, 60.0)])
def test_a_spot_as_narrow_as_a_pixel_is_found_anywhere_within_it(sigma, peak):
    """Noise makes the fitted width of some zero. sigma: of the light, before the pixels integrate it."""
    found = elsewhere = 0
    normalised = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        places = grid(rng)
        scene = Scene([Spot(u, v, peak, sigma, sigma) for u, v in places], SIZE)
        points = find_spots(photograph(scene, rng), noise=NOISE)
        gap = np.linalg.norm(points.uv_px[:, None] - places, axis=-1)
        found += int(np.sum(gap.min(axis=0) < 0.7))
        elsewhere += int(np.sum(gap.min(axis=1) > 0.7))
        rows = gap.argmin(axis=0)
        off = points.uv_px[rows] - places
        normalised.append(
            np.einsum("ni,nij,nj->n", off, np.linalg.inv(points.cov_px2[rows]), off)[gap.min(axis=0) < 0.7]
        )
    total = 4 * len(places)
    assert found >= 0.98 * total
    assert elsewhere == 0
    assert 0.5 < np.mean(np.concatenate(normalised)) / 2 < 2.0


@pytest.mark.parametrize("phase", [(0.0, 0.0), (0.5, 0.5), (1.5, 1.5), (1.5, 0.5), (1.0, 1.0), (0.0, 1.5)])
def test_a_faint_narrow_spot_is_found_anywhere_among_the_sums_of_the_search(phase):
    """They are sums of 2x2 pixels. The steps of a quiet sensor, 3 grey values below, hide it in wider sums."""
    noise = NoiseModel(0.17, 0.004, 8.0, texture=0.02, banding_dn=0.14)
    u, v = np.arange(30.0, 380, 40) + phase[0], np.arange(30.0, 300, 40) + phase[1]
    places = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rows, columns = _shares(SIZE[1], v), _shares(SIZE[0], u)
    light = 8.6 + 11.0 * np.outer(rows.sum(axis=1), columns.sum(axis=1))
    found = elsewhere = 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        points = find_spots(np.rint(light + 0.3 * rng.standard_normal(light.shape)).astype(np.uint8), noise=noise)
        gap = np.linalg.norm(points.uv_px[:, None] - places, axis=-1)
        found += int(np.sum(gap.min(axis=0) < 0.8))
        elsewhere += int(np.sum(gap.min(axis=1) > 0.8))
    assert found >= 0.93 * 3 * len(places)
    assert elsewhere == 0


def _shares(pixels: int, centres: np.ndarray) -> np.ndarray:
    """The shares (pixels, n) of the light of lines with sigma 0.5 px that fall on the pixels."""
    edges = (np.arange(pixels + 1)[:, None] - 0.5 - centres) / 0.5
    return np.diff(np.vectorize(NormalDist().cdf)(edges), axis=0)


@pytest.mark.parametrize("pair", [False, True])
@pytest.mark.parametrize("height", [15.0, 30.0, 120.0])
def test_hot_pixels_and_pairs_of_them_are_not_narrow_spots(height, pair):
    count = 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        picture = photograph(Scene([], SIZE), rng).astype(float)
        for u, v in np.rint(grid(rng)).astype(int):
            picture[v, u] += height
            if pair:
                picture[v, u + 1] += height * rng.uniform(0.5, 1.0)
        points = find_spots(np.clip(picture, 0, 255).astype(np.uint8), noise=NoiseModel.of(NOISE))
        count += len(points)
    assert count <= (0.08 if pair else 0.0) * 4 * len(grid(np.random.default_rng(0)))


def test_only_a_fit_that_has_started_again_is_rejected_as_background():
    """The moments of a narrow spot are as round as a start from a peak: they are clipped at their least size."""
    table = np.zeros(2, CANDIDATE)
    table["flux"], table["uu"], table["vv"] = 100.0, 0.5, 0.5
    table["moment_uu"] = table["moment_vv"] = 0.1
    _drop_background(table, np.array([False, True]))
    assert table["flux"].tolist() == [100.0, 0.0]
