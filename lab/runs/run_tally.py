"""Counts of spots and events over a run, for summary.json."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from geometry.pose import Pose
from lab.runs.frames.pipeline import FrameRecord
from tracking.statuses import Event, PoseStatus

MOST_EVENTS = 500  # listed one by one; of the others the number is reported
# Events that may continue in the next frame: listed once, with their last frame.
LASTING = ("undecided", "changed", "contradiction", "not_a_covariance")


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
class RunTally:
    """Counts of spots and events. Memory does not grow with the number of frames."""

    cameras: tuple[str, ...]
    views: tuple[str, ...]  # `camera/spot`
    spot_status: list[Counter[str]] = field(default_factory=list)  # by view
    detections: Counter[str] = field(default_factory=Counter)  # by camera
    missing_reasons: dict[str, Counter[str]] = field(default_factory=dict)  # by camera: why there is no picture
    events: list[ListedEvent] = field(default_factory=list)
    event_kinds: Counter[str] = field(default_factory=Counter)
    unlisted: int = 0  # events beyond MOST_EVENTS
    labels_left_open: int = 0  # rows of spots.csv with a detection whose label is too uncertain
    frames: int = 0
    first_pose: Pose | None = None  # of the first frame, if it is measured
    _lasting: dict[tuple[str, int | None], ListedEvent] = field(default_factory=dict)  # the latest, by kind and view

    def add(self, record: FrameRecord) -> None:
        """Count the next frame."""
        if self.frames == 0 and record.tracked.pose_status is PoseStatus.MEASURED:
            self.first_pose = record.tracked.pose
        self.frames += 1
        if not self.spot_status:
            self.spot_status = [Counter() for _ in self.views]
        for counter, status in zip(self.spot_status, record.tracked.status, strict=True):
            counter[status.value] += 1
        for camera, found, reason in zip(self.cameras, record.detections, record.missing, strict=True):
            if found is None:
                self.missing_reasons.setdefault(camera, Counter())[reason] += 1
            else:
                self.detections[camera] += len(found)
        if record.tracked.label_probability is not None:
            measured = np.array([s.measured for s in record.tracked.status])
            open_labels = ~measured & ~np.isnan(record.tracked.label_probability)
            self.labels_left_open += int(np.count_nonzero(open_labels))
        for event in record.tracked.events:
            self._add_event(record.frame, event)

    def _add_event(self, frame: int, event: Event) -> None:
        self.event_kinds[event.kind] += 1
        same = self._lasting.get((event.kind, event.view))
        if event.kind in LASTING and same is not None and same.last_frame == frame - 1:
            same.last_frame = frame
        elif len(self.events) < MOST_EVENTS:
            camera, spot = ("", "") if event.view is None else self.views[event.view].split("/", 1)
            self.events.append(ListedEvent(frame, frame, event.kind, camera or None, spot or None, event.text))
            self._lasting[event.kind, event.view] = self.events[-1]
        else:
            self.unlisted += 1
