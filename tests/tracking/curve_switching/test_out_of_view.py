"""Which views follow from which others by the paper's formulas, and that they agree with the rigid body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geometry.forward_model import SpotModel
from geometry.rig import Beam
from lab.simulate.scenarios import RIGS
from tests.geometry.scenes import random_pose
from tracking.curve_switching.out_of_view import CoplanarViews, quadratic_positions

EXACT_PX = 1e-6


def set_up(name: str):
    rig = RIGS[name]()
    model = SpotModel.of(rig)
    return rig, model, CoplanarViews.of(model)


@pytest.mark.parametrize("name", ["fan", "unequal-fan", "two-cameras-per-screen"])
def test_any_beam_out_of_view_is_solved_from_the_other_two(name):
    """Noise-free, 50 poses within 1 m and 30 deg: outer beams by eq. (14), the middle one by a rotation."""
    rig, model, coplanar = set_up(name)
    rng, off_px, solved = np.random.default_rng(1), [], 0
    for _ in range(50):
        true = model.project(random_pose(rng, 1.0, np.deg2rad(30)))[0]
        if np.isnan(true).any():
            continue
        for beam in range(3):
            unseen = model.beam_of == beam
            seen = np.where(unseen[:, None], np.nan, true)
            found = quadratic_positions(rig, model, coplanar, seen)
            np.testing.assert_array_equal(np.isnan(found[:, 0]), ~unseen)  # none for a matched view
            off_px.append(np.abs(found[unseen] - true[unseen]).max())
            solved += 1
    assert solved > 100
    assert np.max(off_px) < EXACT_PX


def test_a_single_spot_out_of_view_is_solved():
    rig, model, coplanar = set_up("fan")
    true = model.project(random_pose(np.random.default_rng(2), 0.3, 0.2))[0]
    for view in range(len(model)):
        seen = true.copy()
        seen[view] = np.nan
        found = quadratic_positions(rig, model, coplanar, seen)
        np.testing.assert_allclose(found[view], true[view], atol=EXACT_PX)
        assert np.isnan(np.delete(found, view, axis=0)).all()


def test_one_beam_in_view_is_not_enough():
    rig, model, coplanar = set_up("fan")
    true = model.project(random_pose(np.random.default_rng(3), 0.3, 0.2))[0]
    seen = np.where((model.beam_of == 0)[:, None], true, np.nan)
    assert np.isnan(quadratic_positions(rig, model, coplanar, seen)).all()


def test_two_beams_seen_at_one_end_only_do_not_determine_their_intersection():
    rig, model, coplanar = set_up("fan")
    true = model.project(random_pose(np.random.default_rng(4), 0.3, 0.2))[0]
    left = np.array([c == "left" for c, _ in model.views])
    seen = np.where(left[:, None], true, np.nan)
    seen[2] = np.nan
    assert np.isnan(quadratic_positions(rig, model, coplanar, seen)).all()


def test_a_beam_that_misses_its_screen_gets_no_position():
    """Rotated until the third beam is parallel to the screens: neither the rigid body nor eq. (14) has a spot there."""
    rig, model, coplanar = set_up("fan")
    pose = random_pose(np.random.default_rng(5), 0.0, 0.0).from_ypr(np.deg2rad([68.0, 0, 0]), np.zeros(3))
    world = model.hits(pose)
    assert np.isfinite(world[[0, 1, 3, 4]]).all()
    # At 88 deg from the normal beam C's spot is hundreds of metres away; beyond 90 deg there is none.
    pose = pose.from_ypr(np.deg2rad([71.0, 0, 0]), np.zeros(3))
    hit = model.hits(pose)
    assert np.isnan(hit[[2, 5]]).all()
    seen = model.project(pose)[0]
    if np.isfinite(seen[[0, 1, 3, 4]]).all():
        assert np.isnan(quadratic_positions(rig, model, coplanar, seen)[[2, 5]]).all()


def test_skew_beams_have_no_construction():
    assert set_up("four-skew-beams")[2].constructions == ()


@pytest.mark.parametrize(("shift_m", "tilt", "any_left"), [(0.5e-3, 0.0, True), (2e-3, 0.0, False), (0.0, 0.5e-3, True),
                                                            (0.0, 2e-3, False)])  # fmt: skip
def test_beams_are_coplanar_to_a_millimetre_and_a_milliradian(shift_m, tilt, any_left):
    """Beam C shifted off the intersection, or tilted out of the plane."""
    rig = RIGS["fan"]()
    c = rig.beams["C"]
    moved = Beam("C", c.direction + np.array([0, 0, tilt]), c.point + np.array([0, 0, shift_m]))
    rig = replace(rig, beams={**rig.beams, "C": moved})
    assert bool(CoplanarViews.of(SpotModel.of(rig)).constructions) == any_left


def test_moving_a_beams_point_along_its_line_changes_nothing():
    rig, model, coplanar = set_up("unequal-fan")
    slid = {n: Beam(n, b.direction, b.point + s * b.direction) for (n, b), s in zip(rig.beams.items(), (0.3, -0.4, 0.2),
                                                                                     strict=True)}  # fmt: skip
    other = replace(rig, beams=slid)
    other_model = SpotModel.of(other)
    true = model.project(random_pose(np.random.default_rng(6), 0.3, 0.2))[0]
    seen = np.where((model.beam_of == 2)[:, None], np.nan, true)
    np.testing.assert_allclose(
        quadratic_positions(rig, model, coplanar, seen),
        quadratic_positions(other, other_model, CoplanarViews.of(other_model), seen),
        atol=EXACT_PX,
    )
