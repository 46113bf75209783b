"""Checks of every frame before it is written, and statistics of a run, counted frame by frame, for verdict and summary.

A frame has valid covariances and a pose that agrees with its spots. Memory grows by 24 bytes per frame and camera.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np

from geometry.arrays import Array, Bools, finite
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import fit_pose
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance, RigUncertainty
from lab.files.run.results import ListedEvent
from lab.number_format import format_count
from lab.runs.frames.pipeline import LEFT_OUT, FrameRecord, Pair
from lab.runs.verdict.moved_camera import MovedCamera, ShownSpots
from tracking.consistency import SpotAgreement, against_causal, against_own_spots, contradictory, is_covariance
from tracking.detections import UNMATCHED
from tracking.smoothing.labels.neighbouring_frames import USUAL_POINTS
from tracking.statuses import Event, PoseStatus, SpotStatus, TrackedFrame, Word


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
        return ", ".join(named) + (f" and {format_count(more, 'more range')}" if more > 0 else "")


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


FEWEST_SPOTS = 3  # a pose needs this many
MOST_EVENTS = 500  # listed one by one; of the others the number is reported
# Events that may continue in the next frame: listed once, with their last frame.
LASTING = ("undecided", "changed", CONTRADICTION, "not_a_covariance")
_MOST_POINTS = 50  # larger numbers of unlabelled points are counted as this number


class FrameCause(Word):
    """Why a frame has no measured pose: the first that applies. Meaning: text that follows a number of such frames."""

    NO_PICTURE = "no_picture", "without a picture of some camera"
    LEFT_OUT = "left_out", "without the pictures of a camera that has moved"
    CONTRADICTION = "contradiction", "whose pose contradicts its spots or the causal pass"
    UNEXPLAINED = "unexplained", "with enough points of light, which no pose explains"
    LABELS_OPEN = "labels_open", "with spots whose labels are uncertain"
    FEW_POINTS = "few_points", "with too few points of light"
    OUT_OF_VIEW = "out_of_view", f"with fewer than {FEWEST_SPOTS} spots inside the pictures"
    NOT_DETERMINED = "not_determined", "whose spots do not determine the pose"
    HIDDEN = "hidden", "with hidden spots"


# Frames with enough visible spots: the tracker, not the recording, is the reason.
MISSED = (FrameCause.CONTRADICTION, FrameCause.UNEXPLAINED, FrameCause.LABELS_OPEN)


@dataclass(slots=True)
class CameraStatistics:
    """Counts of one camera."""

    pictures: int = 0  # frames with a usable picture
    empty: int = 0  # usable pictures without any point of light
    points: int = 0  # points of light in all pictures
    expected: int = 0  # spots that the pose puts inside the pictures
    found: int = 0  # expected spots that were measured
    unlabelled: int = 0  # pictures with points enough for two or more expected spots, none of which was measured
    empty_at_start: int = 0  # pictures before the first one that has a point of light
    expected_at_start: int = 0  # spots that the pose puts inside those
    empty_at_end: int = 0  # pictures since the last one that has a point of light
    expected_at_end: int = 0  # spots that the pose puts inside those
    missing: FrameRanges = field(default_factory=FrameRanges)  # frames without a usable picture
    missing_reasons: Counter[str] = field(default_factory=Counter)
    spots: ShownSpots = field(default_factory=ShownSpots)

    @property
    def moved(self) -> FrameRanges:
        """Frames in which spots of this camera are shown, and not where the pose puts them."""
        astray = FrameRanges()
        for frame in self.spots.frames_astray().tolist():
            astray.add(frame)
        return astray

    def as_mapping(self) -> dict[str, Any]:
        """For summary.json."""
        return {
            "pictures": self.pictures,
            "pictures_without_points": self.empty,
            "points": self.points,
            "spots_expected": self.expected,
            "spots_found": self.found,
            "empty_at_end": self.empty_at_end,
            "missing": [list(r) for r in self.missing.ranges],
            "displaced": [list(r) for r in self.moved.ranges],
        }


@dataclass(slots=True)
class Events:
    """The events of a run: the first ones listed, and the number of each kind."""

    listed: list[ListedEvent] = field(default_factory=list)
    kinds: Counter[str] = field(default_factory=Counter)
    unlisted: int = 0  # events beyond MOST_EVENTS
    _lasting: dict[tuple[str, int | None], ListedEvent] = field(default_factory=dict)  # the latest, by kind and view

    def add(self, frame: int, event: Event, views: Sequence[tuple[str, str]]) -> None:
        """Add an event of the next frame."""
        self.kinds[event.kind] += 1
        same = self._lasting.get((event.kind, event.view))
        if event.kind in LASTING and same is not None and same.last_frame == frame - 1:
            same.last_frame = frame
        elif len(self.listed) < MOST_EVENTS:
            camera, spot = (None, None) if event.view is None else views[event.view]
            self.listed.append(ListedEvent(frame, frame, event.kind, camera, spot, event.text))
            self._lasting[event.kind, event.view] = self.listed[-1]
        else:
            self.unlisted += 1


@dataclass(slots=True)
class RunStatistics:
    """Counts of one run. Frames are added in order, as they are written."""

    cameras: dict[str, CameraStatistics]
    views: tuple[tuple[str, str], ...] = ()  # camera and spot
    min_spots: int = 4  # points that a first pose needs
    frames: int = 0
    first_frame: int = 0
    last_frame: int = -1
    pose: Counter[str] = field(default_factory=Counter)  # PoseStatus -> frames
    causal_measured: int | None = None  # frames measured in the causal pass, where the frames are smoothed
    lost: FrameRanges = field(default_factory=FrameRanges)  # frames after the first pose in which the vehicle is lost
    found_again: int = 0  # number of such ranges that are followed by a pose
    ties: FrameRanges = field(default_factory=FrameRanges)  # frames with a tie and without a measured pose
    tie_text: str = ""  # of the first of them
    own_spots: FrameRanges = field(default_factory=FrameRanges)  # see lab.runs.verdict.run_statistics.FrameChecks
    causal: FrameRanges = field(default_factory=FrameRanges)
    invalid: FrameRanges = field(default_factory=FrameRanges)
    spot_status: dict[tuple[str, str], Counter[str]] = field(default_factory=dict)  # by view: SpotStatus -> frames
    labels_left_open: int = 0  # rows of spots.csv with a detection whose label is too uncertain
    events: Events = field(default_factory=Events)
    first_pose: Pose | None = None  # the first that is measured
    first_measured: int = -1  # its frame
    moved: MovedCamera | None = None  # a movement during the run
    _found: bool = False  # whether a pose has been found
    _causes: Counter[tuple[FrameCause, int]] = field(default_factory=Counter)  # with the number of unlabelled points
    _surplus: Counter[int] = field(default_factory=Counter)  # unlabelled points of measured frames

    @property
    def measured(self) -> int:
        """Frames with a measured pose."""
        return self.pose[PoseStatus.MEASURED.value]

    def add(self, record: FrameRecord, causal: FrameRecord | None = None) -> None:
        """Add the next frame, as it is written and as it is in the causal pass."""
        tracked = record.tracked
        if self.frames == 0:
            self.first_frame = record.frame
        if self.first_pose is None and tracked.pose_status is PoseStatus.MEASURED:
            self.first_pose, self.first_measured = tracked.pose, record.frame
        self.last_frame = record.frame
        self.frames += 1
        self.pose[tracked.pose_status.value] += 1
        if causal is not None:
            measured = causal.tracked.pose_status is PoseStatus.MEASURED
            self.causal_measured = (self.causal_measured or 0) + measured
        for view, status in zip(self.views, tracked.status, strict=True):
            self.spot_status.setdefault(view, Counter())[status.value] += 1
        self.labels_left_open += _labels_left_open(tracked)
        for event in tracked.events:
            self.events.add(record.frame, event, self.views)
        self._add_cameras(record)
        if tracked.pose_status is PoseStatus.LOST:
            if self._found:
                self.lost.add(record.frame)
        else:
            if self.lost.ranges and self.lost.ranges[-1][1] == record.frame - 1:
                self.found_again += 1
            self._found = True
        points = sum(len(f) for f in record.detections if f is not None)
        surplus = min(points - int(np.count_nonzero(tracked.point != UNMATCHED)), _MOST_POINTS)
        if tracked.pose_status is PoseStatus.MEASURED:
            self._surplus[surplus] += 1
            return
        self._causes[self._cause(record), surplus] += 1
        for event in tracked.events:
            if event.kind == "tie":
                self.ties.add(record.frame)
                self.tie_text = self.tie_text or event.text

    def _add_cameras(self, record: FrameRecord) -> None:
        status = record.tracked.status
        pictures = zip(self.cameras.items(), record.detections, record.missing, strict=True)
        for (name, camera), found, reason in pictures:
            if found is None:
                camera.missing.add(record.frame)
                camera.missing_reasons[reason] += 1
                continue
            views = [v for v, (of, _) in enumerate(self.views) if of == name]
            camera.pictures += 1
            camera.empty += len(found) == 0
            camera.points += len(found)
            camera.empty_at_start += camera.points == 0
            if len(found):
                camera.empty_at_end = camera.expected_at_end = 0
            else:
                camera.empty_at_end += 1
            if record.tracked.pose is not None:
                # Where no camera shows a spot, the pose is a prediction alone, and points elsewhere say nothing.
                if any(s.measured for s in status):
                    camera.spots.add(record.frame, record.tracked, views, found)
                own = [status[v] for v in views]
                camera.found += sum(s.measured for s in own)
                expected = sum(s.measured or s is SpotStatus.OCCLUDED for s in own)
                camera.expected += expected
                camera.unlabelled += 2 <= expected <= len(found) and not any(s.measured for s in own)
                camera.expected_at_start += expected if camera.points == 0 else 0
                camera.expected_at_end += expected if camera.empty_at_end else 0

    def _cause(self, record: FrameRecord) -> FrameCause:
        tracked = record.tracked
        if any(found is None for found in record.detections):
            return FrameCause.LEFT_OUT if LEFT_OUT in record.missing else FrameCause.NO_PICTURE
        if any(event.kind == CONTRADICTION for event in tracked.events):
            return FrameCause.CONTRADICTION
        given = np.array([s.measured for s in tracked.status])
        left_open = _labels_left_open(tracked)
        if left_open and given.sum() + left_open >= FEWEST_SPOTS:
            return FrameCause.LABELS_OPEN
        if tracked.pose is None:
            return FrameCause.FEW_POINTS
        if sum(s.measured or s is SpotStatus.OCCLUDED for s in tracked.status) < FEWEST_SPOTS:
            return FrameCause.OUT_OF_VIEW
        return FrameCause.NOT_DETERMINED if given.sum() >= FEWEST_SPOTS else FrameCause.HIDDEN

    @property
    def causes(self) -> Mapping[FrameCause, int]:
        """Number of frames without a measured pose by cause, the most frequent first.

        A frame whose unlabelled points exceed the usual clutter of measured frames by as many as a first pose needs
        shows spots that no pose explains, whatever its other cause.
        """
        total, usual = sum(self._surplus.values()), 0
        below = 0
        for surplus in sorted(self._surplus):
            below += self._surplus[surplus]
            usual = surplus
            if below >= USUAL_POINTS * total:
                break
        out: Counter[FrameCause] = Counter()
        for (cause, surplus), frames in self._causes.items():
            given = cause in (FrameCause.NO_PICTURE, FrameCause.LEFT_OUT, *MISSED)
            shows_more = not given and surplus >= usual + self.min_spots
            out[FrameCause.UNEXPLAINED if shows_more else cause] += frames
        return dict(out.most_common())

    @property
    def missed(self) -> int:
        """Number of frames with enough visible spots but without a measured pose."""
        causes = self.causes
        return sum(causes.get(cause, 0) for cause in MISSED)


def _labels_left_open(tracked: TrackedFrame) -> int:
    """Spots with a detection whose label is too uncertain."""
    if tracked.label_probability is None:
        return 0
    measured = np.array([s.measured for s in tracked.status])
    return int(np.count_nonzero(~measured & np.isfinite(tracked.label_probability)))
