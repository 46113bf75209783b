"""Which instants are processed, which pictures belong to them, and which of them a row of the tables is about."""

from __future__ import annotations

import numpy as np

from lab.runs.frames.moments import plan_moments
from lab.runs.frames.pipeline import _sources

ROWS = np.arange(10)
ROWS_S = ROWS / 100


def of_camera(moments, name):
    return [(m.pictures[name].number, m.is_row, round(m.t_s, 9)) for m in moments if name in m.pictures]


def test_a_picture_belongs_to_the_row_nearest_to_it():
    moments = list(plan_moments(ROWS, ROWS_S, {"a": (ROWS, ROWS_S), "b": (ROWS, ROWS_S + 0.013)}))
    assert of_camera(moments, "a") == [(k, True, round(k / 100, 9)) for k in range(10)]
    assert of_camera(moments, "b")[:9] == [(k, True, round((k + 1) / 100, 9)) for k in range(9)]


def test_a_picture_after_the_last_row_is_a_moment_without_a_row():
    moments = list(plan_moments(ROWS, ROWS_S, {"b": (ROWS, ROWS_S + 0.013)}))
    assert [m.is_row for m in moments[-1:]] == [False]
    assert moments[-1].pictures["b"].number == 9


def test_a_row_is_about_the_picture_of_its_number_however_late_it_is():
    moments = list(plan_moments(ROWS, ROWS_S, {"a": (ROWS, ROWS_S), "b": (ROWS, ROWS_S + 0.013)}))
    sources = _sources(moments, ("a", "b"), (False, False))
    assert [s[0] for s in sources] == list(range(10))
    assert [moments[s[1]].pictures["b"].number for s in sources] == list(range(10))


def test_a_faster_camera_has_moments_between_the_rows_in_order_of_time():
    fast = np.arange(30)
    moments = list(plan_moments(ROWS, ROWS_S, {"a": (fast, fast / 300), "b": (fast, fast / 300 + 1e-4)}))
    t_s = np.array([m.t_s for m in moments])
    assert np.all(np.diff(t_s) > 0)
    for name in ("a", "b"):
        assert [n for n, _, _ in of_camera(moments, name)] == list(range(30))
    assert len(moments) == 30  # pictures at nearly the same time share a moment


def test_of_two_pictures_near_one_row_the_nearer_one_belongs_to_it():
    instants = np.array([0.0, 0.0098, 0.0141, 0.03])
    moments = list(plan_moments(ROWS, ROWS_S, {"a": (np.arange(4), instants)}))
    assert of_camera(moments, "a") == [(0, True, 0.0), (1, True, 0.01), (2, False, 0.0141), (3, True, 0.03)]


def test_pictures_half_way_between_two_rows_have_one_row_each():
    moments = list(plan_moments(ROWS, ROWS_S, {"a": (ROWS, ROWS_S + 0.005)}))
    assert [n for n, _, _ in of_camera(moments, "a")] == list(range(10))
    assert sum(m.is_row for m in moments if m.pictures) == 10
