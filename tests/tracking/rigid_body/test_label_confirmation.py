"""A label that nothing else checks waits for the next frame."""

from __future__ import annotations

import numpy as np

from geometry.forward_model import SpotModel
from geometry.pose import Pose
from lab.simulate.rigs import RIGS
from tracking.rigid_body.label_confirmation import decisive

MODEL = SpotModel.of(RIGS["unequal-fan"]())  # three beams: on each of two screens three spots on a line
POSE = Pose.from_ypr(np.deg2rad([3.0, -2.0, 1.0]), np.array([0.02, -0.01, 0.03]))
COV = np.tile(0.1**2 * np.eye(2), (len(MODEL), 1, 1))
FIRST_SCREEN = MODEL.camera_of == MODEL.camera_of[0]


def decisive_of(use: np.ndarray) -> np.ndarray:
    return decisive(MODEL, POSE.rotation, POSE.translation, use, COV)


def test_the_only_spot_on_the_second_screen_determines_the_pose_alone():
    for other in np.flatnonzero(~FIRST_SCREEN):
        use = FIRST_SCREEN.copy()
        use[other] = True
        assert decisive_of(use)[other]


def test_no_spot_is_decisive_where_all_are_visible():
    assert not decisive_of(np.ones(len(MODEL), dtype=bool)).any()


def test_views_that_are_not_used_are_not_decisive():
    assert not decisive_of(np.zeros(len(MODEL), dtype=bool)).any()
