"""Samples frames of a run of unknown length in bounded memory while it is processed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from calibration.model_check.linearised_frames import ModelCheckRecording
from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from lab.runs.frames.pipeline import FrameRecord
from tracking.detections import UNMATCHED, Detections
from tracking.noise_estimation.averaging import stretch_by_motion
from tracking.parameters import TrackerParameters
from tracking.statuses import PoseStatus, TrackedFrame

T = TypeVar("T")
MOST_KEPT = 2000  # frames; as many as the statistics use
BLOCK = 3  # consecutive frames that are kept together: they give the velocities of the spots


@dataclass(slots=True)
class EvenSampler(Generic[T]):
    """Keeps evenly spaced blocks of consecutive frames: whenever it is full, every other block is dropped."""

    most: int = MOST_KEPT  # frames
    kept: list[T] = field(default_factory=list)
    _numbers: list[int] = field(default_factory=list)
    _stride: int = 1  # of the blocks that are kept
    _count: int = 0

    def add(self, frame: T) -> None:
        """Add the next frame."""
        number, self._count = self._count, self._count + 1
        if (number // BLOCK) % self._stride:
            return
        self.kept.append(frame)
        self._numbers.append(number)
        if len(self.kept) > self.most:
            self._stride *= 2
            rows = [i for i, n in enumerate(self._numbers) if not (n // BLOCK) % self._stride]
            self.kept = [self.kept[i] for i in rows]
            self._numbers = [self._numbers[i] for i in rows]

    @property
    def blocks(self) -> list[list[T]]:
        """All runs of BLOCK consecutive frames that are kept."""
        rows = range(len(self.kept) - BLOCK + 1)
        whole = (i for i in rows if self._numbers[i + BLOCK - 1] - self._numbers[i] == BLOCK - 1)
        return [self.kept[i : i + BLOCK] for i in whole]


def stated_covariances(
    tracked: TrackedFrame, found: Sequence[Detections | None], camera_of: Ints, parameters: TrackerParameters
) -> Array:
    """Covariances (n, 2, 2), px^2, of the n views' measurements as the detections state them.

    The tracker's own (`TrackedFrame.cov_px2`) include its estimated noise scale. Residuals normalised by those are near
    1 whatever is wrong with the rig, so a test of the rig needs the stated ones. The error that the parameters state
    for the model, and for a detection that is shifted by a neighbouring spot, is added. Views without a detection keep
    the tracker's covariance. camera_of (n,): of each view, index into `found`.
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


def profiles(tracked: TrackedFrame, found: Sequence[Detections | None], camera_of: Ints) -> Array:
    """Second moments (n, 2, 2), px^2, of the intensity profiles of the n views' detections; nan without a detection.

    camera_of: as in `stated_covariances`.
    """
    out = np.full((len(camera_of), 2, 2), np.nan)
    for camera, points in enumerate(found):
        views = np.flatnonzero((camera_of == camera) & (tracked.point != UNMATCHED))
        if points is not None and len(views):
            out[views] = points.profile_px2[tracked.point[views]]
    return out


@dataclass(frozen=True, slots=True)
class SampledFrame:
    """One frame of n views; the fields are as in ModelCheckRecording."""

    t_s: float
    seen: Bools  # (n,)
    uv_px: Array  # (n, 2)
    cov_px2: Array  # (n, 2, 2)
    pose: Pose | None
    predicted_px: Array | None = None  # (n, 2)
    predicted_cov_px2: Array | None = None  # (n, 2, 2)
    pose_covariance: Array | None = None  # (6, 6)
    profile_px2: Array | None = None  # (n, 2, 2) second moments; nan where not seen or unknown


