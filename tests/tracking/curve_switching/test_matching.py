"""Three-step matching: one detection, one track; the second search at a bend; clutter near other tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracking.curve_switching.matching import Matches, match
from tracking.detections import UNMATCHED
from tracking.parameters import TrackerParameters

SIZE = np.array([1280, 1024])
DEFAULT = TrackerParameters()


def matched(
    last, predicted, points, parameters: TrackerParameters = DEFAULT, r1: float = 10.0, r2: float = 30.0
) -> Matches:
    last, predicted = np.array(last, dtype=float), np.array(predicted, dtype=float)
    t = len(predicted)
    return match(last, predicted, np.full(t, r1), np.full(t, r2), np.array(points, dtype=float).reshape(-1, 2), SIZE,
                 parameters)  # fmt: skip


def test_a_spot_where_it_was_predicted_is_found_in_step_1():
    m = matched([[100, 100]], [[110, 100]], [[300, 300], [110.2, 99.9]])
    assert m.point.tolist() == [1]
    assert m.step.tolist() == [1]
    assert m.gain[0] > 0.95


def test_a_reversed_spot_is_found_in_step_2():
    """12 px per frame, and back again: 24 px from the prediction, out of reach of step 1."""
    m = matched([[100, 100]], [[112, 100]], [[88, 100]])
    assert m.point.tolist() == [0]
    assert m.step.tolist() == [2]
    assert m.gain[0] == pytest.approx(0.5)  # omega3 / (omega2 + omega3)


def test_with_epsilon_2_above_one_half_no_reversal_is_ever_found():
    m = matched([[100, 100]], [[112, 100]], [[88, 100]], replace(DEFAULT, eps2=0.55))
    assert m.point.tolist() == [UNMATCHED]
    assert m.step.tolist() == [3]
    assert np.isnan(m.gain[0])


def test_nothing_near_is_no_match():
    m = matched([[100, 100]], [[112, 100]], [[300, 300]])
    assert m.point.tolist() == [UNMATCHED]
    assert m.step.tolist() == [3]


@pytest.mark.parametrize("points", [[], [[5.0, 5.0]]])
def test_no_tracks_or_no_points_is_no_match(points):
    assert matched([[100, 100]], [[112, 100]], points).point.tolist() == [UNMATCHED]
    assert len(matched(np.zeros((0, 2)), np.zeros((0, 2)), points).point) == 0


def test_one_detection_serves_one_track():
    """Two tracks cross, one spot is hidden: the paper's loop would give the one detection to both."""
    m = matched([[100, 100], [120, 100]], [[109, 100], [111, 100]], [[110.5, 100]])
    assert sorted(m.point.tolist()) == [UNMATCHED, 0]


def test_two_poor_matches_are_better_than_one_good_one():
    """Track 0's own prediction is the only place that track 1 can reach; track 0 can do with the other point."""
    m = matched([[100, 107], [97, 107]], [[100, 100], [104, 107]], [[100, 100], [93, 103]])
    assert m.gain.sum() < 1  # less in sum than the gain of 1 that track 0 alone would have had
    assert m.point.tolist() == [1, 0]
    assert m.step.tolist() == [1, 1]


def test_clutter_nearer_to_another_track_is_left_to_neither():
    """A false point between two tracks, each with its own spot nearer: nobody takes it."""
    m = matched([[100, 100], [100, 130]], [[110, 100], [110, 115]], [[110, 108.0], [110.1, 100], [110, 115.2]])
    assert m.point.tolist() == [1, 2]


def test_clutter_beside_the_spot_does_not_win_against_it():
    m = matched([[100, 100]], [[110, 100]], [[114, 104], [110.3, 99.8], [103, 100]])
    assert m.point.tolist() == [1]


def test_clutter_nearer_to_the_prediction_of_another_track_does_not_stop_a_reversal():
    """Track 0 reverses; a false point lies ahead of track 1, whose own spot is nearer to it. Step 2 has the rest."""
    m = matched([[100, 100], [140, 100]], [[112, 100], [128, 100]], [[88, 100], [128, 100.2], [131, 104]])
    assert m.point.tolist() == [0, 1]
    assert m.step.tolist() == [2, 1]


def test_step_2_takes_no_detection_that_step_1_has_given_away():
    m = matched([[100, 100], [80, 100]], [[112, 100], [88, 100]], [[88, 100]])
    assert m.point.tolist() == [UNMATCHED, 0]
    assert m.step.tolist() == [3, 1]


def test_the_search_regions_are_circles_of_r1_and_r2():
    eager = replace(DEFAULT, eps1=-10.0, eps2=-10.0)
    for gap, step in ((9.99, 1), (10.01, 3)):
        # At rest, with r2 smaller than r1, only the first search can find it.
        assert matched([[100, 100]], [[100, 100]], [[100 + gap, 100]], eager, r2=1.0).step.tolist() == [step]
    for gap, step in ((29.99, 2), (30.01, 3)):
        assert matched([[100, 100]], [[160, 100]], [[100 + gap, 100]], eager).step.tolist() == [step]


def test_epsilon_1_refuses_what_is_near_but_does_not_fit():
    """At the radius' edge, sideways: g3 = 0.2 direction + 0.2 speed, at most 0.4."""
    sideways = matched([[100, 100]], [[110, 100]], [[110, 109.9]], r2=1.0)
    assert sideways.step.tolist() == [3]
    assert matched([[100, 100]], [[110, 100]], [[110, 109.9]], replace(DEFAULT, eps1=0.3), r2=1.0).step.tolist() == [1]


def test_with_the_papers_scale_nearness_decides_nothing():
    """5 px beside the prediction, or 9 px ahead of it on the line: over the picture's diagonal both are as near."""
    points = [[106, 103.0], [119, 100.0]]
    ours = matched([[100, 100]], [[110, 100]], points)
    papers = matched([[100, 100]], [[110, 100]], points, replace(DEFAULT, g1_scale="paper"))
    assert ours.point.tolist() == [0]
    assert papers.point.tolist() == [1]
    assert papers.gain[0] > 0.98


@given(seed=st.integers(0, 2**32 - 1))
def test_the_order_in_which_points_come_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    last = rng.uniform(100, 160, (4, 2))
    predicted = last + rng.normal(0, 8, (4, 2))
    points = np.concatenate([predicted + rng.normal(0, 3, (4, 2)), rng.uniform(90, 170, (6, 2))])
    shuffled = rng.permutation(len(points))
    one, other = matched(last, predicted, points), matched(last, predicted, points[shuffled])
    back = np.where(other.point == UNMATCHED, UNMATCHED, shuffled[other.point])
    np.testing.assert_array_equal(one.point, back)
    np.testing.assert_array_equal(one.step, other.step)
    np.testing.assert_allclose(one.gain, other.gain)
    taken = one.point[one.point != UNMATCHED]
    assert len(set(taken.tolist())) == len(taken)
