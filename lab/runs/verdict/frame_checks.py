"""Checks of every frame before it is written: valid covariances, and a pose that agrees with its spots.

A frame that fails is neither dropped nor written unchanged: a pose with an invalid covariance is reported as lost; a
pose that contradicts its own spots or the causal pass is reported as predicted, with a covariance that covers the
difference. Both are counted and appear in the verdict (lab/runs/verdict/quality.py).

Frame numbers stored as ranges: memory grows with the number of gaps, not with the length of the run.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np

from geometry.arrays import Array, Bools, finite
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import fit_pose
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance, RigUncertainty
from lab.runs.frames.pipeline import Pair
from tracking.consistency import (
    SpotAgreement,
    against_causal,
    against_own_spots,
    contradictory,
    is_covariance,
)
from tracking.statuses import Event, PoseStatus, SpotStatus, TrackedFrame


@dataclass(slots=True)
class FrameRanges:
    """Increasing frame numbers as ranges, first and last included."""

    ranges: list[list[int]] = field(default_factory=list)

    def add(self, frame: int) -> None:
        """Add the next frame number, which must be larger than all before."""
        if self.ranges and self.ranges[-1][1] == frame - 1:
            self.ranges[-1][1] = frame
        else:
            self.ranges.append([frame, frame])

    def __len__(self) -> int:
        """Number of frames."""
        return sum(last - first + 1 for first, last in self.ranges)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """The ranges."""
        return iter((first, last) for first, last in self.ranges)

    def as_text(self, most: int = 3) -> str:
        """`12 to 30, 41`; with more than `most` ranges, the first ones and the number of the others."""
        named = [str(a) if a == b else f"{a} to {b}" for a, b in self.ranges[:most]]
        more = len(self.ranges) - most
        return ", ".join(named) + (f" and {more} more range{'s' if more > 1 else ''}" if more > 0 else "")


NOT_A_COVARIANCE, CONTRADICTION = "not_a_covariance", "contradiction"  # kinds of events
_BLOCK = 64  # frames checked at once: one by one they take 0.8 ms each
_NO_POSE, _UNKNOWN = Pose(np.full((3, 3), np.nan), np.full(3, np.nan)), np.full((6, 6), np.nan)


@dataclass(slots=True)
class FrameChecks:
    """Checks frame by frame; the counts are complete after the last one."""

    rig: Rig
    covariance: RigCovariance | None = None  # of the rig's calibration
    own_spots: FrameRanges = field(default_factory=FrameRanges)  # frames whose pose contradicts its own spots
    causal: FrameRanges = field(default_factory=FrameRanges)  # frames whose pose contradicts only the causal pass
    invalid: FrameRanges = field(default_factory=FrameRanges)  # frames with an invalid covariance
    _model: SpotModel = field(init=False)
    _spread: RigUncertainty | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self._model = SpotModel.of(self.rig)
        if self.covariance is not None:
            self._spread = RigUncertainty(self.rig, self._model, self.covariance)

    def passed(self, records: Iterable[Pair]) -> Iterator[Pair]:
        """The frames as they may be written, each with the same in the causal pass (None: only one pass)."""
        waiting = iter(records)
        while block := list(islice(waiting, _BLOCK)):
            yield from self._checked(block)

    def _checked(self, block: list[Pair]) -> Iterator[Pair]:
        numbers = [record.frame for record, _ in block]
        frames, invalid = _with_valid_covariances([record.tracked for record, _ in block])
        own = self._agreement(frames)
        measured = np.array([t.pose_status is PoseStatus.MEASURED for t in frames])
        causal: list[TrackedFrame] | None = None
        if all(before is not None for _, before in block):
            causal = [before.tracked for _, before in block if before is not None]
            causal, also_invalid = _with_valid_covariances(causal)
            own_causal, invalid = self._agreement(causal), invalid | also_invalid
            bad = contradictory(own, measured, against_causal(*_poses(frames), *_poses(causal)), own_causal)
        else:
            bad = contradictory(own, measured)
        for k in np.flatnonzero(invalid).tolist():
            self.invalid.add(numbers[k])
        for k in np.flatnonzero(bad).tolist():
            frames[k] = self._contradicted(
                numbers[k],
                frames[k],
                float(own.chi2[k]) if own.contradicts[k] else None,
                int(own.dof[k]),
                causal[k] if causal is not None else None,
            )
        for k, (record, before) in enumerate(block):
            checked = replace(record, tracked=_with_rms(frames[k], own.rms_px[k]))
            if before is None or causal is None:
                yield checked, None
            else:
                yield checked, replace(before, tracked=_with_rms(causal[k], own_causal.rms_px[k]))

    def _agreement(self, frames: list[TrackedFrame]) -> SpotAgreement:
        """Agreement of the poses with their own spots; frames without a pose have no spots."""
        poses, covariance = _poses(frames)
        used = np.stack([_used(t) for t in frames])
        uv, cov = np.stack([t.uv_at_pose_px for t in frames]), np.stack([t.cov_px2 for t in frames])
        out = against_own_spots(self._model, poses, covariance, used, uv, cov)
        if self._spread is None or not out.contradicts.any():
            return out
        n = used.shape[1]
        for k in np.flatnonzero(out.contradicts).tolist():
            joint = self._spread.at(poses[k]).reshape(n, 2, n, 2)
            cov[k] += joint[np.arange(n), :, np.arange(n)]
        return against_own_spots(self._model, poses, covariance, used, uv, cov)

    def _contradicted(
        self, frame: int, tracked: TrackedFrame, chi2: float | None, dof: int, causal: TrackedFrame | None
    ) -> TrackedFrame:
        """The frame as predicted, with a covariance that covers the poses by its spots and by the causal pass.

        Its velocities are omitted. This is a last resort: the pose stays wrong, but its covariance covers the error.

        chi2, dof: of the pose against its own spots; chi2 is None where these agree and the causal pose does not.
        """
        assert tracked.pose is not None
        assert tracked.pose_covariance is not None
        P = tracked.pose_covariance
        if chi2 is not None:
            self.own_spots.add(frame)
            text = f"the pose contradicts its own spots (chi-square {chi2:.0f} of {dof} degrees of freedom)"
            rows = np.flatnonzero(_used(tracked))
            fit = fit_pose(self._model, rows, tracked.uv_at_pose_px[rows], tracked.cov_px2[rows], tracked.pose)
            if fit is not None and fit.observable:
                gap = fit.world_from_body.minus(tracked.pose)
                P = P + np.outer(gap, gap) + fit.covariance
            else:
                P = P * (chi2 / max(dof, 1))
        else:
            self.causal.add(frame)
            text = "the smoothed pose contradicts the causal one beyond their sigmas"
        if causal is not None and causal.pose is not None and causal.pose_covariance is not None:
            # Also where its own spots contradict it: these may be wrongly labelled.
            gap = causal.pose.minus(tracked.pose)
            P = P + np.outer(gap, gap) + causal.pose_covariance
        _, J = self._model.project(tracked.pose)
        wider = J @ (P - tracked.pose_covariance) @ np.swapaxes(J, -1, -2)
        seen = np.array([s.measured for s in tracked.status])
        status = PoseStatus.PREDICTED if tracked.pose_status is PoseStatus.MEASURED else tracked.pose_status
        events = (*tracked.events, Event(CONTRADICTION, f"{text}: reported as predicted, with wider sigmas"))
        return replace(
            tracked,
            cov_px2=np.where(seen[:, None, None], tracked.cov_px2, tracked.cov_px2 + wider),
            pose_covariance=P,
            pose_status=status,
            spots_used=0,
            motion=None,
            events=events,
        )


def _with_valid_covariances(frames: list[TrackedFrame]) -> tuple[list[TrackedFrame], Bools]:
    """The frames without values whose covariance is invalid (spot sigmas, velocities, or the whole pose).

    Also returns which frames (T,) were changed.
    """
    spots = np.stack([t.cov_px2 for t in frames])
    bad_spots = ~np.isnan(spots[..., 0, 0]) & ~is_covariance(spots)
    has_pose = np.array([t.pose is not None for t in frames])
    poses, covariances = _poses(frames)
    good = is_covariance(covariances) & finite(poses.translation, -1) & finite(poses.rotation, (-2, -1))
    bad_pose = has_pose & ~good
    has_motion = np.array([t.motion is not None for t in frames])
    motions = np.stack([_UNKNOWN if t.motion is None else t.motion.covariance for t in frames])
    bad_motion = has_motion & ~is_covariance(motions)
    invalid = bad_spots.any(axis=1) | bad_pose | bad_motion
    out = list(frames)
    for k in np.flatnonzero(invalid).tolist():
        what = "pose" if bad_pose[k] else "velocity" if bad_motion[k] else "spot"
        text = f"internal error: the covariance of the {what} is not positive definite; it is omitted"
        changed = replace(
            frames[k],
            cov_px2=np.where(bad_spots[k][:, None, None], np.nan, frames[k].cov_px2),
            events=(*frames[k].events, Event(NOT_A_COVARIANCE, text)),
            motion=None if bad_motion[k] else frames[k].motion,
        )
        out[k] = _without_pose(changed) if bad_pose[k] else changed
    return out, invalid


def _poses(frames: list[TrackedFrame]) -> tuple[Pose, Array]:
    """The poses (T,) and their covariances (T, 6, 6); nan without a pose."""
    poses = [_NO_POSE if t.pose is None else t.pose for t in frames]
    covariances = [_UNKNOWN if t.pose_covariance is None else t.pose_covariance for t in frames]
    return Pose.stack(poses), np.stack(covariances)


def _used(tracked: TrackedFrame) -> Bools:
    """(n,): the spots that the pose was computed from."""
    seen = np.array([status.measured for status in tracked.status], dtype=np.bool_)
    return seen if tracked.used_in_pose is None else seen & tracked.used_in_pose


def _without_pose(tracked: TrackedFrame) -> TrackedFrame:
    """The frame with its measured spots only."""
    seen = np.array([status.measured for status in tracked.status])
    return replace(
        tracked,
        uv_px=np.where(seen[:, None], tracked.uv_px, np.nan),
        cov_px2=np.where(seen[:, None, None], tracked.cov_px2, np.nan),
        status=tuple(s if s.measured else SpotStatus.LOST for s in tracked.status),
        pose_status=PoseStatus.LOST,
        pose=None,
        pose_covariance=None,
        pose_systematic=None,
        motion=None,
        spots_used=0,
        rms_px=float("nan"),
    )


def _with_rms(tracked: TrackedFrame, rms_px: float) -> TrackedFrame:
    """The frame with the RMS residual of the reported pose; only a measured pose has one."""
    return replace(tracked, rms_px=float(rms_px) if tracked.pose_status is PoseStatus.MEASURED else float("nan"))
