"""Where a spot can lie in a picture: along the uncertainty of a pose, and along its beam."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import pixel_covariance
from geometry.uncertainty.rig_uncertainty import beam_image, scatter, uncertainty_tracks, unlimited
from tests.lab.fake_results import fake_rig

RIG = fake_rig()
MODEL = SpotModel.of(RIG)
POSE = Pose.from_ypr(np.radians([4.0, -3.0, 2.0]), np.array([0.1, -0.05, 0.08]))


def test_a_pose_that_is_uncertain_along_one_line_has_exactly_the_images_of_that_line():
    along = np.array([0.1, 0.2, -0.1, 0.05, -0.12, 0.1])  # large enough for tracks that bend
    tracks = uncertainty_tracks(MODEL, POSE, np.outer(along, along), 3.0, 41)
    exact = MODEL.project(POSE.plus(np.linspace(-3, 3, 41)[:, None] * along))[0]
    for i in range(len(MODEL)):
        forward = np.nanmax(np.abs(tracks[i] - exact[:, i]))
        backward = np.nanmax(np.abs(tracks[i] - exact[::-1, i]))  # an axis has no sign
        assert min(forward, backward) < 1e-6
        bend = np.abs(exact[20, i] - 0.5 * (exact[0, i] + exact[-1, i])).max()
        assert bend > 1


def test_a_track_ends_at_the_sigmas_of_the_longest_axis_of_the_spot():
    P = np.diag([1e-8, 4e-8, 2e-8, 1e-8, 3e-8, 5e-8])
    tracks = uncertainty_tracks(MODEL, POSE, P, 3.0, 7)
    longest = 3 * np.sqrt(np.linalg.eigvalsh(pixel_covariance(MODEL.project(POSE)[1], P))[:, -1])
    np.testing.assert_allclose(np.linalg.norm(tracks[:, -1] - tracks[:, 3], axis=-1), longest, rtol=2e-3)
    np.testing.assert_allclose(tracks[:, 3], MODEL.project(POSE)[0], atol=1e-9)


@pytest.mark.parametrize("move_m", [-0.8, 0.0, 0.8])
def test_the_image_of_a_beam_holds_its_spot_wherever_the_screen_stands(move_m):
    screens = {}
    for name, screen in RIG.screens.items():
        placed = screen.world_from_screen
        moved_m = placed.translation + np.array([move_m, 0.0, 0.0])
        screens[name] = replace(screen, world_from_screen=Pose(placed.rotation, moved_m))
    moved = SpotModel.of(replace(RIG, screens=screens)).project(POSE)[0]
    for (camera, spot), place in zip(MODEL.views, moved, strict=True):
        image = beam_image(RIG, RIG.cameras[camera], spot, POSE, steps=4001)
        assert np.nanmin(np.linalg.norm(image - place, axis=1)) < 0.5


def test_a_beam_beside_its_screen_has_a_place_on_the_screen_continued():
    small = replace(RIG, screens={n: replace(s, size_m=(0.1, 0.1)) for n, s in RIG.screens.items()})
    model = SpotModel.of(small)
    beside = np.isnan(model.project(POSE)[0][:, 0])
    assert beside.any()
    np.testing.assert_allclose(unlimited(model).project(POSE)[0], MODEL.project(POSE)[0])


def test_the_scatter_is_the_covariance_of_the_differences_without_outliers():
    rng = np.random.default_rng(5)
    cov = np.array([[0.5, 0.3], [0.3, 0.4]])
    differences = rng.multivariate_normal([0, 0], cov, 4000)
    differences[::50] += 300.0
    differences[1::50] = np.nan
    np.testing.assert_allclose(scatter(differences), cov, rtol=0.1)
    assert np.isnan(scatter(differences[2:11])).all()  # nine are too few
