"""Cables, edges and frames are no spots, and do not hide the spots beside them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from geometry.arrays import Array
from tests.tracking.rendering import Scene, Spot, expected
from tracking.detection.detect import SpotFinder, _Task, find_spots
from tracking.detection.regions import EVERYWHERE
from tracking.noise import NoiseModel, Picture
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
