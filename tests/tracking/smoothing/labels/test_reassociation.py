"""A frame's detections are assigned again from the motion that the other frames give."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.pose import Pose
from lab.simulate.points import simulate_points
from tests.tracking.rigid_runs import RIGID, dt_of, found_in, tracked
from tracking.rigid_body.association.frame_detections import DetectionModel, ViewTable
from tracking.smoothing.labels.reassociation import RunObservation, reassociated
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
        views, ViewTable.of(run.rig, run.model), DetectionModel(0.98, 0.0), np.zeros((n, 2, 2)), detections
    )
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
