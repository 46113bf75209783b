"""Statistics of a run, counted frame by frame, for verdict and summary. Memory does not grow with the run's length."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from geometry.pose import Pose
from lab.runs.frames.pipeline import FrameRecord
from lab.runs.verdict.frame_checks import CONTRADICTION, FrameRanges
from tracking.detections import UNMATCHED
from tracking.statuses import Event, PoseStatus, SpotStatus, TrackedFrame, Word

FEWEST_SPOTS = 3  # a pose needs this many
MOST_EVENTS = 500  # listed one by one; of the others the number is reported
# Events that may continue in the next frame: listed once, with their last frame.
LASTING = ("undecided", "changed", CONTRADICTION, "not_a_covariance")
_USUAL_CLUTTER = 0.95  # quantile, over the measured frames, of the unlabelled points that count as usual clutter
_MOST_POINTS = 50  # larger numbers of unlabelled points are counted as this number


class FrameCause(Word):
    """Why a frame has no measured pose: the first that applies. Meaning: text that follows a number of such frames."""

    NO_PICTURE = "no_picture", "without a picture of some camera"
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
    empty_at_end: int = 0  # pictures since the last one that has a point of light
    expected_at_end: int = 0  # spots that the pose puts inside those
    missing: FrameRanges = field(default_factory=FrameRanges)  # frames without a usable picture
    missing_reasons: Counter[str] = field(default_factory=Counter)
    # Measured frames in which this camera's spots have labels and none of them fits the pose of the other cameras.
    displaced: FrameRanges = field(default_factory=FrameRanges)

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
            "displaced": [list(r) for r in self.displaced.ranges],
        }


@dataclass(slots=True)
class ListedEvent:
    """An event as summary.json lists it; one that continues in the next frames has a later last frame."""

    frame: int
    last_frame: int
    kind: str
    camera: str | None
    spot: str | None
    text: str


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
    own_spots: FrameRanges = field(default_factory=FrameRanges)  # see lab.runs.verdict.frame_checks.FrameChecks
    causal: FrameRanges = field(default_factory=FrameRanges)
    invalid: FrameRanges = field(default_factory=FrameRanges)
    spot_status: dict[tuple[str, str], Counter[str]] = field(default_factory=dict)  # by view: SpotStatus -> frames
    labels_left_open: int = 0  # rows of spots.csv with a detection whose label is too uncertain
    events: Events = field(default_factory=Events)
    first_pose: Pose | None = None  # the first that is measured
    first_measured: int = -1  # its frame
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
        status, used = record.tracked.status, record.tracked.used_in_pose
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
            if len(found):
                camera.empty_at_end = camera.expected_at_end = 0
            else:
                camera.empty_at_end += 1
            if record.tracked.pose is not None:
                own = [status[v] for v in views]
                camera.found += sum(s.measured for s in own)
                expected = sum(s.measured or s is SpotStatus.OCCLUDED for s in own)
                camera.expected += expected
                camera.unlabelled += 2 <= expected <= len(found) and not any(s.measured for s in own)
                camera.expected_at_end += expected if camera.empty_at_end else 0
                labelled = [v for v in views if status[v].measured]
                measured = record.tracked.pose_status is PoseStatus.MEASURED
                if labelled and measured and used is not None and not used[labelled].any():
                    camera.displaced.add(record.frame)

    def _cause(self, record: FrameRecord) -> FrameCause:
        tracked = record.tracked
        if any(found is None for found in record.detections):
            return FrameCause.NO_PICTURE
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
            if below >= _USUAL_CLUTTER * total:
                break
        out: Counter[FrameCause] = Counter()
        for (cause, surplus), frames in self._causes.items():
            shows_more = cause not in (FrameCause.NO_PICTURE, *MISSED) and surplus >= usual + self.min_spots
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
