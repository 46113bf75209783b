"""The trackers of beampose. They get the rig and a prior, but no labels."""

from __future__ import annotations

from collections.abc import Sequence
from time import process_time
from typing import Literal

import numpy as np

from bench.peers.rows import Tracked
from bench.peers.scenes import CAMERA_OF, FRAME_S, NOISE_PX, Scene, rig
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from tracking.curve_switching.spot_tracker import SpotTracker
from tracking.detections import UNMATCHED, Detections
from tracking.parameters import TrackerParameters
from tracking.rigid_body.rigid_tracker import RigidTracker
from tracking.smoothing.recording import TrackedRecording
from tracking.smoothing.smoother import smooth
from tracking.statuses import TrackedFrame

PRIOR = PosePrior(Pose.identity(), within_m=1.0, within_rad=float(np.deg2rad(35.0)))


def track(scene: Scene, method: Literal["rigid", "spots"], smoothed: bool = False) -> Tracked:
    """Track frame by frame as in a run; `smoothed`: with the smoothing pass."""
    parameters = TrackerParameters(method=method)
    tracker = RigidTracker(rig(), parameters, PRIOR) if method == "rigid" else SpotTracker(rig(), parameters, PRIOR)
    recording = TrackedRecording(rig(), parameters) if smoothed else None
    frames, every = [], []
    start = process_time()
    for k, found in enumerate(scene.detections):
        points = [Detections.at(p, np.broadcast_to(NOISE_PX**2 * np.eye(2), (len(p), 2, 2))) for p in found]
        dt_s = FRAME_S if k else 0.0
        frames.append(tracker.step(dt_s, points))
        if recording is not None:
            every.append(points)
            recording.append(dt_s, points, frames[-1])
    if recording is not None:
        second = smooth(recording)
        frames = [second.frame(k, causal, every[k]) for k, causal in enumerate(frames)]
    return named(scene, frames, process_time() - start)


def named(scene: Scene, frames: Sequence[TrackedFrame], spent_s: float) -> Tracked:
    """Rows of all spots: with their detection if there is one, otherwise with the estimate if it is known."""
    point = np.array([f.point for f in frames])
    uv = np.array([f.uv_px for f in frames])
    measured = point != UNMATCHED
    for k, s in zip(*np.nonzero(measured), strict=True):
        uv[k, s] = scene.detections[k][CAMERA_OF[s]][point[k, s]]
    known = ~np.isnan(uv[..., 0])
    frame, spot = np.nonzero(known)
    return Tracked(frame, CAMERA_OF[spot], spot, uv[known], measured[known], spent_s)
