"""Three-step matching: one detection per track, the second search at a bend, clutter near other tracks."""

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
    """12 px per frame forward, then back: 24 px from the prediction, outside the search region of step 1."""
    m = matched([[100, 100]], [[112, 100]], [[88, 100]])
    assert m.point.tolist() == [0]
    assert m.step.tolist() == [2]
    assert m.gain[0] == pytest.approx(0.5)  # omega3 / (omega2 + omega3)


def test_with_epsilon_2_above_one_half_no_reversal_is_found():
    m = matched([[100, 100]], [[112, 100]], [[88, 100]], replace(DEFAULT, eps2=0.55))
    assert m.point.tolist() == [UNMATCHED]
    assert m.step.tolist() == [3]
    assert np.isnan(m.gain[0])


def test_a_track_without_a_near_point_has_no_match():
    m = matched([[100, 100]], [[112, 100]], [[300, 300]])
    assert m.point.tolist() == [UNMATCHED]
    assert m.step.tolist() == [3]


@pytest.mark.parametrize("points", [[], [[5.0, 5.0]]])
def test_without_tracks_or_points_there_is_no_match(points):
    assert matched([[100, 100]], [[112, 100]], points).point.tolist() == [UNMATCHED]
    assert len(matched(np.zeros((0, 2)), np.zeros((0, 2)), points).point) == 0


def test_one_detection_is_assigned_to_one_track():
    """Two tracks cross and one spot is hidden: the paper's loop would assign the one detection to both."""
    m = matched([[100, 100], [120, 100]], [[109, 100], [111, 100]], [[110.5, 100]])
    assert sorted(m.point.tolist()) == [UNMATCHED, 0]


def test_two_poor_matches_are_better_than_one_good_one():
    """Only the point at track 0's prediction is within reach of track 1; track 0 can also take the other point."""
    m = matched([[100, 107], [97, 107]], [[100, 100], [104, 107]], [[100, 100], [93, 103]])
    assert m.gain.sum() < 1  # less than the gain of 1 that track 0 alone would have
    assert m.point.tolist() == [1, 0]
    assert m.step.tolist() == [1, 1]


def test_clutter_between_two_tracks_is_not_matched():
    """A false point between two tracks, each of which has its own spot nearer to its prediction."""
    m = matched([[100, 100], [100, 130]], [[110, 100], [110, 115]], [[110, 108.0], [110.1, 100], [110, 115.2]])
    assert m.point.tolist() == [1, 2]


def test_clutter_beside_the_spot_is_not_preferred_to_it():
    m = matched([[100, 100]], [[110, 100]], [[114, 104], [110.3, 99.8], [103, 100]])
    assert m.point.tolist() == [1]


def test_clutter_near_the_prediction_of_another_track_does_not_prevent_finding_a_reversal():
    """Track 0 reverses; a false point lies ahead of track 1, whose own spot is nearer to its prediction."""
    m = matched([[100, 100], [140, 100]], [[112, 100], [128, 100]], [[88, 100], [128, 100.2], [131, 104]])
    assert m.point.tolist() == [0, 1]
    assert m.step.tolist() == [2, 1]


def test_step_2_takes_no_detection_that_step_1_has_assigned():
    m = matched([[100, 100], [80, 100]], [[112, 100], [88, 100]], [[88, 100]])
    assert m.point.tolist() == [UNMATCHED, 0]
    assert m.step.tolist() == [3, 1]


def test_the_search_regions_are_circles_of_r1_and_r2():
    without_thresholds = replace(DEFAULT, eps1=-10.0, eps2=-10.0)
    for gap, step in ((9.99, 1), (10.01, 3)):
        # At rest, with r2 smaller than r1, only the first search can find it.
        near = matched([[100, 100]], [[100, 100]], [[100 + gap, 100]], without_thresholds, r2=1.0)
        assert near.step.tolist() == [step]
    for gap, step in ((29.99, 2), (30.01, 3)):
        assert matched([[100, 100]], [[160, 100]], [[100 + gap, 100]], without_thresholds).step.tolist() == [step]


def test_epsilon_1_rejects_a_near_point_with_a_low_gain():
    """At the edge of the search region, sideways: g3 = 0.2 direction + 0.2 speed, at most 0.4."""
    sideways = matched([[100, 100]], [[110, 100]], [[110, 109.9]], r2=1.0)
    assert sideways.step.tolist() == [3]
    assert matched([[100, 100]], [[110, 100]], [[110, 109.9]], replace(DEFAULT, eps1=0.3), r2=1.0).step.tolist() == [1]


def test_with_the_papers_scale_nearness_does_not_affect_the_match():
    """5 px to the side of the prediction or 9 px ahead of it: over the image diagonal both are equally near."""
    points = [[106, 103.0], [119, 100.0]]
    ours = matched([[100, 100]], [[110, 100]], points)
    papers = matched([[100, 100]], [[110, 100]], points, replace(DEFAULT, g1_scale="paper"))
    assert ours.point.tolist() == [0]
    assert papers.point.tolist() == [1]
    assert papers.gain[0] > 0.98


@given(seed=st.integers(0, 2**32 - 1))
def test_the_order_of_the_points_does_not_change_the_matches(seed):
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
