"""The vehicle is found whatever the frame rate, the focal length and the number of beams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geometry.pose import Pose
from geometry.rig import Beam, Rig, Spot
from lab.simulate.points import with_occlusions
from lab.simulate.rigs import fan, look_at
from tests.tracking.rigid_runs import assess, recording_of, smoothed_frames, tracked
from tracking.statuses import PoseStatus

ANGLES_DEG = (-5.0, 5.0)


def two_beams(focal_px: float) -> Rig:
    """Two beams 10 deg apart with both ends visible on screens 2.5 m away on either side: spots 44 cm apart."""
    like = fan()
    cameras = {}
    for name, camera in like.cameras.items():
        matrix = np.array(camera.matrix)
        matrix[0, 0] = matrix[1, 1] = focal_px
        side = 1.0 if name == "right" else -1.0
        aimed = look_at(np.array([-1.6 * side, -0.6 * side, 1.5]), np.array([2.5 * side, 0.0, 0.0]))
        cameras[name] = replace(camera, matrix=matrix, distortion=(), camera_from_world=aimed)
    beams = {
        name: Beam(name, np.array([np.cos(a), np.sin(a), 0.0]), np.zeros(3))
        for name, a in zip("AB", np.deg2rad(ANGLES_DEG), strict=True)
    }
    spots = {
        name: Spot(name, beam, sign, screen)
        for name, beam, sign, screen in (
            ("1", "A", -1, "left"), ("2", "B", -1, "left"), ("3", "A", 1, "right"), ("4", "B", 1, "right"),
        )
    }  # fmt: skip
    return Rig(like.screens, cameras, beams, spots)


@pytest.mark.parametrize(
    ("focal_px", "frame_rate_hz"), [(1000.0, 25.0), (2500.0, 25.0), (4000.0, 25.0), (6000.0, 25.0)]
)
def test_a_vehicle_at_rest_with_two_beams_is_found_in_the_first_frames(focal_px, frame_rate_hz):
    for seed in range(4):
        frames = 12
        rng = np.random.default_rng([seed, 1])
        place = Pose.from_ypr(np.deg2rad([3.0, 1.0, 1.0]) * rng.uniform(-1, 1, 3), 0.05 * rng.uniform(-1, 1, 3))
        poses = Pose(np.tile(place.rotation, (frames, 1, 1)), np.tile(place.translation, (frames, 1)))
        run = recording_of(two_beams(focal_px), poses, np.arange(frames) / frame_rate_hz, 0.05, seed)
        causal = tracked(run)
        of = assess(run, causal)
        assert of.wrong == 0
        assert of.visible.sum() >= 0.8 * of.visible.size
        assert np.array_equal(of.right[3:], of.visible[3:])
        assert all(f.pose_status is PoseStatus.MEASURED for f in causal[3:])
        again, _ = smoothed_frames(run, causal)
        assert assess(run, again).identity == 1.0


def test_a_vehicle_is_found_at_once_after_an_occlusion_wherever_the_prediction_has_drifted():
    """A swing that is occluded in full motion: after a second the prediction puts no spot on the screens any more."""
    for seed in range(3):
        frames, rate = 90, 30.0
        t = np.arange(frames) / rate
        yaw = np.deg2rad(6.0) * np.sin(2 * np.pi * 2.0 * t + seed)
        poses = Pose.from_ypr(
            np.stack([yaw, 0.5 * yaw, 0 * yaw], axis=1), np.stack([0.02 * yaw, yaw * 0.3, 0 * yaw], 1)
        )
        run = recording_of(two_beams(1500.0), poses, t, 0.05, seed)
        occluded = np.zeros_like(run.in_view, dtype=bool)
        occluded[30:62] = True
        run = with_occlusions(run, occluded)
        of = assess(run, tracked(run))
        assert of.wrong == 0
        assert np.array_equal(of.right[63:], of.visible[63:])
        assert of.visible[63:].sum() > 60
