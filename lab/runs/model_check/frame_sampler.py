"""Frames of a run kept for the model check as they come, in bounded memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from lab.runs.model_check.recording import ModelCheckRecording
from tracking.detections import UNMATCHED, Detections
from tracking.parameters import TrackerParameters
from tracking.tracked_frame import TrackedFrame

MOST_KEPT = 2000  # frames; as many as the statistics use
BLOCK = 3  # neighbouring frames are kept together: they tell how fast the spots move


def claimed_covariances(
    tracked: TrackedFrame, found: Sequence[Detections | None], camera_of: Ints, parameters: TrackerParameters
) -> Array:
    """Covariances (n, 2, 2), px^2, of the n views' measurements as the detections state them.

    The tracker's own (`TrackedFrame.cov_px2`) are widened by the noise scale that it has learnt. Residuals divided by
    those are near 1 whatever is wrong with the rig, so a test of the rig needs these. The error that the parameters
    state for the model, and for a detection that a neighbour has pulled, is added. Views without a detection keep the
    tracker's. camera_of (n,): of each view, index into `found`.
    """
    out = tracked.cov_px2.copy()
    model = parameters.sigma_model_px**2 * np.eye(2)
    for view in np.flatnonzero(tracked.point != UNMATCHED):
        points = found[int(camera_of[view])]
        if points is None:
            continue
        out[view] = points.cov_px2[tracked.point[view]] + model
        if tracked.used_in_pose is not None and not tracked.used_in_pose[view]:
            out[view] += (parameters.blend_px / 2) ** 2 * np.eye(2)
    return out


def widths(tracked: TrackedFrame, found: Sequence[Detections | None], camera_of: Ints) -> Array:
    """Sigmas (n,), px, of the light of the n views' detections; nan without. camera_of as in `claimed_covariances`."""
    out = np.full(len(camera_of), np.nan)
    for view in np.flatnonzero(tracked.point != UNMATCHED):
        points = found[int(camera_of[view])]
        if points is not None:
            out[view] = points.major_px[tracked.point[view]]
    return out


@dataclass(frozen=True, slots=True)
class KeptFrame:
    """One frame of n views, as a Recording has them."""

    t_s: float
    seen: Bools  # (n,)
    uv_px: Array  # (n, 2)
    cov_px2: Array  # (n, 2, 2)
    pose: Pose | None
    predicted_px: Array  # (n, 2); nan without
    predicted_cov_px2: Array  # (n, 2, 2); nan without
    pose_covariance: Array | None  # (6, 6)
    width_px: Array | None = None  # (n,) sigma of the light; nan where not seen or not known


@dataclass(slots=True)
class FrameSampler:
    """Keeps blocks of neighbouring frames, evenly spread: whenever it is full, every other block goes."""

    most: int = MOST_KEPT
    _frames: list[KeptFrame] = field(default_factory=list)
    _numbers: list[int] = field(default_factory=list)
    _stride: int = 1  # of the blocks that are kept
    _count: int = 0

    def add(
        self,
        t_s: float,
        seen: Bools,
        uv_px: Array,
        cov_px2: Array,
        pose: Pose | None,
        predicted_px: Array | None = None,
        predicted_cov_px2: Array | None = None,
        pose_covariance: Array | None = None,
        width_px: Array | None = None,
    ) -> None:
        """The next frame. Shapes as in KeptFrame; the arrays are not copied."""
        number, self._count = self._count, self._count + 1
        if (number // BLOCK) % self._stride:
            return
        n = len(seen)
        nothing = np.full((n, 2), np.nan) if predicted_px is None else predicted_px
        unsure = np.full((n, 2, 2), np.nan) if predicted_cov_px2 is None else predicted_cov_px2
        self._frames.append(KeptFrame(t_s, seen, uv_px, cov_px2, pose, nothing, unsure, pose_covariance, width_px))
        self._numbers.append(number)
        if len(self._frames) > self.most:
            self._stride *= 2
            kept = [i for i, k in enumerate(self._numbers) if not (k // BLOCK) % self._stride]
            self._frames = [self._frames[i] for i in kept]
            self._numbers = [self._numbers[i] for i in kept]

    def add_tracked(
        self,
        t_s: float,
        tracked: TrackedFrame,
        predicted_cov_px2: Array | None = None,
        claimed_px2: Array | None = None,
        width_px: Array | None = None,
    ) -> None:
        """The next frame as a tracker or a smoother reports it: seen is what it measured.

        predicted_cov_px2 (n, 2, 2): what it claimed of its prediction; without it there is no NIS. claimed_px2
        (n, 2, 2): see `claimed_covariances`; without it the tracker's covariances are taken for the claims.
        """
        seen = np.array([status.measured for status in tracked.status], dtype=np.bool_)
        if claimed_px2 is not None and predicted_cov_px2 is not None:
            # An innovation is judged by all that the tracker claims of it, its learnt noise scale included.
            predicted_cov_px2 = predicted_cov_px2 + tracked.cov_px2 - claimed_px2
        self.add(
            t_s,
            seen,
            tracked.uv_px,
            tracked.cov_px2 if claimed_px2 is None else claimed_px2,
            tracked.pose,
            tracked.predicted_px,
            predicted_cov_px2,
            tracked.pose_covariance,
            width_px,
        )

    def recording(self) -> ModelCheckRecording | None:
        """What was kept; None where no frame came."""
        kept = self._frames
        if not kept:
            return None
        nowhere = Pose(np.full((3, 3), np.nan), np.full(3, np.nan))
        poses = [nowhere if k.pose is None else k.pose for k in kept]
        unknown = np.full((6, 6), np.nan)
        claims = [unknown if k.pose_covariance is None else k.pose_covariance for k in kept]
        return ModelCheckRecording(
            t_s=np.array([k.t_s for k in kept]),
            seen=np.stack([k.seen for k in kept]),
            uv_px=np.stack([k.uv_px for k in kept]),
            cov_px2=np.stack([k.cov_px2 for k in kept]),
            poses=Pose(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses])),
            predicted_px=np.stack([k.predicted_px for k in kept]),
            predicted_cov_px2=np.stack([k.predicted_cov_px2 for k in kept]),
            width_px=_usual(kept),
            pose_covariance=None if all(k.pose_covariance is None for k in kept) else np.stack(claims),
        )


def _usual(kept: Sequence[KeptFrame]) -> Array | None:
    """Median over the frames of each view's width (n,); None where no frame knows any."""
    widths = [k.width_px for k in kept if k.width_px is not None]
    if not widths:
        return None
    stack = np.stack(widths)
    known = np.isfinite(stack).any(axis=0)
    out = np.full(stack.shape[1], np.nan)
    out[known] = np.nanmedian(stack[:, known], axis=0)
    return out
