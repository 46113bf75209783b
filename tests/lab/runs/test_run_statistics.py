"""Frames without a measured pose are counted under the cause that the pictures show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geometry.pose import Pose
from lab.runs.frames.pipeline import FrameRecord
from lab.runs.verdict.frame_checks import CONTRADICTION
from lab.runs.verdict.frame_ranges import FrameRanges
from lab.runs.verdict.run_statistics import CameraStatistics, Cause, RunStatistics
from tracking.detections import Detections
from tracking.statuses import PoseStatus, SpotStatus
from tracking.tracked_frame import Event, TrackedFrame

N = 6  # views: three in each of two cameras
SEEN, HIDDEN, OUT = SpotStatus.MATCHED, SpotStatus.OCCLUDED, SpotStatus.OUT_OF_VIEW


def points(count: int) -> Detections:
    return Detections.at(np.zeros((count, 2)), np.tile(np.eye(2), (count, 1, 1)))


def a_record(
    frame: int,
    pose: PoseStatus = PoseStatus.MEASURED,
    status: tuple[SpotStatus, ...] = (SEEN,) * N,
    left: int | None = 3,
    right: int | None = 3,
    probability: np.ndarray | None = None,
    events: tuple[Event, ...] = (),
) -> FrameRecord:
    """left, right: points in the cameras' pictures; None: no picture."""
    known = pose is not PoseStatus.LOST
    tracked = TrackedFrame(
        np.zeros((N, 2)), np.tile(np.eye(2), (N, 1, 1)), status, np.zeros((N, 2)), np.full(N, np.nan),
        np.where([s.measured for s in status], 0, -1), pose, Pose.identity() if known else None,
        np.eye(6) if known else None, 0, 0.1, events, probability,
    )  # fmt: skip
    found = tuple(None if c is None else points(c) for c in (left, right))
    return FrameRecord(frame, 0.01 * frame, 0.01, found, ("", ""), tracked)


def facts_of(*records: FrameRecord, causal: list[FrameRecord] | None = None) -> RunStatistics:
    facts = RunStatistics({"left": CameraStatistics(), "right": CameraStatistics()}, (0, 0, 0, 1, 1, 1))
    for k, record in enumerate(records):
        facts.add(record, None if causal is None else causal[k])
    return facts


PREDICTED, LOST = PoseStatus.PREDICTED, PoseStatus.LOST
OPEN = np.array([np.nan, np.nan, 0.6, 0.6, 0.6, 0.6])


@pytest.mark.parametrize(
    ("record", "cause"),
    [
        (a_record(1, PREDICTED, (SEEN,) * 3 + (SpotStatus.NO_IMAGE,) * 3, right=None), Cause.NO_PICTURE),
        (a_record(1, PREDICTED, events=(Event(CONTRADICTION, ""),)), Cause.CONTRADICTION),
        (a_record(1, PREDICTED, (SEEN, SEEN, *(HIDDEN,) * 4), probability=OPEN), Cause.LABELS_OPEN),
        (a_record(1, PREDICTED, (SEEN, HIDDEN, *(OUT,) * 4), left=1, right=0), Cause.OUT_OF_VIEW),
        (a_record(1, PREDICTED, (SEEN, SEEN, SEEN, *(OUT,) * 3), left=3, right=0), Cause.NOT_DETERMINED),
        (a_record(1, PREDICTED, (HIDDEN,) * N, left=0, right=0), Cause.HIDDEN),
        (a_record(1, LOST, (SpotStatus.LOST,) * N, left=1, right=2), Cause.FEW_POINTS),
        (a_record(1, LOST, (SpotStatus.LOST,) * N), Cause.UNEXPLAINED),
        # The pose has gone elsewhere, and six points stand where it does not expect any.
        (a_record(1, PREDICTED, (HIDDEN,) * N), Cause.UNEXPLAINED),
        (a_record(1, PREDICTED, (OUT,) * N), Cause.UNEXPLAINED),
    ],
)
def test_each_frame_without_a_measured_pose_has_its_cause(record, cause):
    facts = facts_of(a_record(0), record)
    assert facts.causes == {cause: 1}
    assert facts.missed == (cause in (Cause.CONTRADICTION, Cause.LABELS_OPEN, Cause.UNEXPLAINED))


def test_the_usual_clutter_is_no_evidence_of_spots():
    """Six reflections in every picture: an occluded frame with these shows no spots; one with six points more does."""
    measured = [a_record(k, left=9) for k in range(20)]
    dark = a_record(20, PREDICTED, (HIDDEN,) * N, left=6, right=0)
    assert facts_of(*measured, dark).causes == {Cause.HIDDEN: 1}
    assert facts_of(*measured, replace(dark, detections=(points(9), points(3)))).causes == {Cause.UNEXPLAINED: 1}


def test_cameras_are_counted_by_what_they_show_and_should_show():
    facts = facts_of(
        a_record(0),
        a_record(1, PREDICTED, (SEEN,) * 3 + (HIDDEN,) * 3, right=0),
        a_record(2, PREDICTED, (SEEN,) * 3 + (HIDDEN, OUT, OUT), right=0),
        a_record(3, PREDICTED, (SEEN,) * 3 + (SpotStatus.NO_IMAGE,) * 3, right=None),
    )
    right = facts.cameras["right"]
    assert (right.pictures, right.empty, right.points) == (3, 2, 3)
    assert (right.expected, right.found) == (7, 3)
    assert (right.empty_at_end, right.expected_at_end) == (2, 4)
    assert right.missing.ranges == [[3, 3]]
    assert right.as_mapping()["missing"] == [[3, 3]]
    assert facts.cameras["left"].as_mapping()["empty_at_end"] == 0


def test_lost_and_found_again_is_counted_on_what_is_reported_and_not_on_searches():
    searched = Event("reacquired", "found from the prior alone")
    lost = (SpotStatus.LOST,) * N
    records = [
        a_record(0, LOST, lost),  # before it was ever found
        a_record(1),
        a_record(2, events=(searched,)),  # the causal pass lost it here; what is reported knows it throughout
        a_record(3, LOST, lost),
        a_record(4, LOST, lost),
        a_record(5),
        a_record(6, LOST, lost),
    ]
    facts = facts_of(*records, causal=[a_record(k, LOST, lost) for k in range(7)])
    assert facts.lost.ranges == [[3, 4], [6, 6]]
    assert facts.found_again == 1
    assert (facts.measured, facts.causal_measured) == (3, 0)
    assert facts_of(*records).causal_measured is None


def test_a_tie_that_the_smoothing_pass_has_decided_is_none():
    tie = Event("tie", "spots 1, 2 or 2, 3")
    assert len(facts_of(a_record(0, events=(tie,))).ties) == 0
    open_still = facts_of(a_record(0), a_record(1, LOST, (SpotStatus.LOST,) * N, events=(tie,)))
    assert open_still.ties.ranges == [[1, 1]]
    assert open_still.tie_text == "spots 1, 2 or 2, 3"


def test_ranges_of_frames_count_and_read_well():
    ranges = FrameRanges()
    for frame in (3, 4, 5, 9, 11, 12, 20, 30):
        ranges.add(frame)
    assert len(ranges) == 8
    assert ranges.ranges == [[3, 5], [9, 9], [11, 12], [20, 20], [30, 30]]
    assert ranges.as_text() == "3 to 5, 9, 11 to 12 and 2 more ranges"
    assert ranges.as_text(4) == "3 to 5, 9, 11 to 12, 20 and 1 more range"
    assert ranges.as_text(9) == "3 to 5, 9, 11 to 12, 20, 30"
