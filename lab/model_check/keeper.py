"""Frames of a run kept for the model check as they come, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from geometry.arrays import Array, Bools
from geometry.pose import Pose
from lab.model_check.recording import Recording
from tracking.tracked_frame import TrackedFrame

MOST_KEPT = 2000  # frames; as many as the statistics use
BLOCK = 3  # neighbouring frames are kept together: they tell how fast the spots move


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


@dataclass(slots=True)
class FrameKeeper:
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
    ) -> None:
        """The next frame. Shapes as in KeptFrame; the arrays are not copied."""
        number, self._count = self._count, self._count + 1
        if (number // BLOCK) % self._stride:
            return
        n = len(seen)
        nothing = np.full((n, 2), np.nan) if predicted_px is None else predicted_px
        unsure = np.full((n, 2, 2), np.nan) if predicted_cov_px2 is None else predicted_cov_px2
        self._frames.append(KeptFrame(t_s, seen, uv_px, cov_px2, pose, nothing, unsure, pose_covariance))
        self._numbers.append(number)
        if len(self._frames) > self.most:
            self._stride *= 2
            kept = [i for i, k in enumerate(self._numbers) if not (k // BLOCK) % self._stride]
            self._frames = [self._frames[i] for i in kept]
            self._numbers = [self._numbers[i] for i in kept]

    def add_tracked(self, t_s: float, tracked: TrackedFrame, predicted_cov_px2: Array | None = None) -> None:
        """The next frame as a tracker or a smoother tells it: seen is what it measured.

        predicted_cov_px2 (n, 2, 2): what it claimed of its prediction; without it there is no NIS.
        """
        self.add(
            t_s,
            np.array([status.measured for status in tracked.status], dtype=np.bool_),
            tracked.uv_px,
            tracked.cov_px2,
            tracked.pose,
            tracked.predicted_px,
            predicted_cov_px2,
            tracked.pose_covariance,
        )

    def recording(self) -> Recording | None:
        """What was kept; None where no frame came."""
        kept = self._frames
        if not kept:
            return None
        nowhere = Pose(np.full((3, 3), np.nan), np.full(3, np.nan))
        poses = [nowhere if k.pose is None else k.pose for k in kept]
        unknown = np.full((6, 6), np.nan)
        claims = [unknown if k.pose_covariance is None else k.pose_covariance for k in kept]
        return Recording(
            t_s=np.array([k.t_s for k in kept]),
            seen=np.stack([k.seen for k in kept]),
            uv_px=np.stack([k.uv_px for k in kept]),
            cov_px2=np.stack([k.cov_px2 for k in kept]),
            poses=Pose(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses])),
            predicted_px=np.stack([k.predicted_px for k in kept]),
            predicted_cov_px2=np.stack([k.predicted_cov_px2 for k in kept]),
            pose_covariance=None if all(k.pose_covariance is None for k in kept) else np.stack(claims),
        )
