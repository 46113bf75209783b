"""When the rigid tracker searches a frame for the whole vehicle."""

from __future__ import annotations

import numpy as np

from geometry.forward_model import SpotModel
from lab.simulate.scenarios import RIGS
from tracking.detections import Detections
from tracking.rigid_body.acquisition import ASTRAY, LONG_UNMEASURED, SEARCH_AT, SearchSchedule
from tracking.rigid_body.models.occlusion import MISSED

MODEL = SpotModel.of(RIGS["fan"]())
N = len(MODEL)
MIN_SPOTS = 4
FOUND_ALL = np.arange(N)


def points(*counts: int) -> list[Detections]:
    """So many points per camera."""
    return [Detections.at(np.zeros((n, 2)), np.tile(np.eye(2), (n, 1, 1))) for n in counts]


def searched(schedule: SearchSchedule, best: np.ndarray | None, vague: bool, frames: int, counts=(3, 3)) -> list[int]:
    """The numbers of the searched frames, beginning with 1."""
    out = []
    for k in range(1, frames + 1):
        schedule.next_frame()
        if schedule.due(best, points(*counts), lambda: vague):
            out.append(k)
    return out


def tracking() -> SearchSchedule:
    """A schedule long after the vehicle was found."""
    schedule = SearchSchedule(MODEL, MIN_SPOTS)
    searched(schedule, FOUND_ALL, False, 10)
    return schedule


def test_without_a_hypothesis_searches_become_less_frequent():
    frames = searched(SearchSchedule(MODEL, MIN_SPOTS), None, False, 130)
    assert frames[:20] == list(range(1, 21))
    assert frames[20:22] == [22, 24]
    assert frames[-3:] == [120, 125, 130]
    assert searched(SearchSchedule(MODEL, MIN_SPOTS), None, False, 1100)[-3:] == [1060, 1080, 1100]


def test_more_points_than_before_are_searched_at_once():
    schedule = SearchSchedule(MODEL, MIN_SPOTS)
    searched(schedule, None, False, 121)
    assert schedule.due(None, points(4, 4), lambda: False)


def test_a_frame_with_too_few_points_is_not_searched():
    assert searched(SearchSchedule(MODEL, MIN_SPOTS), None, True, 5, counts=(2, 1)) == []


def test_a_hypothesis_that_explains_the_frame_needs_no_search():
    assert searched(tracking(), FOUND_ALL, False, 100) == []


def test_after_a_search_has_found_the_vehicle_vague_predictions_are_searched():
    schedule = tracking()
    schedule.found()
    assert searched(schedule, FOUND_ALL, True, 10) == [1, 2, 3, 4, 5]


def test_frames_that_contradict_the_hypothesis_are_searched_at_increasing_intervals():
    nothing = np.full(N, MISSED)
    assert searched(tracking(), nothing, False, 45) == [*SEARCH_AT, 20, 40]


def test_with_two_beams_the_missing_spots_of_both_cameras_contradict_together():
    """A vehicle at rest that moves off at once was searched after ten frames: no camera expects three spots."""
    two_of_each = np.full(N, -2)
    for camera in range(2):
        two_of_each[np.flatnonzero(camera == MODEL.camera_of)[:2]] = MISSED
    assert searched(tracking(), two_of_each, False, 45, counts=(2, 2)) == [*SEARCH_AT, 20, 40]
    assert searched(tracking(), two_of_each, False, 45, counts=(0, 4)) == []  # one screen is occluded


def test_few_spots_that_nothing_contradicts_are_searched_seldom():
    one_camera = np.where(MODEL.camera_of == 0, FOUND_ALL, -2)
    assert searched(tracking(), one_camera, False, 110) == [50, 100]


def test_labels_that_leave_most_spots_of_a_camera_missing_among_as_many_points_are_searched():
    one_of_the_first_camera = FOUND_ALL.copy()
    one_of_the_first_camera[np.flatnonzero(MODEL.camera_of == 0)[1:]] = MISSED
    schedule = tracking()
    assert searched(schedule, one_of_the_first_camera, False, 45) == [*SEARCH_AT, 20, 40]
    assert schedule.doubted
    assert searched(tracking(), one_of_the_first_camera, False, 45, counts=(2, 3)) == []  # occluded
    two_of_it = FOUND_ALL.copy()
    two_of_it[np.flatnonzero(MODEL.camera_of == 0)[-1]] = MISSED
    assert searched(schedule, two_of_it, False, 45) == []
    assert not schedule.doubted


def test_after_long_without_a_measured_pose_missing_spots_of_all_cameras_count_together():
    """One or two labels agree with almost any pose: a vehicle that moved away is searched, in the end anywhere."""
    one_missing_in_each = FOUND_ALL.copy()
    for camera in range(2):
        one_missing_in_each[np.flatnonzero(camera == MODEL.camera_of)[0]] = MISSED
    labels = [int(np.count_nonzero((one_missing_in_each >= 0) & (camera == MODEL.camera_of))) for camera in range(2)]
    spare = tuple(n + 1 for n in labels)
    few = np.where(np.arange(N) < N - 3, one_missing_in_each, -2)
    few[MODEL.camera_of == 1] = -2
    few[np.flatnonzero(MODEL.camera_of == 1)[0]] = MISSED
    schedule = tracking()
    for frame in range(60):
        schedule.measured(False, 2)
        due = schedule.due(few, points(*spare), lambda: False)
        assert not (due and frame < LONG_UNMEASURED - 1)
        if due:
            break
    assert frame <= LONG_UNMEASURED + SEARCH_AT[0]
    assert not schedule.astray
    for _ in range(ASTRAY):
        schedule.measured(False, 2)
        schedule.due(few, points(*spare), lambda: False)
    assert schedule.astray
    schedule.measured(True, 4)
    assert not schedule.astray


def test_missing_spots_without_points_in_their_place_are_occluded():
    missing = FOUND_ALL.copy()
    missing[:] = -2
    missing[[0, N - 1]] = MISSED
    schedule = tracking()
    for _ in range(45):
        schedule.measured(False, 2)
        assert not schedule.due(missing, points(0, MIN_SPOTS), lambda: False)
        assert not schedule.astray
