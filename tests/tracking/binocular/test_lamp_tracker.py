"""Lamps of a rendered tanker: lights at their places, right labels, poses with correct covariances, no wrong pose."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.pose import Pose
from lab.targets.stereo.lamps import spots
from studies.fu2016 import (
    CLEAR,
    DT_S,
    GUST,
    MARKERS,
    Difficulty,
    camera,
    labelled_px,
    lamp_model,
    pose_of,
    projected,
    render,
)
from tests.marks import further_slow
from tracking.binocular.acquisition import observations
from tracking.binocular.histories import _has_its_lights, _relative_motion
from tracking.binocular.joint_fit import MarkerObservations
from tracking.binocular.lamp_tracker import LampTracker, harris_corners, harris_response
from tracking.binocular.marker_model import MarkerImages
from tracking.statuses import Cause, PoseStatus

STATE = np.array([21.0, 6.0, 0.5, 0, 0, 0, 0.1, 0.05])
PLACES = projected(MARKERS, pose_of(STATE))
CLEAN = Difficulty(false_lights=0, p_hidden=0.0)
BLACK = np.zeros((512, 640), np.uint8)


def tracker_of(places, sigma_px=0.05):
    """A tracker that is shown these lights, one set per picture."""
    sets = iter(places)

    def find(_):
        at = next(sets)
        n = len(at)
        return MarkerImages(at, np.tile(sigma_px**2 * np.eye(2), (n, 1, 1)), np.full(n, np.nan), np.zeros(n, int))

    return LampTracker(camera(), lamp_model(), find, DT_S)


def test_a_corner_has_a_large_response_and_an_edge_has_not():
    picture = np.full((60, 60), 50, np.uint8)
    picture[20:40, 20:40] = 200
    response = harris_response(picture)
    assert response[20, 20] > 20 * response[20, 30]
    assert response[30, 30] == 0


@pytest.mark.parametrize("find", [harris_corners, spots])
def test_each_lamp_is_found_at_its_place(find):
    lights = find(render(STATE, CLEAN, np.random.default_rng(1)))
    distance = np.linalg.norm(lights.uv_px[None] - PLACES[:, None], axis=-1).min(axis=1)
    assert distance.max() < 0.5  # the wing tips: half of the background is darker


def test_an_even_picture_has_no_corner():
    assert len(harris_corners(np.full((80, 90), 7, np.uint8))) == 0


def test_exact_lights_give_the_exact_pose_whatever_their_order():
    order = np.random.default_rng(2).permutation(len(MARKERS))
    frame = tracker_of([PLACES[order]]).step(BLACK)
    assert frame.event == "acquired"
    np.testing.assert_array_equal(order[frame.tracked.index[0]], np.arange(len(MARKERS)))
    np.testing.assert_allclose(frame.tracked.pose.minus(pose_of(STATE)), 0, atol=1e-5)


def test_poses_agree_with_their_covariances_and_labels_are_right():
    rng, nees, tracker = np.random.default_rng(3), [], LampTracker(camera(), lamp_model(), spots, DT_S)
    for _ in range(25):
        frame = tracker.step(render(STATE, CLEAR, rng))
        if frame.status is PoseStatus.MEASURED:
            assert np.nanmax(np.linalg.norm(labelled_px(frame) - PLACES, axis=1)) < 2
            error = pose_of(STATE).minus(frame.tracked.pose)
            nees.append(error @ np.linalg.solve(frame.tracked.covariance, error) / 6)
    assert len(nees) >= 20
    assert 0.2 < np.median(nees) < 2  # lamps in front of the edges of the wing


def test_four_lamps_are_enough_after_the_start_and_three_are_not():
    tracker = tracker_of([PLACES, PLACES[1:], PLACES[2:]])
    frames = [tracker.step(BLACK) for _ in range(3)]
    np.testing.assert_array_equal(frames[1].tracked.index[0], [-1, 0, 1, 2, 3])
    assert [f.status for f in frames] == [PoseStatus.MEASURED, PoseStatus.MEASURED, PoseStatus.PREDICTED]
    assert frames[2].cause is Cause.UNCERTAIN


def test_false_lights_alone_give_no_pose():
    rng = np.random.default_rng(5)
    crowds = [PLACES.mean(axis=0) + rng.normal(0, 40, (15, 2)) for _ in range(4)]
    tracker = tracker_of([*crowds, np.zeros((0, 2))])
    assert {tracker.step(BLACK).status for _ in range(5)} == {PoseStatus.LOST}


def test_at_the_start_four_lamps_among_many_lights_are_not_enough():
    crowd = PLACES.mean(axis=0) + np.random.default_rng(7).uniform(-60, 60, (12, 2))
    assert tracker_of([np.concatenate([PLACES[1:], crowd])]).step(BLACK).status is PoseStatus.LOST


def approach(count, seed, *, lamps=4, moving=1.0):
    """Pictures of a target that comes nearer and turns, and of five lights that move on their own."""
    rng = np.random.default_rng(seed)
    start, speed = PLACES.mean(axis=0) + rng.uniform(-150, 150, (9 - lamps, 2)), rng.normal(0, 1.0, (9 - lamps, 2))
    for k in range(count):
        t = moving * k
        state = STATE - t * np.array([0.2, 0.02, 0, 0, 0, 0, 0.01, 0.015])
        seen = projected(MARKERS, pose_of(state))[:lamps] if lamps else np.zeros((0, 2))
        yield np.concatenate([start + t * speed, seen]) + rng.normal(0, 0.05, (9, 2))


@pytest.mark.parametrize("seed", further_slow([11, 12]))
def test_four_lamps_among_five_other_lights_are_found_when_the_lights_have_moved(seed):
    tracker = tracker_of(list(approach(25, seed)))
    frames = [tracker.step(BLACK) for _ in range(25)]
    assert frames[0].status is PoseStatus.LOST
    assert frames[-1].status is PoseStatus.MEASURED
    for frame in frames:
        if frame.status is PoseStatus.MEASURED:
            np.testing.assert_array_equal(frame.tracked.index[0], [5, 6, 7, 8, -1])


@pytest.mark.parametrize(("lamps", "moving"), further_slow([(4, 0.0), (0, 1.0)]))
def test_lights_at_rest_and_other_lights_give_no_pose_however_many_pictures(lamps, moving):
    tracker = tracker_of(list(approach(10, 13, lamps=lamps, moving=moving)))
    assert {tracker.step(BLACK).status for _ in range(10)} == {PoseStatus.LOST}


def test_the_relative_motion_of_lights_is_that_beyond_shift_turn_and_scale_in_their_largest_noise():
    uv = np.full((2, 5, 2), np.nan)
    uv[0, :4] = [[0, 0], [100, 0], [0, 80], [60, 50]]
    cov = np.tile(0.01 * np.eye(2), (2, 5, 1, 1))
    turned = 50 + 1.3 * uv @ np.array([[0.8, 0.6], [-0.6, 0.8]])
    assert _relative_motion(MarkerObservations(uv, cov), MarkerObservations(turned, cov)) == pytest.approx(0, abs=1e-9)
    moved, vague = uv.copy(), cov.copy()
    moved[0, 0] += [2.0, -1.0]
    vague[0, 3] *= 25
    clear, hidden = (_relative_motion(MarkerObservations(uv, c), MarkerObservations(moved, c)) for c in (cov, vague))
    assert clear > 50
    assert hidden == pytest.approx(clear / 25)
    rng, noisy = np.random.default_rng(4), []
    for _ in range(600):
        seen = MarkerObservations(turned + rng.normal(0.0, 0.1, uv.shape), cov)
        noisy.append(_relative_motion(MarkerObservations(uv, cov), seen))
    assert np.mean(noisy) == pytest.approx(1.0, abs=0.1)  # 600 x 4 squared normal numbers


def test_a_pose_is_continued_by_its_own_lights_alone():
    rng = np.random.default_rng(3)
    at = rng.uniform(0, 400, (30, 2))
    images = MarkerImages(at, np.tile(0.01 * np.eye(2), (30, 1, 1)), np.full(30, np.nan), np.zeros(30, int))

    def of(*chosen, shift=0.0):
        index = np.full((2, 4), -1)
        index[0] = chosen
        seen = observations((images, MarkerImages.none()), index)
        return MarkerObservations(seen.uv_px - shift, seen.cov_px2)

    assert _has_its_lights(of(0, 1, 2, 3, shift=9.0), of(0, 1, 2, 3), (images, MarkerImages.none()))
    assert not _has_its_lights(of(0, 1, 2, 3), of(0, 1, 2, 4), (images, MarkerImages.none()))


@pytest.mark.parametrize("others", further_slow([12, 18]))
def test_lamps_among_lights_that_are_all_brighter_are_found(others):
    rng = np.random.default_rng(others)
    for _ in range(3):
        brighter = rng.uniform(0, 1, (others, 2)) * camera().image_size_px
        frame = tracker_of([np.concatenate([brighter, PLACES])]).step(BLACK)
        assert frame.status is PoseStatus.MEASURED
        np.testing.assert_array_equal(frame.tracked.index[0], others + np.arange(len(PLACES)))


def test_a_missing_picture_is_predicted_and_after_many_the_target_is_lost():
    tracker = tracker_of([PLACES])
    frames = [tracker.step(BLACK), *(tracker.step(None) for _ in range(40))]
    assert frames[1].status is PoseStatus.PREDICTED
    assert frames[1].cause is Cause.NO_IMAGE
    assert frames[-1].status is PoseStatus.LOST
    assert [f.event for f in frames if f.event] == ["acquired", "lost"]


def test_the_pose_does_not_depend_on_where_the_camera_is_in_the_world():
    moved = Pose.from_ypr(np.array([0.3, -0.2, 0.1]), np.array([1.0, 2.0, 3.0]))
    seen = camera()
    other = type(seen)(
        seen.name, seen.screen, seen.image_size_px, seen.matrix, (), seen.camera_from_world @ moved.inverse()
    )
    here = tracker_of([PLACES]).step(BLACK).tracked.pose
    find = tracker_of([PLACES])._find
    there = LampTracker(other, lamp_model(), find, DT_S).step(BLACK).tracked.pose
    np.testing.assert_allclose(there.minus(moved @ here), 0, atol=1e-6)


@pytest.mark.slow
def test_disturbed_pictures_give_no_wrong_labels():
    rng, wrong, found = np.random.default_rng(8), 0, 0
    tracker = LampTracker(camera(), lamp_model(), spots, DT_S)
    for k in range(150):
        frame = tracker.step(render(STATE, GUST if k else CLEAN, rng))
        if frame.status is PoseStatus.MEASURED:
            found += 1
            wrong += np.nanmax(np.linalg.norm(labelled_px(frame) - PLACES, axis=1)) > 3
    assert found > 40
    assert wrong <= 2
