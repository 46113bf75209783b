"""Lines in space: the closest points of two, and the point nearest to many."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geometry.planes import common_perpendicular, nearest_point

seeds = st.integers(0, 2**32 - 1)


def two_lines(seed: int):
    rng = np.random.default_rng(seed)
    return rng.normal(size=3), rng.normal(size=3), rng.normal(size=3), rng.normal(size=3)


def distance(point: np.ndarray, start: np.ndarray, direction: np.ndarray) -> float:
    return float(np.linalg.norm(np.cross(point - start, direction)) / np.linalg.norm(direction))


@given(seed=seeds)
def test_the_common_perpendicular_is_perpendicular_to_both_lines_and_ends_on_them(seed):
    a, u, b, v = two_lines(seed)
    p, q = common_perpendicular(a, u, b, v)
    # Random directions are rarely within 1e-2 of parallel; the loss of accuracy is the square of that.
    assert distance(p, a, u) < 1e-9
    assert distance(q, b, v) < 1e-9
    assert abs((q - p) @ u) < 1e-8 * max(1, np.linalg.norm(p))
    assert abs((q - p) @ v) < 1e-8 * max(1, np.linalg.norm(p))


@given(seed=seeds, s=st.floats(-2, 2), t=st.floats(-2, 2))
def test_no_other_two_points_of_the_lines_are_closer(seed, s, t):
    a, u, b, v = two_lines(seed)
    p, q = common_perpendicular(a, u, b, v)
    assert np.linalg.norm(q - p) <= np.linalg.norm((a + s * u) - (b + t * v)) + 1e-9


@given(seed=seeds)
def test_lines_that_cross_are_closest_where_they_cross(seed):
    a, u, _, v = two_lines(seed)
    crossing = a + 1.7 * u
    p, q = common_perpendicular(a, u, crossing - 0.6 * v, v)
    np.testing.assert_allclose(p, crossing, atol=1e-8)
    np.testing.assert_allclose(q, crossing, atol=1e-8)


@pytest.mark.parametrize("stretch", [1.0, -1.0, 1e-3, 1e3])
def test_parallel_lines_have_no_closest_points(stretch):
    u = np.array([0.6, 0.0, 0.8])
    p, q = common_perpendicular(np.zeros(3), u, np.array([1.0, 2, 3]), stretch * u)
    assert np.isnan(p).all()
    assert np.isnan(q).all()


def test_lines_all_but_parallel_are_still_solved():
    tilt = 1e-5
    u, v = np.array([1.0, 0, 0]), np.array([np.cos(tilt), np.sin(tilt), 0])
    crossing, up = np.array([3.0, 0, 0]), np.array([0.0, 0, 1])
    p, q = common_perpendicular(np.zeros(3), u, crossing - 2 * v + up, v)
    np.testing.assert_allclose(p, crossing, atol=1e-9)
    np.testing.assert_allclose(q, crossing + up, atol=1e-9)


def test_each_pair_of_a_stack_has_its_own_answer():
    pairs = [two_lines(seed) for seed in range(5)]
    stack = [np.array(column) for column in zip(*pairs, strict=True)]
    p, q = common_perpendicular(*stack)
    for i, pair in enumerate(pairs):
        alone = common_perpendicular(*pair)
        np.testing.assert_allclose(p[i], alone[0], rtol=1e-12)
        np.testing.assert_allclose(q[i], alone[1], rtol=1e-12)


@given(seed=seeds, n=st.integers(2, 6))
def test_lines_through_one_point_are_nearest_to_that_point(seed, n):
    rng = np.random.default_rng(seed)
    centre, directions = rng.normal(size=3), rng.normal(size=(n, 3))
    points = centre + rng.uniform(-3, 3, (n, 1)) * directions
    np.testing.assert_allclose(nearest_point(points, directions), centre, atol=1e-7)


@given(seed=seeds, weighted=st.booleans())
def test_the_nearest_point_is_the_least_squares_solution(seed, weighted):
    """Against numpy's lstsq: each line gives two equations, along two directions perpendicular to it."""
    rng = np.random.default_rng(seed)
    points, directions = rng.normal(size=(5, 3)), rng.normal(size=(5, 3))
    weights = rng.uniform(0.1, 3, 5) if weighted else None
    rows, values = [], []
    for i in range(5):
        across = np.linalg.svd(directions[i : i + 1])[2][1:]
        root = 1.0 if weights is None else np.sqrt(weights[i])
        rows.append(root * across)
        values.append(root * across @ points[i])
    expected = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)[0]
    np.testing.assert_allclose(nearest_point(points, directions, weights), expected, atol=1e-9)


def test_parallel_lines_have_no_nearest_point():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert np.isnan(nearest_point(points, np.tile([0.0, 0.6, 0.8], (3, 1)))).all()
    assert np.isnan(nearest_point(points[:1], np.array([[0.0, 0, 1]]))).all()


def test_a_line_of_no_weight_does_not_count():
    points = np.array([[0.0, 0, 0], [0, 0, 0], [5, 5, 5]])
    directions = np.array([[1.0, 0, 0], [0, 1, 0], [0, 1, 1]])
    np.testing.assert_allclose(nearest_point(points, directions, np.array([1.0, 1, 0])), 0, atol=1e-12)
