"""What every frame must pass before it is written: covariances that are covariances, a pose that agrees with its spots.

A frame that fails is not dropped and not written as it is: a pose whose covariance is none is reported as lost, a pose
that contradicts its own spots or the causal pass as predicted, with a covariance that covers the contradiction. Both
are counted, and the verdict says so (lab/runs/verdict/quality.py).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import TypeAlias

import numpy as np

from geometry.arrays import Array, Bools
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import fit_pose
from geometry.rig import Rig
from geometry.uncertainty.rig_parameters import RigCovariance
from geometry.uncertainty.rig_uncertainty import CalibrationSpread
from lab.runs.frames.pipeline import FrameRecord
from lab.runs.verdict.frame_ranges import FrameRanges
from tracking.consistency import (
    SpotAgreement,
    against_causal,
    against_own_spots,
    contradictory,
    finite,
    is_covariance,
)
from tracking.statuses import PoseStatus, SpotStatus
from tracking.tracked_frame import Event, TrackedFrame

Pair: TypeAlias = tuple[FrameRecord, FrameRecord | None]  # a frame, and as the causal pass had it

NOT_A_COVARIANCE, CONTRADICTION = "not_a_covariance", "contradiction"  # kinds of events
_TOGETHER = 64  # frames checked at once: one by one they take 0.8 ms each
_NOWHERE, _UNKNOWN = Pose(np.full((3, 3), np.nan), np.full(3, np.nan)), np.full((6, 6), np.nan)


@dataclass(slots=True)
class FrameChecks:
    """Checks frame after frame; its counts are complete when the last one has passed."""

    rig: Rig
    covariance: RigCovariance | None = None  # of the rig's calibration
    own_spots: FrameRanges = field(default_factory=FrameRanges)  # frames whose pose contradicts its own spots ...
    causal: FrameRanges = field(default_factory=FrameRanges)  # ... or only the causal pass
    invalid: FrameRanges = field(default_factory=FrameRanges)  # frames with a covariance that was none
    _model: SpotModel = field(init=False)
    _spread: CalibrationSpread | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self._model = SpotModel.of(self.rig)
        if self.covariance is not None:
            self._spread = CalibrationSpread(self.rig, self._model, self.covariance)

    def passed(self, records: Iterable[Pair]) -> Iterator[Pair]:
        """Frames as they may be written, each with the same as the causal pass had it (None: only one pass)."""
        waiting = iter(records)
        while block := list(islice(waiting, _TOGETHER)):
            yield from self._checked(block)

    def _checked(self, block: list[Pair]) -> Iterator[Pair]:
        numbers = [record.frame for record, _ in block]
        now, invalid = _with_valid_covariances([record.tracked for record, _ in block])
        own = self._agreement(now)
        measured = np.array([t.pose_status is PoseStatus.MEASURED for t in now])
        then: list[TrackedFrame] | None = None
        if all(before is not None for _, before in block):
            then = [before.tracked for _, before in block if before is not None]
            then, also_invalid = _with_valid_covariances(then)
            own_then, invalid = self._agreement(then), invalid | also_invalid
            bad = contradictory(own, measured, against_causal(*_poses(now), *_poses(then)), own_then)
        else:
            bad = contradictory(own, measured)
        for k in np.flatnonzero(invalid).tolist():
            self.invalid.add(numbers[k])
        for k in np.flatnonzero(bad).tolist():
            now[k] = self._contradicted(
                numbers[k],
                now[k],
                float(own.chi2[k]) if own.contradicts[k] else None,
                int(own.dof[k]),
                then[k] if then is not None else None,
            )
        for k, (record, before) in enumerate(block):
            kept = replace(record, tracked=_with_rms(now[k], own.rms_px[k]))
            if before is None or then is None:
                yield kept, None
            else:
                yield kept, replace(before, tracked=_with_rms(then[k], own_then.rms_px[k]))

    def _agreement(self, frames: list[TrackedFrame]) -> SpotAgreement:
        """The poses against their own spots; frames without a pose have no spots."""
        poses, covariance = _poses(frames)
        used = np.stack([_used(t) for t in frames])
        uv, cov = np.stack([t.uv_px for t in frames]), np.stack([t.cov_px2 for t in frames])
        out = against_own_spots(self._model, poses, covariance, used, uv, cov)
        if self._spread is None or not out.contradicts.any():
            return out
        n = used.shape[1]
        for k in np.flatnonzero(out.contradicts).tolist():
            joint = self._spread.at(poses[k]).reshape(n, 2, n, 2)
            cov[k] += joint[np.arange(n), :, np.arange(n)]
        return against_own_spots(self._model, poses, covariance, used, uv, cov)

    def _contradicted(
        self, frame: int, tracked: TrackedFrame, chi2: float | None, dof: int, then: TrackedFrame | None
    ) -> TrackedFrame:
        """The frame as predicted, with a covariance that covers where its spots and the causal pass put the vehicle.

        Its velocities are left out. This is the last resort: it makes a wrong pose honest, not right.

        chi2, dof: of the pose against its own spots; None where these agree and the causal pose does not.
        """
        assert tracked.pose is not None
        assert tracked.pose_covariance is not None
        P = tracked.pose_covariance
        if chi2 is not None:
            self.own_spots.add(frame)
            words = f"the pose contradicts its own spots (chi-square {chi2:.0f} of {dof} degrees of freedom)"
            rows = np.flatnonzero(_used(tracked))
            fit = fit_pose(self._model, rows, tracked.uv_px[rows], tracked.cov_px2[rows], tracked.pose)
            if fit is not None and fit.observable:
                gap = fit.world_from_body.minus(tracked.pose)
                P = P + np.outer(gap, gap) + fit.covariance
            else:
                P = P * (chi2 / max(dof, 1))
        else:
            self.causal.add(frame)
            words = "the smoothed pose contradicts the causal one beyond their sigmas"
        if then is not None and then.pose is not None and then.pose_covariance is not None:
            # Also where its own spots contradict it: they may be the wrong ones.
            gap = then.pose.minus(tracked.pose)
            P = P + np.outer(gap, gap) + then.pose_covariance
        _, J = self._model.project(tracked.pose)
        wider = J @ (P - tracked.pose_covariance) @ np.swapaxes(J, -1, -2)
        seen = np.array([s.measured for s in tracked.status])
        status = PoseStatus.PREDICTED if tracked.pose_status is PoseStatus.MEASURED else tracked.pose_status
        events = (*tracked.events, Event(CONTRADICTION, f"{words}: reported as predicted, with wider sigmas"))
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
    """Frames without what claims a covariance that is none (the spot's sigmas, the velocities, or the whole pose).

    And which frames (T,) that concerned.
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
        words = f"internal error: the covariance of the {what} is not positive definite; it is left out"
        changed = replace(
            frames[k],
            cov_px2=np.where(bad_spots[k][:, None, None], np.nan, frames[k].cov_px2),
            events=(*frames[k].events, Event(NOT_A_COVARIANCE, words)),
            motion=None if bad_motion[k] else frames[k].motion,
        )
        out[k] = _without_pose(changed) if bad_pose[k] else changed
    return out, invalid


def _poses(frames: list[TrackedFrame]) -> tuple[Pose, Array]:
    """The poses (T,) and their covariances (T, 6, 6); nan without."""
    poses = [_NOWHERE if t.pose is None else t.pose for t in frames]
    covariances = [_UNKNOWN if t.pose_covariance is None else t.pose_covariance for t in frames]
    return Pose(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses])), np.stack(covariances)


def _used(tracked: TrackedFrame) -> Bools:
    """(n,): the spots that the pose was made with."""
    seen = np.array([status.measured for status in tracked.status], dtype=np.bool_)
    return seen if tracked.used_in_pose is None else seen & tracked.used_in_pose


def _without_pose(tracked: TrackedFrame) -> TrackedFrame:
    """The frame with its measured spots, and nothing that needs a pose."""
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
    """With the residual of the reported pose against the spots that made it; only a measured pose has one."""
    return replace(tracked, rms_px=float(rms_px) if tracked.pose_status is PoseStatus.MEASURED else float("nan"))
