"""Intersections of rays with bent screens: equal to those with a plane if the bow is 0, and on the surface if not."""

from __future__ import annotations

import numpy as np

from geometry.planes import intersect_plane, intersect_surface, screen_to_world
from tests.geometry.scenes import random_pose


def test_a_flat_screen_is_a_plane():
    rng = np.random.default_rng(1)
    screen = random_pose(rng)
    origin, rays = rng.normal(0, 2, (200, 3)), rng.normal(size=(200, 3))
    expected = screen_to_world(intersect_plane(origin, rays, screen), screen)
    np.testing.assert_allclose(intersect_surface(origin, rays, screen, (0.0, 0.0, 0.0)), expected, atol=1e-12)


def test_a_ray_aimed_at_a_point_of_a_bent_screen_hits_it():
    rng = np.random.default_rng(2)
    screen, bow = random_pose(rng), (0.02, -0.01, 0.015)
    on_screen = rng.uniform(-1.5, 1.5, (200, 2))
    x, y = on_screen.T
    target = screen.apply(np.stack([x, y, bow[0] * x * x + bow[1] * x * y + bow[2] * y * y], axis=-1))
    origin = screen.apply(np.stack([0.3 * x, 0.2 * y, np.full(200, 3.0)], axis=-1))
    np.testing.assert_allclose(intersect_surface(origin, target - origin, screen, bow), target, atol=1e-9)
    assert np.isnan(intersect_surface(origin, origin - target, screen, bow)).all()  # the screen is behind
