"""Frames without a measured pose are counted by the cause that the pictures show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geometry.pose import Pose
from lab.runs.frames.pipeline import FrameRecord
from lab.runs.verdict.run_statistics import CONTRADICTION, CameraStatistics, FrameCause, FrameRanges, RunStatistics
from tracking.detections import Detections
from tracking.statuses import Event, PoseStatus, SpotStatus, TrackedFrame

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
    """left, right: number of points in the cameras' pictures; None: no picture."""
    known = pose is not PoseStatus.LOST
    tracked = TrackedFrame(
        np.zeros((N, 2)), np.tile(np.eye(2), (N, 1, 1)), status, np.zeros((N, 2)), np.full(N, np.nan),
        np.where([s.measured for s in status], 0, -1), pose, Pose.identity() if known else None,
        np.eye(6) if known else None, 0, 0.1, events, probability,
    )  # fmt: skip
    found = tuple(None if c is None else points(c) for c in (left, right))
    return FrameRecord(frame, 0.01 * frame, 0.01, found, ("", ""), tracked)


VIEWS = tuple((camera, spot) for camera in ("left", "right") for spot in "123")


def statistics_of(*records: FrameRecord, causal: list[FrameRecord] | None = None) -> RunStatistics:
    statistics = RunStatistics({"left": CameraStatistics(), "right": CameraStatistics()}, VIEWS)
    for k, record in enumerate(records):
        statistics.add(record, None if causal is None else causal[k])
    return statistics


PREDICTED, LOST = PoseStatus.PREDICTED, PoseStatus.LOST
OPEN = np.array([np.nan, np.nan, 0.6, 0.6, 0.6, 0.6])


@pytest.mark.parametrize(
    ("record", "cause"),
    [
        (a_record(1, PREDICTED, (SEEN,) * 3 + (SpotStatus.NO_IMAGE,) * 3, right=None), FrameCause.NO_PICTURE),
        (a_record(1, PREDICTED, events=(Event(CONTRADICTION, ""),)), FrameCause.CONTRADICTION),
        (a_record(1, PREDICTED, (SEEN, SEEN, *(HIDDEN,) * 4), probability=OPEN), FrameCause.LABELS_OPEN),
        (a_record(1, PREDICTED, (SEEN, HIDDEN, *(OUT,) * 4), left=1, right=0), FrameCause.OUT_OF_VIEW),
        (a_record(1, PREDICTED, (SEEN, SEEN, SEEN, *(OUT,) * 3), left=3, right=0), FrameCause.NOT_DETERMINED),
        (a_record(1, PREDICTED, (HIDDEN,) * N, left=0, right=0), FrameCause.HIDDEN),
        (a_record(1, LOST, (SpotStatus.LOST,) * N, left=1, right=2), FrameCause.FEW_POINTS),
        (a_record(1, LOST, (SpotStatus.LOST,) * N), FrameCause.UNEXPLAINED),
        # The pose is wrong, and there are six points where it does not expect any.
        (a_record(1, PREDICTED, (HIDDEN,) * N), FrameCause.UNEXPLAINED),
        (a_record(1, PREDICTED, (OUT,) * N), FrameCause.UNEXPLAINED),
    ],
)
def test_each_frame_without_a_measured_pose_has_its_cause(record, cause):
    statistics = statistics_of(a_record(0), record)
    assert statistics.causes == {cause: 1}
    assert statistics.missed == (cause in (FrameCause.CONTRADICTION, FrameCause.LABELS_OPEN, FrameCause.UNEXPLAINED))


def test_the_usual_clutter_is_no_evidence_of_spots():
    """Six reflections in every picture: an occluded frame with these shows no spots; one with six more points does."""
    measured = [a_record(k, left=9) for k in range(20)]
    occluded = a_record(20, PREDICTED, (HIDDEN,) * N, left=6, right=0)
    assert statistics_of(*measured, occluded).causes == {FrameCause.HIDDEN: 1}
    assert statistics_of(*measured, replace(occluded, detections=(points(9), points(3)))).causes == {
        FrameCause.UNEXPLAINED: 1
    }


