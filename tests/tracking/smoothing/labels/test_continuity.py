"""Labels by continuity: a spot's path in the picture is followed where the pose is uncertain, and only there."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.arrays import Array
from tests.marks import further_slow
from tests.tracking.smoothing.labels.path_recordings import FRAMES, GAP, context, filmed, without
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.labels.continuity import MIN_SINGLE_CHAIN, continued
from tracking.smoothing.labels.view_path import MAX_AHEAD


def paths(jump_at: int | None = None) -> Array:
    """Paths (T, 2, 2), px, of two spots that swing 200 px apart, with a velocity jump at a frame if one is given."""
    k = np.arange(FRAMES, dtype=float)
    x = 400 + 120 * np.sin(0.09 * k)
    y = 500 + 60 * np.cos(0.07 * k)
    if jump_at is not None:
        y += 3.0 * np.maximum(k - jump_at, 0)
    one = np.stack([x, y], axis=1)
    return np.stack([one, one + np.array([200.0, 0.0])], axis=1)


@pytest.mark.parametrize("false_points", [0.0, 0.5, 1.0])
def test_paths_are_followed_through_frames_with_an_uncertain_pose(false_points):
    uv = paths()
    for seed in range(6):
        every, rows = filmed(uv, np.ones((FRAMES, 2), dtype=bool), false_points, seed)
        out, probability = continued(every, without(rows, GAP), context(uv, false_points=false_points), {})
        given = out[GAP] >= 0
        assert np.array_equal(out[GAP][given], rows[GAP][given])
        assert given.mean() > 0.97
        assert np.array_equal(np.isfinite(probability[GAP]), given)
        assert np.all(probability[GAP][given] >= 0.99)


def test_other_frames_are_not_changed():
    uv = paths()
    every, rows = filmed(uv, np.ones((FRAMES, 2), dtype=bool), 0.5, 1)
    before = without(rows, slice(20, 30), GAP)
    out, _ = continued(every, before, context(uv, false_points=0.5), {})
    outside = np.ones(FRAMES, dtype=bool)
    outside[GAP] = False
    np.testing.assert_array_equal(out[outside], before[outside])


@pytest.mark.parametrize("length", further_slow([2, 10, 1, 25], fast=2))
def test_false_points_are_not_labelled_while_no_spot_is_visible(length):
    uv = paths()
    hidden = slice(GAP.start, GAP.start + length)
    labels = 0
    for seed in range(20):
        visible = np.ones((FRAMES, 2), dtype=bool)
        visible[hidden] = False
        every, rows = filmed(uv, visible, 1.0, seed)
        out, _ = continued(every, without(rows, hidden), context(uv, false_points=1.0), {})
        labels += int(np.count_nonzero(out[hidden] >= 0))
    assert labels == 0


def test_a_path_that_vanishes_is_not_continued_by_false_points():
    """One spot vanishes within the gap, the other stays; in each of 20 runs 40 false points lie near its path."""
    uv = paths()
    wrong = 0
    for seed in range(20):
        visible = np.ones((FRAMES, 2), dtype=bool)
        visible[60:, 0] = False
        every, rows = filmed(uv, visible, 1.0, seed)
        out, _ = continued(every, without(rows, GAP), context(uv, false_points=1.0), {})
        wrong += int(np.count_nonzero(out[60:, 0] >= 0))
    assert wrong <= 1


def test_a_path_is_followed_through_a_velocity_jump_if_no_other_point_is_near():
    uv = paths(jump_at=62)
    every, rows = filmed(uv, np.ones((FRAMES, 2), dtype=bool), 0.0, 3)
    out, _ = continued(every, without(rows, GAP), context(uv), {})
    given = out[GAP] >= 0
    assert np.array_equal(out[GAP][given], rows[GAP][given])
    assert given.mean() > 0.9


def zig_zag(*corners: int) -> Array:
    """Straight paths (T, 2, 2), px, of two spots 200 px apart that turn together at these frames."""
    velocities = np.array([[3.0, 1.0], [-2.0, 3.5], [4.0, -2.0]])
    leg = np.searchsorted(corners, np.arange(FRAMES), side="right")
    one = np.array([300.0, 400.0]) + np.cumsum(velocities[leg], axis=0)
    return np.stack([one, one + np.array([200.0, 0.0])], axis=1)


@pytest.mark.parametrize("false_points", [0.0, 1.0])
def test_a_straight_path_is_followed_across_two_corners_without_labels_between_them(false_points):
    uv = zig_zag(56, 68)
    for seed in range(6):
        every, rows = filmed(uv, np.ones((FRAMES, 2), dtype=bool), false_points, seed)
        out, _ = continued(every, without(rows, GAP), context(uv, false_points=false_points), {})
        given = out[GAP] >= 0
        assert np.array_equal(out[GAP][given], rows[GAP][given])
        assert given.mean() > 0.95


def test_a_spot_at_rest_keeps_its_labels():
    uv = np.tile(paths()[:1], (FRAMES, 1, 1))
    visible = np.ones((FRAMES, 2), dtype=bool)
    visible[[55, 60, 61], 0] = False
    every, rows = filmed(uv, visible, 0.0, 8)
    out, _ = continued(every, without(rows, GAP), context(uv), {})
    np.testing.assert_array_equal(out[GAP], rows[GAP])


@pytest.mark.parametrize("step_px", [4.0, 8.0, 20.0])
def test_a_static_point_near_a_hidden_spot_that_moves_in_steps_is_not_labelled(step_px):
    """A turntable: since the errors of the path's extrapolation are of its steps too, the point could be a spot."""
    k = np.arange(FRAMES, dtype=float)
    steps = np.clip((k[:, None] - np.array([10, 25, 40, 62, 80, 100])) / 5, 0, 1).sum(axis=1)
    spot = np.stack([300 + step_px * steps, np.full(FRAMES, 400.0)], axis=1)
    reflection = np.tile([300 + 3.5 * step_px, 406.0], (FRAMES, 1))
    visible = np.ones((FRAMES, 2), dtype=bool)
    visible[GAP, 0] = False
    every, rows = filmed(np.stack([spot, reflection], axis=1), visible, 0.0, 1)
    before, c = without(rows, GAP), context(np.stack([spot, reflection], axis=1))
    before[:, 1] = -1
    c.log_static[every.begin[:-1] + rows[:, 1]] = 0.0
    out, _ = continued(every, before, c, {})
    np.testing.assert_array_equal(out, before)


