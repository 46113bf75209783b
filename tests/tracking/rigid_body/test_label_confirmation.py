"""A label that nothing else checks waits for the next frame."""

from __future__ import annotations

import numpy as np

from geometry.forward_model import SpotModel
from geometry.pose import Pose
from lab.simulate.scenarios import RIGS
from tracking.rigid_body.association.frame_detections import FrameDetections
from tracking.rigid_body.label_confirmation import MIN_EVIDENCE_NATS, FirstEvidence, decisive

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


def evidence_of(step_px: float, nats: float = 3.0, frames: int = 20) -> float:
    """The evidence after frames in which all views have points that move by so many px per frame."""
    evidence, n, rng = FirstEvidence(len(MODEL)), len(MODEL), np.random.default_rng(1)
    start = rng.uniform(100.0, 900.0, (n, 2))
    views = np.zeros(n)
    for k in range(frames):
        uv = start + step_px * k + rng.normal(0.0, 0.1, (n, 2))
        frame = FrameDetections(
            uv, COV, views, np.array([0, n]), np.ones(1, dtype=bool), views, np.full(n, -np.inf), views, views, views
        )
        assert evidence.add(frame, np.arange(n), nats, continued=k > 0)
    return evidence.nats


def test_points_at_rest_are_evidence_once_however_many_frames_show_them():
    """False points at rest that fit a vehicle by chance fit it in each frame."""
    assert evidence_of(0.0) == 3.0
    assert evidence_of(2.0) > 2.0 * MIN_EVIDENCE_NATS


def test_small_evidence_against_a_vehicle_adds_up_at_rest_as_well():
    evidence = FirstEvidence(len(MODEL))
    n, views = len(MODEL), np.zeros(len(MODEL))
    frame = FrameDetections(
        np.zeros((n, 2)), COV, views, np.array([0, n]), np.ones(1, dtype=bool), views, views, views, views, views
    )
    assert [evidence.add(frame, np.arange(n), -2.0, continued=k > 0) for k in range(3)] == [True, True, False]