def test_each_cameras_expected_and_measured_spots_are_counted():
    statistics = statistics_of(
        a_record(0),
        a_record(1, PREDICTED, (SEEN,) * 3 + (HIDDEN,) * 3, right=0),
        a_record(2, PREDICTED, (SEEN,) * 3 + (HIDDEN, OUT, OUT), right=0),
        a_record(3, PREDICTED, (SEEN,) * 3 + (SpotStatus.NO_IMAGE,) * 3, right=None),
    )
    right = statistics.cameras["right"]
    assert (right.pictures, right.empty, right.points) == (3, 2, 3)
    assert (right.expected, right.found) == (7, 3)
    assert (right.empty_at_end, right.expected_at_end) == (2, 4)
    assert right.missing.ranges == [[3, 3]]
    assert right.as_mapping()["missing"] == [[3, 3]]
    assert statistics.cameras["left"].as_mapping()["empty_at_end"] == 0


def test_losses_are_counted_in_the_reported_frames_and_not_in_searches():
    searched = Event("reacquired", "found from the prior alone")
    lost = (SpotStatus.LOST,) * N
    records = [
        a_record(0, LOST, lost),  # before it was ever found
        a_record(1),
        a_record(2, events=(searched,)),  # lost in the causal pass, known in the reported frame
        a_record(3, LOST, lost),
        a_record(4, LOST, lost),
        a_record(5),
        a_record(6, LOST, lost),
    ]
    statistics = statistics_of(*records, causal=[a_record(k, LOST, lost) for k in range(7)])
    assert statistics.lost.ranges == [[3, 4], [6, 6]]
    assert statistics.found_again == 1
    assert (statistics.measured, statistics.causal_measured) == (3, 0)
    assert statistics_of(*records).causal_measured is None


def test_a_tie_that_the_smoothing_pass_has_resolved_is_not_reported():
    tie = Event("tie", "spots 1, 2 or 2, 3")
    assert len(statistics_of(a_record(0, events=(tie,))).ties) == 0
    open_still = statistics_of(a_record(0), a_record(1, LOST, (SpotStatus.LOST,) * N, events=(tie,)))
    assert open_still.ties.ranges == [[1, 1]]
    assert open_still.tie_text == "spots 1, 2 or 2, 3"


def test_frame_ranges_count_their_frames_and_list_the_first_ranges():
    ranges = FrameRanges()
    for frame in (3, 4, 5, 9, 11, 12, 20, 30):
        ranges.add(frame)
    assert len(ranges) == 8
    assert ranges.ranges == [[3, 5], [9, 9], [11, 12], [20, 20], [30, 30]]
    assert ranges.as_text() == "3 to 5, 9, 11 to 12 and 2 more ranges"
    assert ranges.as_text(4) == "3 to 5, 9, 11 to 12, 20 and 1 more range"
    assert ranges.as_text(9) == "3 to 5, 9, 11 to 12, 20, 30"


def test_frames_in_which_a_camera_shows_its_spots_elsewhere_are_those_of_a_displaced_camera():
    hidden = (HIDDEN,) * 3 + (SEEN,) * 3
    cameras = statistics_of(*(a_record(k, status=hidden if k > 9 else (SEEN,) * N) for k in range(20))).cameras
    assert cameras["left"].moved.ranges == [[10, 19]]
    assert cameras["right"].moved.ranges == []
    assert cameras["left"].as_mapping()["displaced"] == [[10, 19]]


@pytest.mark.parametrize("merged", [1, 2])
def test_spots_that_have_merged_do_not_show_that_a_camera_has_moved(merged):
    """One of two has the label of their point, which is not used; the other one is hidden. A knock hides all."""
    status, used = [SEEN] * N, np.ones(N, dtype=bool)
    status[1], used[0] = HIDDEN, False
    if merged == 1:
        status[2] = HIDDEN
    records = [a_record(k) for k in range(40)]
    for k in range(20, 40):
        tracked = replace(records[k].tracked, status=tuple(status), used_in_pose=used)
        records[k] = replace(records[k], tracked=tracked)
    assert statistics_of(*records).cameras["left"].spots.moved_from() == (20 if merged == 1 else -1)


def test_points_elsewhere_than_a_mere_prediction_has_the_spots_do_not_show_that_a_camera_has_moved():
    """A vehicle that comes back after a gap is somewhere near the prediction; its camera has stood still."""
    seen = [a_record(k) for k in range(20)]
    elsewhere = [a_record(k, PREDICTED, (SEEN,) * 3 + (HIDDEN,) * 3) for k in range(20, 40)]
    assert statistics_of(*seen, *elsewhere).cameras["right"].spots.moved_from() == 20
    predicted = [a_record(k, PREDICTED, (HIDDEN,) * N) for k in range(20, 40)]
    assert statistics_of(*seen, *predicted).cameras["right"].spots.moved_from() == -1