def test_a_path_is_followed_where_the_uncertain_pose_leads_to_no_point_of_the_screen():
    uv = paths()
    every, rows = filmed(uv, np.ones((FRAMES, 2), dtype=bool), 0.0, 7)
    nowhere = context(uv)
    nowhere.expected[GAP], nowhere.expected_cov[GAP] = np.nan, 0.0
    out, _ = continued(every, without(rows, GAP), nowhere, {})
    np.testing.assert_array_equal(out[GAP], rows[GAP])


def test_a_path_is_followed_over_missed_detections():
    uv = paths()
    visible = np.ones((FRAMES, 2), dtype=bool)
    visible[[55, 60, 61, 66], 0] = False
    every, rows = filmed(uv, visible, 0.0, 4)
    out, _ = continued(every, without(rows, GAP), context(uv), {})
    np.testing.assert_array_equal(out[GAP], rows[GAP])


def test_a_point_that_the_pose_excludes_is_not_labelled():
    """A point on the path that the pose excludes is another point of light."""
    uv = paths()
    every, rows = filmed(uv, np.ones((FRAMES, 2), dtype=bool), 0.0, 5)
    out, _ = continued(every, without(rows, GAP), context(uv, sigma_px=2.0), {})
    assert np.all(out[GAP] < 0)


def test_no_point_is_labelled_as_two_spots():
    """Two spots meet and are one point of light for some frames, to which both paths lead."""
    uv = paths()
    k = np.arange(FRAMES)
    uv[:, 1] = uv[:, 0] + np.stack([np.abs(k - 62.0) * 3, 0 * k], axis=1)
    visible = np.ones((FRAMES, 2), dtype=bool)
    visible[60:65, 1] = False
    every, rows = filmed(uv, visible, 0.0, 6)
    out, _ = continued(every, without(rows, GAP), context(uv), {})
    for k in range(FRAMES):
        used = out[k][out[k] >= 0] % BLENDED
        assert len(set(used.tolist())) == len(used)
    assert (out[GAP] >= 0).mean() >= 0.5


def test_a_single_spot_is_followed_for_long_or_not_at_all():
    uv = paths()[:, :1]
    for length in (MIN_SINGLE_CHAIN - 2, MIN_SINGLE_CHAIN + 5):
        every, rows = filmed(uv, np.ones((FRAMES, 1), dtype=bool), 0.0, 7)
        gap = slice(GAP.start, GAP.start + length)
        out, _ = continued(every, without(rows, gap), context(uv), {})
        assert np.all((out[gap] >= 0) == (length >= MIN_SINGLE_CHAIN))


def test_a_path_with_few_labels_is_not_continued():
    """The errors of its extrapolation cannot be estimated."""
    uv = paths()
    every, rows = filmed(uv, np.ones((FRAMES, 2), dtype=bool), 0.0, 8)
    few = np.full_like(rows, -1)
    few[GAP.start - 2 * MAX_AHEAD : GAP.start] = rows[GAP.start - 2 * MAX_AHEAD : GAP.start]
    out, probability = continued(every, few, context(uv), {})
    np.testing.assert_array_equal(out, few)
    assert np.isnan(probability).all()
