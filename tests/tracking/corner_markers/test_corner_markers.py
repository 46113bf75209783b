"""Lamps of a rendered tanker: corners at their places, right labels, poses with correct covariances, no wrong pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geometry.arrays import numeric_jacobian
from geometry.pose import Pose
from studies.fu2016 import CLEAR, GUST, MARKERS, Difficulty, marker_model, pose_of, render
from tracking.corner_markers import MatchParameters, harris_corners, harris_response, match_markers
from tracking.detections import UNMATCHED

STATE = np.array([21.0, 6.0, 0.5, 0, 0, 0, 0.1, 0.05])
CLEAN = Difficulty(false_lights=0, p_hidden=0.0)


def near(state, rng):
    return pose_of(state).plus(np.concatenate([rng.normal(0, 0.1, 3), rng.normal(0, 0.02, 3)]))


def test_a_corner_has_a_large_response_and_an_edge_has_not():
    picture = np.full((60, 60), 50, np.uint8)
    picture[20:40, 20:40] = 200
    response = harris_response(picture)
    assert response[20, 20] > 20 * response[20, 30]
    assert response[30, 30] == 0


def test_each_lamp_has_a_corner_at_its_place():
    rng = np.random.default_rng(1)
    places, _ = marker_model().project(pose_of(STATE))
    corners = harris_corners(render(STATE, CLEAN, rng))
    distance = np.linalg.norm(corners.uv_px[None] - places[:, None], axis=-1).min(axis=1)
    assert distance.max() < 0.5  # the wing tips: half of the background is darker


def test_an_even_picture_has_no_corner():
    assert len(harris_corners(np.full((80, 90), 7, np.uint8))) == 0


def test_the_jacobian_of_the_marker_model_is_the_derivative():
    model, pose = marker_model(), pose_of(STATE)
    numeric = numeric_jacobian(lambda d: model.project(pose.plus(d))[0], np.zeros(6))
    np.testing.assert_allclose(model.project(pose)[1], numeric, rtol=1e-5, atol=1e-4)


def test_exact_corners_give_the_exact_pose_whatever_their_order():
    rng = np.random.default_rng(2)
    model, truth = marker_model(), pose_of(STATE)
    places, _ = model.project(truth)
    order = rng.permutation(len(MARKERS))
    match = match_markers(model, places[order], near(STATE, rng), rng)
    np.testing.assert_array_equal(order[match.rows], np.arange(len(MARKERS)))
    np.testing.assert_allclose(match.fit.world_from_body.minus(truth), 0, atol=1e-6)


def test_poses_agree_with_their_covariances_and_labels_are_right():
    rng = np.random.default_rng(3)
    model, nees, found = marker_model(), [], 0
    places, _ = model.project(pose_of(STATE))
    for _ in range(8):
        corners = harris_corners(render(STATE, CLEAR, rng)).uv_px
        match = match_markers(model, corners, near(STATE, rng), rng)
        if match is None:
            continue
        found += 1
        matched = match.rows != UNMATCHED
        assert np.linalg.norm(corners[match.rows[matched]] - places[matched], axis=1).max() < 2
        error = match.fit.world_from_body.minus(pose_of(STATE))
        nees.append(error @ np.linalg.solve(match.fit.covariance, error) / 6)
    assert found >= 5
    assert np.median(nees) < 2


def test_a_hidden_lamp_is_unmatched_and_two_hidden_ones_give_no_pose():
    rng = np.random.default_rng(4)
    model = marker_model()
    places, _ = model.project(pose_of(STATE))
    match = match_markers(model, places[1:], pose_of(STATE), rng)
    assert match.rows[0] == UNMATCHED
    np.testing.assert_array_equal(match.rows[1:], np.arange(4))
    assert match_markers(model, places[2:], pose_of(STATE), rng) is None


def test_only_false_lights_give_no_pose():
    rng = np.random.default_rng(5)
    model = marker_model()
    places, _ = model.project(pose_of(STATE))
    for _ in range(10):
        false = places.mean(axis=0) + rng.normal(0, 40, (15, 2))
        assert match_markers(model, false, pose_of(STATE), rng) is None
    assert match_markers(model, np.zeros((0, 2)), pose_of(STATE), rng) is None


@pytest.mark.parametrize(("apart_m", "rows"), [(0.05, [0, 1, 2, 3, 4, UNMATCHED]), (0.02, None)])
def test_a_corner_belongs_to_one_lamp_and_two_equal_choices_give_no_pose(apart_m, rows):
    rng = np.random.default_rng(9)
    places, _ = marker_model().project(pose_of(STATE))
    sixth = MARKERS[-1:] + np.array([0.0, apart_m, 0.0])  # beside the fifth, and not lit
    twin = replace(marker_model(), markers=np.concatenate([MARKERS, sixth]))
    match = match_markers(twin, places, pose_of(STATE), rng)
    assert (None if match is None else match.rows.tolist()) == rows


def test_behind_the_camera_there_is_no_pose():
    rng = np.random.default_rng(6)
    behind = Pose(np.eye(3), np.array([-20.0, 0, 0]))
    assert match_markers(marker_model(), np.zeros((5, 2)), behind, rng) is None


def test_with_many_corners_four_lamps_are_not_enough():
    rng = np.random.default_rng(7)
    model = marker_model()
    places, _ = model.project(pose_of(STATE))
    crowd = places.mean(axis=0) + rng.uniform(-60, 60, (60, 2))
    assert match_markers(model, np.concatenate([places[1:], crowd]), pose_of(STATE), rng) is None
    assert match_markers(model, places[1:], pose_of(STATE), rng, replace(MatchParameters(), gate_px=5.0)) is not None


@pytest.mark.slow
def test_disturbed_pictures_give_few_poses_but_no_wrong_ones():
    rng = np.random.default_rng(8)
    model, wrong, found = marker_model(), 0, 0
    places, _ = model.project(pose_of(STATE))
    for _ in range(150):
        corners = harris_corners(render(STATE, GUST, rng)).uv_px
        match = match_markers(model, corners, near(STATE, rng), rng, replace(MatchParameters(), gate_px=8.0))
        if match is not None:
            found += 1
            matched = match.rows != UNMATCHED
            wrong += np.linalg.norm(corners[match.rows[matched]] - places[matched], axis=1).max() > 3
    assert found > 20
    assert wrong <= 2
