"""Cables, edges and frames are no spots, and do not hide the spots beside them."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from geometry.arrays import Array
from tests.marks import further_slow
from tests.tracking.rendering import Scene, Spot, expected
from tracking.detection.detect import SpotFinder, _Task, find_spots
from tracking.detection.regions import EVERYWHERE
from tracking.noise import NoiseModel, Picture
from tracking.noise_estimation.photon_transfer import estimate_noise
from tracking.parameters import DetectParameters

SIZE = (480, 360)  # width, height
NOISE = NoiseModel(1.0, 0.02, 20.0)


def background() -> Array:
    """A screen with an edge, bright and faint cables, and a window."""
    out = np.full(SIZE[::-1], 20.0)
    cv2.fillPoly(out, [np.array([[20, 20], [470, 30], [450, 340], [40, 330]])], 45.0)
    for k, light in enumerate((90.0, 30.0, 120.0)):
        cv2.line(out, (60 + 120 * k, 0), (100 + 120 * k, 359), light, 3)
    cv2.rectangle(out, (380, 250), (479, 359), 160.0, -1)
    return np.asarray(cv2.GaussianBlur(out, (0, 0), 0.8))


def photograph(spots: list[Spot], seed: int) -> Picture:
    light = expected(Scene(spots, SIZE, 0.0))
    mean = background() + light
    rng = np.random.default_rng(seed)
    return np.rint(mean + np.sqrt(1.0 + 0.02 * (mean - 20)) * rng.standard_normal(mean.shape)).clip(0, 255).astype("u1")


@pytest.mark.parametrize(("sigma", "streak"), [(0.9, 0.0), (2.0, 0.0), (5.0, 0.0), (2.0, 20.0)])
@pytest.mark.parametrize("angle", [0.0, 30.0, 75.0])
def test_spots_and_streaks_between_lines_are_found(sigma, streak, angle):
    places = [(130.0, 120.0), (255.0, 200.0), (375.0, 130.0)]
    spots = [Spot(u, v, 60.0, sigma, sigma, angle, streak) for u, v in places]
    for seed in range(4):
        points = find_spots(photograph(spots, seed), noise=NOISE)
        gap = np.linalg.norm(points.uv_px[:, None] - np.array(places), axis=-1)
        assert np.all(gap.min(axis=0) < 1.0)


def test_few_candidates_on_lines_are_measured():
    """Each would be fitted over a large window: 0.3 to 0.9 s for a picture with cables, before."""
    picture = photograph([], 1)
    finder, task = SpotFinder(*SIZE), _Task.of(picture, DetectParameters(), NOISE)
    rows, columns = finder._searched.shape
    peaks = finder._search(task, np.array([[0, rows - 1, 0, columns - 1]]))
    finder._measure(task, peaks, EVERYWHERE)
    assert peaks > 150
    assert finder._count < 0.1 * peaks
    assert len(find_spots(picture, noise=NOISE)) <= 4  # corners and ends


def board(light: Array, seed: int) -> Picture:
    """A chessboard of 40 px squares of 10 and 40 grey values, turned by 5 degrees, with more light on it."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]] * 1.0
    across, down = u * np.cos(0.09) + v * np.sin(0.09), v * np.cos(0.09) - u * np.sin(0.09)
    squares = np.where((np.floor(across / 40) + np.floor(down / 40)) % 2 > 0, 40.0, 10.0)
    mean = cv2.GaussianBlur(squares, (0, 0), 0.8) + light
    noisy = mean + np.random.default_rng(seed).normal(0.0, 1.0, mean.shape)
    return np.rint(noisy).clip(0, 255).astype("u1")


def points_on_board(light: Array, seed: int) -> Array:
    """(n, 2) px, as the command finds them: with the noise of this picture."""
    picture = board(light, seed)
    return find_spots(picture, noise=estimate_noise([picture]).model).uv_px


def test_a_narrow_spot_beside_the_edges_and_corners_of_a_board_is_found():
    """In means of 3x3 pixels it is as high as the squares, whose contrast counts as texture there."""
    found, drawn = 0, 0
    for seed in range(4):
        places = np.random.default_rng(seed).uniform(40.0, (440.0, 320.0), (6, 2))
        light = expected(Scene([Spot(u, v, 160.0, 0.55, 0.55) for u, v in places], SIZE, 0.0))
        gap = np.linalg.norm(points_on_board(light, seed)[:, None] - places, axis=-1)
        found, drawn = found + int(np.sum(gap.min(axis=0) < 0.5)), drawn + len(places)
    assert found >= 0.9 * drawn


