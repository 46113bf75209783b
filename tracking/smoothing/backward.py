"""The rigid tracker run backward in time, from where the vehicle is known into the frames in which it was not found.

After an occlusion the causal tracker may need a while to find the vehicle again; seen from the other side the same
frames are plain tracking. And where a few spots allow two poses, the two directions of time agree only on the right
one. Source: ours; forward and backward tracks as in two-filter smoothing.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from tracking.rigid_body.association import distinct_spots
from tracking.rigid_body.hypotheses import FEW
from tracking.rigid_body.motion import STATE
from tracking.rigid_body.rigid_tracker import FIRST_ACCELERATION, FIRST_ANGULAR, RigidTracker
from tracking.smoothing.fixed_interval import Reference
from tracking.smoothing.recording import TrackedRecording, assigned_in_one_list
from tracking.statuses import PoseStatus

LEAST_FRAMES = 2  # a shorter stretch is left to the smoother, which sees it from both sides
APART = 36.0  # chi-square of 6 degrees: poses of the two directions farther apart are two answers


class BackwardLabels:
    """What the backward tracker says of T frames with n views."""

    def __init__(self, frames: int, views: int) -> None:
        self.assigned = np.full((frames, views), -1, dtype=np.int64)  # as in Recording; -1 without
        self.measured = np.zeros(frames, dtype=bool)
        self.R, self.t = np.full((frames, 3, 3), np.nan), np.full((frames, 3), np.nan)  # where measured
        self.disagrees = np.zeros(frames, dtype=bool)  # with the pose that the forward tracker measured


def track_backward(
    rec: TrackedRecording, ref: Reference, pose_P: Array, motion_P: Array, weak: Bools, sure: Bools
) -> BackwardLabels:
    """Labels of the stretches of weak (T,) frames, each from the first sure (T,) frame after it.

    ref, pose_P, motion_P: the motion as it is known so far, where it is sure.
    """
    out = BackwardLabels(len(rec), len(rec.model))
    for first, last in _stretches(weak):
        if last - first + 1 < LEAST_FRAMES or last + 1 >= len(rec) or not sure[last + 1]:
            continue
        _track_stretch(rec, ref, pose_P, motion_P, first, last, out)
    return out


def _track_stretch(
    rec: TrackedRecording, ref: Reference, pose_P: Array, motion_P: Array, first: int, last: int, out: BackwardLabels
) -> None:
    start = last + 1
    pose = Pose(ref.R[start], ref.t[start])
    tracker = RigidTracker(rec.rig, rec.parameters, PosePrior(pose, 1.0, 0.5), None)
    P = np.diag(np.repeat([0.0, 0.0, 0.0, 0.0, FIRST_ACCELERATION, FIRST_ANGULAR], STATE // 6) ** 2)
    P[:6, :6], P[6:12, 6:12] = pose_P[start], motion_P[start]
    m = np.concatenate([-ref.m[start, :6], ref.m[start, 6:]])  # time reversed: velocities change sign
    tracker.begin_at(pose, m, P)
    dt = rec.dt_s
    poses, causal = rec.poses, rec.measured
    for k in range(last, first - 1, -1):
        tracked = tracker.step(float(dt[k + 1]), rec.found(k))
        out.assigned[k] = assigned_in_one_list(tracked, rec.detections(k)[3][rec.model.camera_of])
        out.measured[k] = tracked.pose_status is PoseStatus.MEASURED
        if out.measured[k] and tracked.pose is not None:
            out.R[k], out.t[k] = tracked.pose.rotation, tracked.pose.translation
        if causal[k] and tracked.pose is not None and tracked.pose_covariance is not None:
            d = tracked.pose.minus(Pose(poses[k, :3], poses[k, 3]))
            spread = tracked.pose_covariance + np.eye(6) * 1e-12
            out.disagrees[k] = bool(out.measured[k] and d @ np.linalg.solve(2 * spread, d) > APART)


def _stretches(mask: Bools) -> list[tuple[int, int]]:
    """First and last index of each run of True, the last run first."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)][::-1]


def merged(causal: Ints, backward: BackwardLabels, weak: Bools, spot_of: Ints) -> Ints:
    """Labels (T, n): of weak frames those of the backward tracker where they give the pose, else what was there.

    One label more than the causal tracker gave may be a false point beside a hidden spot, and so may one of three: they
    are not taken.
    """
    out = causal.copy()
    had, has = (distinct_spots(labels >= 0, spot_of) for labels in (causal, backward.assigned))
    take = weak & backward.measured & (has >= FEW) & ((has >= had + 2) | (had == 0))
    out[take] = backward.assigned[take]
    return out
