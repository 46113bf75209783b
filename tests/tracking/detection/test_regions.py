"""Detection in regions gives the spots of the whole picture."""

import numpy as np
import pytest

from bench.detection import scene_of
from geometry.camera import SensorNoise
from tests.marks import further_slow
from tests.tracking.rendering import Scene, Spot, photograph
from tracking.detection.detect import SpotFinder, find_spots
from tracking.detections import Detections
from tracking.noise import Picture
from tracking.parameters import DetectParameters

NOISE = SensorNoise(gain_e_per_dn=30.0, read_noise_e=45.0)


def inside(found: Detections, regions: np.ndarray) -> np.ndarray:
    distance = np.abs(found.uv_px[:, None, :] - regions[None, :, :2]).max(axis=2)
    return (distance <= regions[None, :, 2]).any(axis=1)


def assert_same(image: Picture, regions: np.ndarray) -> int:
    whole, part = find_spots(image, noise=NOISE), find_spots(image, noise=NOISE, regions=regions)
    there = whole[inside(whole, regions)]
    for name in Detections.__slots__:
        np.testing.assert_array_equal(getattr(part, name), getattr(there, name), err_msg=name)
    return len(part)


@pytest.mark.parametrize("kind", further_slow(["main", "edge", "wide", "faint", "near", "small", "speckle"], fast=3))
def test_regions_give_the_same_spots_as_the_whole_picture(kind):
    rng = np.random.default_rng([3, len(kind)])
    scene = scene_of(kind, rng)
    image = photograph(scene, rng)
    at = np.array([[s.u, s.v] for s in scene.spots])
    some = rng.permutation(len(at))[: len(at) // 2 + 1]
    regions = np.column_stack([at[some] + rng.normal(0, 3, (len(some), 2)), rng.uniform(8, 40, len(some))])
    empty = np.column_stack([rng.uniform(0, 1000, (3, 2)), rng.uniform(5, 60, 3)])
    assert assert_same(image, np.concatenate([regions, empty])) >= len(some) - 1


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("sigma", [1.5, 4.0, 8.0])
def test_the_light_of_neighbours_outside_a_region_is_subtracted(seed, sigma):
    """Also where spots overlap in chains that extend far out of the region: within a sigma of the whole picture's."""
    rng = np.random.default_rng(seed)
    gap = 6 * sigma
    spots = [
        Spot(30 + gap * i + rng.uniform(-sigma, sigma), 30 + gap * j + rng.uniform(-sigma, sigma), rng.uniform(30, 200),
             sigma, sigma * rng.uniform(0.7, 1.0))
        for i in range(min(int(400 / gap), 20)) for j in range(min(int(340 / gap), 18))
    ]  # fmt: skip
    image = photograph(Scene(spots, (430, 370)), rng)
    whole = find_spots(image, noise=NOISE)
    for k in rng.permutation(len(whole))[:4]:
        found = find_spots(image, noise=NOISE, regions=[[*whole.uv_px[k], gap]])
        apart = min(found.uv_px - whole.uv_px[k], key=np.linalg.norm)
        assert apart @ np.linalg.solve(whole.cov_px2[k], apart) < 1.0


def test_regions_outside_the_picture_without_size_or_with_nan_are_empty():
    image = photograph(Scene([Spot(80.0, 60.0, 150.0)], (160, 120)), np.random.default_rng(0))
    odd = np.array([[-500.0, 60.0, 20.0], [80.0, 60.0, -1.0], [np.nan, 60.0, 20.0], [80.0, 60.0, np.nan]])
    assert len(find_spots(image, noise=NOISE, regions=odd)) == 0
    assert len(find_spots(image, noise=NOISE, regions=np.zeros((0, 3)))) == 0
    assert len(find_spots(image, noise=NOISE, regions=[[80.0, 60.0, 1e12]])) == 1
    with pytest.raises(ValueError, match=r"regions: expected \(n, 3\).* got shape \(2,\)"):
        find_spots(image, regions=[1.0, 2.0])


def test_a_finder_keeps_nothing_of_the_previous_picture():
    """Also after a search in regions, and with alternating 8 and 16 bits."""
    rng = np.random.default_rng(1)
    finder, parameters = SpotFinder(330, 250), DetectParameters()
    for k in range(6):
        spots = [Spot(*rng.uniform(30, 220, 2), float(rng.uniform(60, 200))) for _ in range(4)]
        image = photograph(Scene(spots, (330, 250)), rng, 8 if k % 2 else 16)
        finder.find(image, parameters, NOISE, [[spots[0].u, spots[0].v, 12.0]])
        used, new = finder.find(image, parameters, NOISE), SpotFinder(330, 250).find(image, parameters, NOISE)
        np.testing.assert_array_equal(used.uv_px, new.uv_px)
        np.testing.assert_array_equal(used.cov_px2, new.cov_px2)
