"""The rigid tracker run backward in time through frames that the causal tracker did not measure with certainty.

After an occlusion the causal tracker may need some frames to find the vehicle again; backward in time these frames are
ordinary tracking. Where a few spots allow two poses, the two directions agree only on the right one. Source: ours;
forward and backward tracks as in two-filter smoothing.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Bools, Ints
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from tracking.rigid_body.acquisition import FIRST_ACCELERATION, FIRST_ANGULAR_ACCELERATION
from tracking.rigid_body.association.frame_detections import distinct_spots
from tracking.rigid_body.hypotheses.hypothesis_set import MIN_REDUNDANT_SPOTS
from tracking.rigid_body.models.motion import STATE
from tracking.rigid_body.rigid_tracker import RigidTracker
from tracking.smoothing.motion.run_detections import SmoothedMotion
from tracking.smoothing.recording import TrackedRecording, assigned_in_one_list
from tracking.statuses import PoseStatus

MIN_FRAMES = 2  # a shorter stretch is left to the smoother, which bounds it from both sides
DISAGREEMENT_CHI2 = 36.0  # of 6 degrees of freedom: poses of the two directions farther apart are different answers


class BackwardLabels:
    """Answers of the backward tracker for T frames with n views."""

    def __init__(self, frames: int, views: int) -> None:
        self.assigned = np.full((frames, views), -1, dtype=np.int64)  # as in TrackedRecording
        self.measured = np.zeros(frames, dtype=bool)
        self.R, self.t = np.full((frames, 3, 3), np.nan), np.full((frames, 3), np.nan)  # where measured
        self.disagrees = np.zeros(frames, dtype=bool)  # it has measured another pose than the forward tracker


def track_backward(rec: TrackedRecording, motion: SmoothedMotion, weak: Bools, sure: Bools) -> BackwardLabels:
    """Track each stretch of weak (T,) frames backward from the sure (T,) frame after it.

    motion: the present estimate, from which the tracks start.
    """
    out = BackwardLabels(len(rec), len(rec.model))
    for first, last in _stretches(weak):
        if last - first + 1 < MIN_FRAMES or last + 1 >= len(rec) or not sure[last + 1]:
            continue
        _track_stretch(rec, motion, first, last, out)
    return out


def _track_stretch(rec: TrackedRecording, motion: SmoothedMotion, first: int, last: int, out: BackwardLabels) -> None:
    ref, start = motion.ref, last + 1
    pose = Pose(ref.R[start], ref.t[start])
    tracker = RigidTracker(rec.rig, rec.parameters, PosePrior(pose, 1.0, 0.5), None)
    P = np.diag(np.repeat([0.0, 0.0, 0.0, 0.0, FIRST_ACCELERATION, FIRST_ANGULAR_ACCELERATION], STATE // 6) ** 2)
    P[:6, :6], P[6:12, 6:12] = motion.pose_P[start], motion.motion_P[start]
    m = np.concatenate([-ref.m[start, :6], ref.m[start, 6:]])  # time reversed: velocities change sign
    tracker.begin_at(pose, m, P)
    dt = rec.dt_s
    poses, causal = rec.poses, rec.measured
    for k in range(last, first - 1, -1):
        tracked = tracker.step(float(dt[k + 1]), rec.found_backward(k))
        out.assigned[k] = assigned_in_one_list(tracked, rec.first(k)[rec.model.camera_of])
        out.measured[k] = tracked.pose_status is PoseStatus.MEASURED
        if out.measured[k] and tracked.pose is not None:
            out.R[k], out.t[k] = tracked.pose.rotation, tracked.pose.translation
        if causal[k] and tracked.pose is not None and tracked.pose_covariance is not None:
            d = tracked.pose.minus(Pose(poses[k, :3], poses[k, 3]))
            spread = tracked.pose_covariance + np.eye(6) * 1e-12
            out.disagrees[k] = bool(out.measured[k] and d @ np.linalg.solve(2 * spread, d) > DISAGREEMENT_CHI2)


def _stretches(mask: Bools) -> list[tuple[int, int]]:
    """First and last index of each stretch of True, the last stretch first."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)][::-1]


def merged(causal: Ints, backward: BackwardLabels, weak: Bools, spot_of: Ints) -> Ints:
    """Labels (T, n): the backward tracker's for weak frames in which it measured the pose, else the causal ones.

    A single label more than the causal tracker gave may be a false point near an occluded spot, and so may one of
    three: these are not taken.
    """
    out = causal.copy()
    causal_count, count = (distinct_spots(labels >= 0, spot_of) for labels in (causal, backward.assigned))
    take = (
        weak & backward.measured & (count >= MIN_REDUNDANT_SPOTS) & ((count >= causal_count + 2) | (causal_count == 0))
    )
    out[take] = backward.assigned[take]
    return out
