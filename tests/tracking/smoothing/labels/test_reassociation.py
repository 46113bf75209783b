"""A frame's detections are assigned again from the motion that the other frames give."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.pose import Pose
from lab.simulate.points import simulate_points
from tests.tracking.rigid_runs import RIGID, dt_of, found_in, tracked
from tracking.detections import Detections
from tracking.rigid_body.association.frame_detections import DetectionModel, ViewTable
from tracking.smoothing.labels.reassociation import RunObservation, reassociated, run_log_static
from tracking.smoothing.motion.run_detections import Reference
from tracking.smoothing.recording import TrackedRecording

SIGMA = np.repeat([1e-5, 1e-4], 3)  # m, rad: of the prediction from the other frames
JUMP_SIGMA = np.repeat([1e-3, 1e-2], 3)  # of what a velocity jump at the frame adds
AT = 60


@pytest.mark.parametrize("kept", [0, 3])
def test_points_of_a_frame_are_labelled_where_a_corner_explains_them(kept):
    """The motion of the other frames does not lead to them.

    kept: labels that the frame has, but that the motion does not use. Without labels nothing contradicts the motion of
    the others, which confirms nothing; labels that the motion does not use have no part in the prediction.
    """
    run = simulate_points("sharp-turns", 1, frames=90)
    recording = TrackedRecording(run.rig, RIGID, None)
    for k, frame in enumerate(tracked(run)):
        recording.append(dt_of(run, k), found_in(run, k), frame)
    detections, right = recording.run_detections(), recording.assigned
    labelled = np.flatnonzero(right[AT] >= 0)
    assigned = right.copy()
    assigned[AT, labelled[kept:]] = -1
    weight = np.ones(frames := len(right))
    weight[AT] = 0.0

    poses = Pose(run.poses.rotation.copy(), run.poses.translation.copy())
    off = poses[AT].plus(np.array([0.0, 0.0, 0.0, 0.0, 8e-3, -6e-3]))  # 10 px
    poses.rotation[AT], poses.translation[AT] = off.rotation, off.translation
    n = right.shape[1]
    views = run.model.numbers
    observation = RunObservation(
        views, ViewTable.of(run.rig, run.model), DetectionModel(0.98, 0.0), np.zeros((n, 2, 2)), detections,
        np.full(len(detections.uv), -np.inf),
    )  # fmt: skip
    found, probability, _ = reassociated(
        observation,
        assigned,
        Reference(poses.rotation, poses.translation, np.zeros((frames, 12))),
        np.tile(np.diag(SIGMA**2), (frames, 1, 1)),
        weight,
        np.full((frames, n), np.log(1e-6)),
        np.tile(JUMP_SIGMA, (frames, 1)),
    )
    assert len(labelled) >= 3
    np.testing.assert_array_equal(found[AT][labelled], right[AT][labelled])
    assert probability[AT][labelled].min() > 0.99


def test_the_first_frames_know_the_static_points_that_later_ones_show():
    """A lamp that was taken for a spot at the start stays where it is when the spot has moved on."""
    run = simulate_points("sharp-turns", 1, frames=30)
    recording, lamp = TrackedRecording(run.rig, RIGID, None), np.array([[20.0, 30.0]])
    answers = tracked(run)
    for k, frame in enumerate(answers):
        found = found_in(run, k)
        with_lamp = found[0].joined(Detections.at(lamp, np.tile(0.01 * np.eye(2), (1, 1, 1))), 1000)
        recording.append(dt_of(run, k), [with_lamp, *found[1:]], frame)
    detections, n = recording.run_detections(), len(run.model)
    assigned = np.full((30, n), -1)
    is_lamp = np.all(detections.uv == lamp, axis=1)
    assert is_lamp.sum() == 30
    camera_of = run.model.camera_of
    assigned[0, np.flatnonzero(camera_of == 0)[0]] = np.flatnonzero(is_lamp)[0] - detections.begin[0]
    ref = Reference(run.poses.rotation, run.poses.translation, np.zeros((30, 12)))
    noise_px2 = np.full(len(detections.uv), 0.01)
    log_static = run_log_static(
        run.model.numbers, camera_of, detections, noise_px2, assigned, ref, np.ones(30, dtype=bool)
    )
    assert np.isfinite(log_static[is_lamp]).all()
    assert np.isneginf(log_static[~is_lamp]).mean() > 0.99
