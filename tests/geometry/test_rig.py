"""The rig: references between its parts, and the views that they define."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from geometry.rig import Beam, Spot
from tests.geometry.scenes import camera_that_looks_at, paper_rig


def test_the_direction_of_a_beam_is_normalised():
    np.testing.assert_allclose(Beam("A", np.array([0.0, 3.0, 4.0]), np.zeros(3)).direction, [0, 0.6, 0.8], rtol=1e-15)


@pytest.mark.parametrize("direction", [[0.0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 0]])
def test_a_beam_without_direction_is_refused_with_its_name(direction):
    with pytest.raises(ValueError, match=r"beam 'A': the direction has no length"):
        Beam("A", np.array(direction), np.zeros(3))


def test_a_camera_of_an_unknown_screen_is_refused_with_its_name():
    rig = paper_rig()
    stray = dataclasses.replace(rig.cameras["left"], screen="wall")
    with pytest.raises(ValueError, match=r"camera 'left' observes screen 'wall', which is not in the rig"):
        dataclasses.replace(rig, cameras={"left": stray})


@pytest.mark.parametrize(
    ("spot", "message"),
    [
        (Spot("9", "A", +1, "wall"), r"spot '9' falls on screen 'wall', which is not in the rig"),
        (Spot("9", "Z", +1, "left"), r"spot '9' belongs to beam 'Z', which is not in the rig"),
    ],
)
def test_a_spot_of_an_unknown_screen_or_beam_is_refused_with_its_name(spot, message):
    rig = paper_rig()
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(rig, spots={**rig.spots, "9": spot})


def test_a_camera_views_the_spots_of_its_screen_and_no_others():
    assert paper_rig().views() == [
        ("left", "1"), ("left", "2"), ("left", "3"), ("right", "4"), ("right", "5"), ("right", "6"),
    ]  # fmt: skip


def test_two_cameras_may_observe_one_screen():
    rig = paper_rig()
    second = camera_that_looks_at("second", rig.screens["left"], np.array([0.5, 0.2, -3.0]), ())
    both = dataclasses.replace(rig, cameras={**rig.cameras, "second": second})
    assert both.views()[-3:] == [("second", "1"), ("second", "2"), ("second", "3")]
    assert len(both.views()) == 9


def test_a_calibrated_value_cannot_be_changed_in_place():
    rig = paper_rig()
    with pytest.raises(dataclasses.FrozenInstanceError):
        rig.cameras["left"].matrix = np.eye(3)
