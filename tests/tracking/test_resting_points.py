"""Lamps are points at rest while others move; a vehicle that creeps among false points is not at rest."""

from __future__ import annotations

import numpy as np

from tracking.resting_points import at_places, resting_places

SIZE = (1280.0, 1024.0)
SPOTS = np.array([[300.0, 300.0], [600.0, 320.0], [900.0, 310.0], [500.0, 700.0]])


def threes(step_px: float, lamps: np.ndarray, others: int, seed: int = 1) -> list[tuple[np.ndarray, ...]]:
    """15 frames with their neighbours: four spots that move so far per frame, lamps, and false points anywhere."""
    rng = np.random.default_rng(seed)

    def frame(k: int) -> np.ndarray:
        uv = np.concatenate([SPOTS + step_px * k, lamps, rng.uniform([0, 0], SIZE, (others, 2))])
        return uv + rng.normal(0.0, 0.05, uv.shape)

    return [tuple(frame(k + i) for i in (-1, 0, 1)) for k in range(1, 60, 4)]


def test_lamps_are_at_rest_while_spots_move():
    lamps = np.random.default_rng(3).uniform([0, 0], SIZE, (12, 2))
    places = resting_places({"left": threes(2.0, lamps, 0)}, 4, 0.55)["left"]
    assert at_places(lamps, places).all()
    assert not at_places(SPOTS + 2.0 * 20, places).any()


def test_spots_that_creep_are_no_lamps_although_false_points_are_elsewhere_in_each_frame():
    for seed in range(5):
        assert not len(resting_places({"left": threes(0.01, SPOTS[:0], 8, seed)}, 4, 0.55)["left"])


def test_a_vehicle_at_rest_beside_lamps_is_not_at_rest_itself():
    lamps = np.random.default_rng(3).uniform([0, 0], SIZE, (12, 2))
    assert not len(resting_places({"left": threes(0.0, lamps, 0)}, 4, 0.55)["left"])


def test_spots_that_hardly_move_before_a_distant_camera_are_no_lamps():
    """Another camera saw the same vehicle move: the distant one lost all its spots as lamps."""
    views = {"far": threes(0.02, SPOTS[:0], 3), "near": threes(2.0, SPOTS[:0], 3)}
    assert not any(len(places) for places in resting_places(views, 4, 0.55).values())
