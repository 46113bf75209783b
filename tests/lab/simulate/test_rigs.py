"""The simulated lab: its cameras look at what they are aimed at, also with pictures of another size."""

from __future__ import annotations

import numpy as np
import pytest

from lab.simulate.scenarios import IMAGE_SIZE_PX, RIGS, lab_camera, scaled

AIM = np.array([1.2, -0.4, 0.3])


def test_what_a_camera_is_aimed_at_is_in_the_middle_of_its_picture():
    camera = lab_camera("left", "left", (-2.0, 0.5, 0.8), AIM)
    np.testing.assert_allclose(camera.project(AIM[None])[0], (np.array(IMAGE_SIZE_PX) - 1) / 2, atol=1e-9)


@pytest.mark.parametrize("scale", [0.25, 0.5, 2.0])
def test_a_smaller_picture_shows_the_same_at_the_same_share_of_its_sides(scale):
    """The edges of a picture are at -0.5 and n - 0.5."""
    rig = RIGS["fan"]()
    for name, camera in scaled(rig, scale).cameras.items():
        whole = rig.cameras[name]
        points = whole.camera_from_world.inverse().apply(
            np.array([[0.1, -0.2, 2.0], [-0.3, 0.4, 3.0], [0.0, 0.0, 1.5]])
        )
        assert camera.image_size_px == tuple(round(scale * n) for n in whole.image_size_px)
        np.testing.assert_allclose(camera.project(points) + 0.5, scale * (whole.project(points) + 0.5), atol=1e-9)


@pytest.mark.parametrize(("one", "other"), [("left-a", "right-a"), ("left-b", "right-b")])
def test_half_a_turn_about_z_maps_the_cameras_of_one_screen_onto_those_of_the_other(one, other):
    """The rig is symmetric: what symmetry hides is tested with it."""
    rig = RIGS["two-cameras-per-screen"]()
    a, b = (rig.cameras[name].camera_from_world.inverse() for name in (one, other))
    half = np.diag([-1.0, -1.0, 1.0])
    np.testing.assert_allclose(half @ a.translation, b.translation, atol=1e-12)
    np.testing.assert_allclose(half @ a.rotation, b.rotation, atol=1e-12)
