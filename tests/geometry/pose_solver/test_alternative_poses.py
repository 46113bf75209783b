"""Other poses with the same spots: exact and complete for three spots, none for four spots of skew beams."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import fit_pose
from geometry.pose_solver.visibility import alternative_poses, symmetries
from lab.simulate.scenarios import RIGS
from tests.geometry.scenes import random_pose


def seen_poses(model: SpotModel, rows: list[int], count: int, rng: np.random.Generator) -> list[Pose]:
    """Random poses at which all these views have a projection."""
    out: list[Pose] = []
    while len(out) < count:
        pose = random_pose(rng, 0.4, 0.3)
        if np.isfinite(model.project(pose)[0][rows]).all():
            out.append(pose)
    return out


THREE = [0, 1, 2]  # spots 1, 2, 3 of four skew beams, all on the left screen


def test_an_alternative_pose_puts_the_same_spots_on_the_same_pixels():
    model, rng = SpotModel.of(RIGS["four-skew-beams"]()), np.random.default_rng(1)
    counts = []
    for pose in seen_poses(model, THREE, 12, rng):
        others = alternative_poses(model, pose, THREE)
        counts.append(len(others.translation))
        for i in range(counts[-1]):
            np.testing.assert_allclose(model.project(others[i])[0][THREE], model.project(pose)[0][THREE], atol=1e-5)
            assert np.abs(others[i].minus(pose)).max() > 1e-4
    assert np.mean(counts) > 1


def test_fits_from_random_starts_find_no_further_pose():
    model, rng = SpotModel.of(RIGS["four-skew-beams"]()), np.random.default_rng(2)
    found = 0
    for pose in seen_poses(model, THREE, 4, rng):
        others = alternative_poses(model, pose, THREE)
        known = [pose, *(others[i] for i in range(len(others.translation)))]
        target = model.project(pose)[0][THREE]
        for _ in range(150):
            start = random_pose(rng, 1.5, np.pi)
            fit = fit_pose(model, np.array(THREE), target, np.tile(np.eye(2), (3, 1, 1)), start)
            if fit is None or not fit.observable or fit.chi2 > 1e-12:
                continue
            found += 1
            assert min(np.abs(fit.world_from_body.minus(k)).max() for k in known) < 1e-3
    assert found > 50


def test_a_fourth_spot_of_skew_beams_leaves_no_other_pose():
    model, rng = SpotModel.of(RIGS["four-skew-beams"]()), np.random.default_rng(3)
    for pose in seen_poses(model, [0, 1, 2, 5], 20, rng):
        assert len(alternative_poses(model, pose, [0, 1, 2, 5]).translation) == 0


def test_views_of_the_same_spots_by_a_second_camera_exclude_no_pose():
    rig = RIGS["two-cameras-per-screen"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(4)
    first = {v: i for i, v in enumerate(model.views)}
    one = [first["left-a", "1"], first["left-a", "2"], first["right-a", "5"]]
    both = [*one, first["left-b", "1"], first["right-b", "5"]]
    for pose in seen_poses(model, both, 10, rng):
        a, b = alternative_poses(model, pose, one), alternative_poses(model, pose, both)
        assert len(a.translation) == len(b.translation)
    pair = [first["left-a", "1"], first["left-b", "1"], first["left-a", "2"]]
    assert len(alternative_poses(model, Pose.identity(), pair).translation) == 0


@pytest.mark.parametrize("rows", [[], [0], [0, 4], [0, 1, 2]])
def test_spots_that_do_not_determine_a_pose_have_no_alternatives(rows):
    """None, one, two, or three spots on a line allow a continuum of poses."""
    model = SpotModel.of(RIGS["fan"]())
    assert len(alternative_poses(model, Pose.identity(), rows).translation) == 0


def test_a_fan_of_equal_angles_and_two_beams_are_symmetric_under_half_a_turn():
    for name, expected in (("fan", 1), ("two-cameras-per-screen", 1), ("unequal-fan", 0), ("four-skew-beams", 0)):
        assert len(symmetries(SpotModel.of(RIGS[name]()))) == expected
    (turn,) = symmetries(SpotModel.of(RIGS["fan"]()))
    np.testing.assert_allclose(turn.rotation, np.diag([1.0, -1.0, -1.0]), atol=1e-12)
    np.testing.assert_allclose(turn.translation, 0.0, atol=1e-12)


def test_a_symmetric_vehicle_shows_the_same_points_after_its_symmetry():
    model, rng = SpotModel.of(RIGS["fan"]()), np.random.default_rng(5)
    (turn,) = symmetries(model)
    for _ in range(5):
        pose = random_pose(rng, 0.3, 0.2)
        here, there = model.project(pose)[0], model.project(pose @ turn)[0]
        np.testing.assert_allclose(there[[2, 1, 0, 5, 4, 3]], here, atol=1e-8)
