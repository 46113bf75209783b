"""A spot's path is continued across a corner where a straight row of points meets it, and only there."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.arrays import Array, Ints
from tracking.smoothing.labels.view_path import MAX_SIGMA_PX, ROW_FRAMES, Limits, Line, after_corner

SIGMA_PX = 0.1
LIMITS = Limits(SIGMA_PX, speed_px=30.0)
LAST = Line(9, np.array([400.0, 300.0]), np.array([4.0, 1.0]))
NEW = np.array([-2.0, 5.0])  # px per frame after the corner


def row(at: float = 9.4, velocity: Array = NEW, aside: float = 0.0) -> dict[int, Array]:
    """Places by frame of a spot that turns at a moment between frames 9 and 10, and moves on beside its path."""
    corner = LAST.uv + (at - 9) * LAST.velocity + np.array([aside, 0.0])
    return {k: corner + (k - at) * velocity for k in range(10, 10 + ROW_FRAMES)}


def found(*rows: dict[int, Array], false_points: int = 3, seed: int = 1, limits: Limits = LIMITS) -> dict[int, int]:
    """Rows of the answer by frame; the first of `rows` is row 0 of each of its frames, and so on; then false points."""
    rng = np.random.default_rng(seed)

    def points_of(k: int) -> tuple[Ints, Array]:
        true = [r[k] + 0.3 * SIGMA_PX * rng.normal(size=2) for r in rows if k in r]
        places = np.array([*true, *rng.uniform([300, 200], [500, 400], (false_points, 2))]).reshape(-1, 2)
        return np.arange(len(places)), places

    return after_corner(points_of, 10, 1, LAST, limits)


@pytest.mark.parametrize("at", [9.0, 9.4, 9.9])
def test_a_row_that_meets_the_path_is_the_spot(at):
    for seed in range(20):
        assert found(row(at), seed=seed) == dict.fromkeys(range(10, 10 + ROW_FRAMES), 0)


def test_a_row_may_miss_points():
    spot = row()
    del spot[13]
    assert found(spot, false_points=0) == dict.fromkeys([10, 11, 12, 14, 15], 0)


def test_false_points_are_no_row():
    assert all(not found(false_points=8, seed=seed) for seed in range(100))


def test_a_row_beside_the_path_is_another_spot():
    assert not found(row(aside=4.0))


def test_a_row_at_rest_may_be_a_reflection():
    assert not found(row(velocity=np.zeros(2)))


def test_of_two_rows_that_meet_the_path_none_is_sure():
    assert not found(row(), row(velocity=np.array([3.0, -4.0])))


def test_a_path_that_is_hardly_straight_has_no_corners():
    assert not found(row(), limits=Limits(1.1 * MAX_SIGMA_PX, 30.0))


def test_a_spot_is_not_faster_than_its_limit():
    assert not found(row(velocity=np.array([0.0, 40.0])), false_points=0)