@pytest.mark.parametrize("core", [10.0, 18.0, 22.0])
def test_a_clipped_light_as_wide_as_the_squares_of_a_board_is_found(core):
    """Its own light is most of what surrounds it within 40 px."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]] * 1.0
    for seed, (u0, v0) in enumerate([(200.3, 150.8), (260.0, 190.2)]):
        light = 250.0 * np.exp(-0.5 * np.maximum(np.hypot(u - u0, v - v0) - core, 0.0) ** 2 / 3.0**2)
        gap = np.linalg.norm(points_on_board(light, seed) - (u0, v0), axis=-1)
        assert gap.min(initial=np.inf) < 0.1 * core


def before_bright_surfaces(light: Array, at: Array, edges: list[tuple[float, float]], seed: int) -> Picture:
    """An even surface of 24 grey values, bright ones beyond edges (direction, px from a point), squares on the left."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]] * 1.0
    mean = np.full(u.shape, 24.0)
    for angle, away in edges:
        mean[(u - at[0]) * np.cos(angle) + (v - at[1]) * np.sin(angle) > away] = 62.0
    mean[:, :120] += np.where((np.floor(u / 12) + np.floor(v / 12)) % 2 > 0, 38.0, 0.0)[:, :120]
    mean = cv2.GaussianBlur(mean, (0, 0), 0.8) + light
    noisy = mean + np.random.default_rng(seed).normal(0.0, 1.0, mean.shape)
    return np.rint(noisy).clip(0, 255).astype("u1")


def is_found_before_bright_surfaces(sigma: float, edges: list[tuple[float, float]], seed: int) -> bool:
    at = np.array([280.0, 180.0]) + np.random.default_rng(seed).uniform(-0.5, 0.5, 2)
    light = expected(Scene([Spot(at[0], at[1], 20.0 if sigma < 2 else 33.0, sigma, sigma)], SIZE, 0.0))
    picture = before_bright_surfaces(light, at, edges, seed)
    points = find_spots(picture, noise=estimate_noise([picture]).model)
    return bool(np.linalg.norm(points.uv_px - at, axis=-1).min(initial=np.inf) < 0.5)


def test_a_narrow_spot_in_a_corner_between_bright_surfaces_is_found():
    """Every circle of 8 px and more about it crosses a brighter surface."""
    edges = [(1.93, 9.1), (3.5, 9.1)]
    assert sum(is_found_before_bright_surfaces(1.1, edges, seed) for seed in range(12)) >= 10


def test_a_wide_spot_in_a_corner_between_bright_surfaces_is_found():
    """Their light in the window of its moments makes these shrink to a part of the spot."""
    for seed in range(24):
        rng = np.random.default_rng([seed, 3])
        first, away = rng.uniform(0.0, 2 * np.pi), rng.uniform(20.0, 30.0)
        assert is_found_before_bright_surfaces(4.4, [(first, away), (first + np.pi / 2, 1.2 * away)], seed)


@pytest.mark.parametrize("core_px", further_slow([3.5, 5.0]))
def test_a_light_on_a_small_bright_disc_is_found_at_its_own_place(core_px):
    """A fit that grows over the disc's edge describes the disc: it is as wide as that, and its centre lies far away."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]] * 1.0
    found, drawn = 0, 0
    for halo, edge_px, seed in itertools.product((0.0, 15.0), (10.0, 13.0, 16.0), range(8)):
        u0, v0, turn = 240.3 + seed, 180.7, 0.5 + 1.3 * seed
        centre = u0 - np.cos(turn) * (45.0 - edge_px), v0 - np.sin(turn) * (45.0 - edge_px)
        disc = np.where(np.hypot(u - centre[0], v - centre[1]) < 45.0, 100.0, 66.0)
        away = np.hypot(u - u0, v - v0)
        mean = cv2.GaussianBlur(disc, (0, 0), 1.0) + halo * (away < 10.0) + 60.0 * np.exp(-0.5 * (away / core_px) ** 2)
        picture = np.rint(mean + np.random.default_rng(seed).normal(0.0, 0.8, u.shape)).clip(0, 255).astype("u1")
        uv = find_spots(picture, noise=estimate_noise([picture]).model).uv_px
        found += np.linalg.norm(uv - (u0, v0), axis=1).min(initial=np.inf) < 1.0
        drawn += 1
    assert found >= 0.8 * drawn


@pytest.mark.parametrize("contrast", [0.14, 0.2])
def test_a_spot_on_an_even_sheet_of_paper_is_found(contrast):
    """The smooth background is wrong beside edges, by a part of their height: that is no texture of the paper."""
    found, drawn = 0, 0
    middles = np.array([(60.0 + 100.0 * (k % 4), 60.0 + 100.0 * (k // 4)) for k in range(12)])
    for seed in range(3):
        places = middles + np.random.default_rng(seed).uniform(-12.0, 12.0, (12, 2))
        paper = np.full(SIZE[::-1], 30.0)
        for left, top in (middles - 36.0).astype(int):
            paper[top : top + 72, left : left + 72] = 200.0
        light = expected(Scene([Spot(u, v, 200.0 * contrast, 1.4, 1.4) for u, v in places], SIZE, 0.0))
        mean = cv2.GaussianBlur(paper, (0, 0), 0.8) + light
        picture = np.rint(mean + np.random.default_rng(seed).normal(0.0, 1.0, mean.shape)).clip(0, 255).astype("u1")
        uv = find_spots(picture, noise=estimate_noise([picture]).model).uv_px
        gap = np.linalg.norm(uv[:, None] - places, axis=-1)
        found, drawn = found + int(np.sum(gap.min(axis=0, initial=np.inf) < 0.5)), drawn + len(places)
    assert found >= 0.95 * drawn
