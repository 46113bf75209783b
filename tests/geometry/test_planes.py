"""Intersections of rays with screens."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geometry.planes import intersect_plane, screen_to_world
from geometry.pose import Pose

three = st.tuples(*[st.floats(-3, 3)] * 3)
two = st.tuples(*[st.floats(-3, 3)] * 2)
FLAT = Pose.identity()  # the plane z = 0


@given(turn=three, shift=three, on_screen=two, away=st.floats(0.5, 9.0), side=st.sampled_from([-1, 1]))
def test_a_ray_aimed_at_a_point_of_the_screen_hits_that_point(turn, shift, on_screen, away, side):
    world_from_screen = Pose(Rotation.from_rotvec(turn).as_matrix(), np.array(shift))
    target = world_from_screen.apply(np.array([*on_screen, 0.0]))
    origin = world_from_screen.apply(np.array([0.3, -0.2, side * away]))  # from either side
    np.testing.assert_allclose(intersect_plane(origin, target - origin, world_from_screen), on_screen, atol=1e-12)


@given(turn=three, shift=three, on_screen=two)
def test_points_of_a_screen_lie_in_its_plane(turn, shift, on_screen):
    world_from_screen = Pose(Rotation.from_rotvec(turn).as_matrix(), np.array(shift))
    points = np.array([on_screen, [0.0, 0.0]])
    expected = world_from_screen.apply(np.column_stack([points, np.zeros(2)]))
    np.testing.assert_allclose(screen_to_world(points, world_from_screen), expected, atol=1e-14)


@given(length=st.floats(1e-6, 1e6))
def test_the_length_of_a_direction_does_not_matter(length):
    origin, direction = np.array([0.1, 0.2, 2.0]), np.array([0.3, -0.4, -1.0])
    np.testing.assert_allclose(
        intersect_plane(origin, length * direction, FLAT), intersect_plane(origin, direction, FLAT), rtol=1e-12
    )


@pytest.mark.parametrize("length", [1e-6, 1.0, 1e6])
def test_a_ray_parallel_to_the_screen_does_not_hit_it(length):
    assert np.isnan(intersect_plane(np.array([0.0, 0, 1]), length * np.array([0.6, 0.8, 0]), FLAT)).all()
    assert np.isnan(intersect_plane(np.array([0.0, 0, 0]), length * np.array([0.6, 0.8, 0]), FLAT)).all()


def test_a_ray_that_points_away_from_the_screen_does_not_hit_it():
    assert np.isnan(intersect_plane(np.array([0.0, 0, 1]), np.array([0.1, 0, 1]), FLAT)).all()


def test_one_call_intersects_many_rays_and_one_origin():
    directions = np.array([[[0.0, 0, -1], [1, 0, -1]], [[1, 0, 0], [0, 0, 1]]])
    hits = intersect_plane(np.array([0.0, 0, 2]), directions, FLAT)
    np.testing.assert_array_equal(hits, [[[0, 0], [2, 0]], [[np.nan] * 2, [np.nan] * 2]])
    origins = np.array([[0.0, 0, 1], [0, 0, 2], [0, 0, -3]])
    np.testing.assert_array_equal(
        intersect_plane(origins, np.array([1.0, 0, -1]), FLAT), [[1, 0], [2, 0], [np.nan] * 2]
    )
