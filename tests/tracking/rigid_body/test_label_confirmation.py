"""A label that nothing else checks waits for the next frame."""

from __future__ import annotations

import numpy as np
import pytest

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
            uv, COV, views, np.array([0, n]), np.ones(1, dtype=bool), views, np.full(n, -np.inf), *[views] * 4
        )
        assert evidence.add(frame, np.arange(n), nats, continued=k > 0)
    return evidence.nats


def test_points_at_rest_are_evidence_once_however_many_frames_show_them():
    """False points at rest that fit a vehicle by chance fit it in each frame."""
    assert evidence_of(0.0) == 3.0
    assert evidence_of(2.0) > 2.0 * MIN_EVIDENCE_NATS


@pytest.mark.parametrize("jumping", [1, 2])
def test_a_label_that_jumps_between_points_at_rest_is_no_further_evidence(jumping):
    """Objects that fit a vehicle by chance: those beside a spot take its label in turn, while the other points rest."""
    evidence, n = FirstEvidence(len(MODEL)), len(MODEL)
    uv, views = np.random.default_rng(2).uniform(100.0, 900.0, (2 * n, 2)), np.zeros(n)
    points = np.zeros(2 * n)
    frame = FrameDetections(
        uv, np.concatenate([COV, COV]), points, np.array([0, 2 * n]), np.ones(1, dtype=bool), views,
        np.full(2 * n, -np.inf), points, views, views, points,
    )  # fmt: skip
    for k in range(20):
        assigned = np.arange(n)
        assigned[:jumping] += n * (k % 2)
        if k == 7:
            assigned[n - 1] = -1
        assert evidence.add(frame, assigned, 3.0, continued=k > 0)
    assert evidence.nats == 3.0


def test_points_at_rest_need_evidence_that_is_as_rare_in_ten_frames_as_that_of_others_in_one():
    """exp(-7) per frame: at rest there is one chance in all of them."""
    for step_px, enough in ((0.0, True), (2.0, False)):
        evidence, n = FirstEvidence(len(MODEL)), len(MODEL)
        views, start = np.zeros(n), np.random.default_rng(3).uniform(100.0, 900.0, (n, 2))
        seen = []
        for k in range(12):
            frame = FrameDetections(
                start + step_px * k, COV, views, np.array([0, n]), np.ones(1, dtype=bool), views,
                np.full(n, -np.inf), *[views] * 4,
            )  # fmt: skip
            assert evidence.add(frame, np.arange(n), 0.0 if k else 5.0, continued=k > 0)
            seen.append(evidence.is_enough)
        assert not seen[0]
        assert seen[-1] is enough
    assert not FirstEvidence(1).is_enough


def test_small_evidence_against_a_vehicle_adds_up_at_rest_as_well():
    evidence = FirstEvidence(len(MODEL))
    n, views = len(MODEL), np.zeros(len(MODEL))
    frame = FrameDetections(np.zeros((n, 2)), COV, views, np.array([0, n]), np.ones(1, dtype=bool), *[views] * 6)
    assert [evidence.add(frame, np.arange(n), -2.0, continued=k > 0) for k in range(3)] == [True, True, False]