@dataclass(slots=True)
class FrameSampler(EvenSampler[SampledFrame]):
    """Of tracked frames, whose arrays are not copied."""

    with_predicted: bool = False  # whether poses are kept that are not measured

    def add_tracked(
        self,
        t_s: float,
        tracked: TrackedFrame,
        predicted_cov_px2: Array | None = None,
        stated_cov_px2: Array | None = None,
        profile_px2: Array | None = None,
    ) -> None:
        """Add the next frame as a tracker or a smoother reports it.

        predicted_cov_px2 (n, 2, 2): stated covariance of the prediction; without it there is no NIS. stated_cov_px2
        (n, 2, 2): see `stated_covariances`; without it the tracker's covariances are used.
        """
        seen = np.array([status.measured for status in tracked.status], dtype=np.bool_)
        if stated_cov_px2 is not None and predicted_cov_px2 is not None:
            # An innovation is normalised by the tracker's full covariance, including its estimated noise scale.
            predicted_cov_px2 = predicted_cov_px2 + tracked.cov_px2 - stated_cov_px2
        cov_px2 = tracked.cov_px2 if stated_cov_px2 is None else stated_cov_px2
        # A predicted pose may be far from the frame's spots without any fault of the rig.
        usable = self.with_predicted or tracked.pose_status is PoseStatus.MEASURED
        pose = tracked.pose if usable else None
        shift = tracked.shift_px
        predicted_px = tracked.predicted_px if shift is None else tracked.predicted_px - shift
        self.add(
            SampledFrame(
                t_s, seen, tracked.uv_at_pose_px, cov_px2, pose, predicted_px, predicted_cov_px2,
                tracked.pose_covariance, profile_px2,
            )
        )  # fmt: skip

    def add_record(self, record: FrameRecord, camera_of: Ints, parameters: TrackerParameters) -> None:
        """Add the next frame of a run, with the covariances that its detections state; arguments as there."""
        tracked, found = record.tracked, record.detections
        stated = stated_covariances(tracked, found, camera_of, parameters)
        profile = profiles(tracked, found, camera_of)
        self.add_tracked(record.t_s, tracked, tracked.predicted_cov_px2, stated, profile)

    def stretch_of_cameras(self, camera_of: Ints) -> dict[int, tuple[float, float]]:
        """By camera, how much longer its spots are along their motion; see `stretch_by_motion`. camera_of (n,)."""
        blocks = [b for b in self.blocks if all(k.profile_px2 is not None for k in b)]
        if not blocks:
            return {}
        uv = np.stack([[np.where(k.seen[:, None], k.uv_px, np.nan) for k in block] for block in blocks])
        middle = [block[BLOCK // 2] for block in blocks]
        profile = np.stack([k.profile_px2 for k in middle if k.profile_px2 is not None])
        variance = np.stack([np.trace(k.cov_px2, axis1=-1, axis2=-2) / 2 for k in middle])
        cameras = ((camera, camera_of == camera) for camera in np.unique(camera_of).tolist())
        return {c: stretch_by_motion(uv[:, :, of], profile[:, of], variance[:, of]) for c, of in cameras}

    def recording(self) -> ModelCheckRecording | None:
        """The sampled frames; None where no frame was added."""
        if not (kept := self.kept):
            return None
        n = len(kept[0].seen)
        no_pose = Pose(np.full((3, 3), np.nan), np.full(3, np.nan))
        poses = [no_pose if k.pose is None else k.pose for k in kept]
        stated = any(k.pose_covariance is not None for k in kept)
        return ModelCheckRecording(
            t_s=np.array([k.t_s for k in kept]),
            seen=np.stack([k.seen for k in kept]),
            uv_px=np.stack([k.uv_px for k in kept]),
            cov_px2=np.stack([k.cov_px2 for k in kept]),
            poses=Pose.stack(poses),
            predicted_px=_stacked([k.predicted_px for k in kept], (n, 2)),
            predicted_cov_px2=_stacked([k.predicted_cov_px2 for k in kept], (n, 2, 2)),
            width_px=_median_widths(kept),
            pose_covariance=_stacked([k.pose_covariance for k in kept], (6, 6)) if stated else None,
        )


def _stacked(values: Sequence[Array | None], shape: tuple[int, ...]) -> Array:
    """(K, *shape), with nan for None."""
    return np.stack([np.full(shape, np.nan) if v is None else v for v in values])


def _median_widths(kept: Sequence[SampledFrame]) -> Array | None:
    """Median over the frames of each view's longest sigma (n,); None where all are unknown."""
    profiles = [k.profile_px2 for k in kept if k.profile_px2 is not None]
    if not profiles:
        return None
    u2, uv, v2 = np.stack(profiles)[..., [0, 0, 1], [0, 1, 1]].transpose(2, 0, 1)
    widths = np.sqrt((u2 + v2) / 2 + np.hypot((u2 - v2) / 2, uv))
    known = np.isfinite(widths).any(axis=0)
    out = np.full(widths.shape[1], np.nan)
    out[known] = np.nanmedian(widths[:, known], axis=0)
    return out
