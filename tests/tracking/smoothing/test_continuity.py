"""Labels by continuity: a spot's path in the picture is followed where the pose says little, and no farther."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.arrays import Array, Bools, Ints
from tracking.rigid_body.association import BLENDED
from tracking.smoothing.continuity import LONG_CHAIN, MOST_AHEAD, Surroundings, continued
from tracking.smoothing.reassociation import AllDetections

FRAMES, SIGMA_PX, SIDE_PX = 120, 0.05, 1000.0
GAP = slice(50, 75)


def paths(bend_at: int | None = None) -> Array:
    """(T, 2, 2) px: two spots that swing side by side, 200 px apart; one more bend where it is asked for."""
    k = np.arange(FRAMES, dtype=float)
    x = 400 + 120 * np.sin(0.09 * k)
    y = 500 + 60 * np.cos(0.07 * k)
    if bend_at is not None:
        y += 3.0 * np.maximum(k - bend_at, 0)
    one = np.stack([x, y], axis=1)
    return np.stack([one, one + np.array([200.0, 0.0])], axis=1)


def filmed(uv: Array, shining: Bools, false_points: float, seed: int) -> tuple[AllDetections, Ints]:
    """One camera's detections, in no order, with false points within 60 px of each spot; and each spot's row (T, n)."""
    rng = np.random.default_rng(seed)
    rows, places = np.full(uv.shape[:2], -1), []
    for k in range(FRAMES):
        seen = np.flatnonzero(shining[k])
        points = uv[k, seen] + SIGMA_PX * rng.normal(size=(len(seen), 2))
        near = uv[k] + rng.uniform(-60, 60, (uv.shape[1], 2))
        points = np.concatenate([points, near[rng.random(uv.shape[1]) < false_points]])
        order = rng.permutation(len(points))
        places.append(points[order])
        rows[k, seen] = np.argsort(order)[: len(seen)]
    counts = [len(p) for p in places]
    m = sum(counts)
    every = AllDetections(
        np.concatenate(places), np.tile(SIGMA_PX**2 * np.eye(2), (m, 1, 1)), np.zeros(m),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        np.stack([np.zeros(FRAMES), counts], axis=1).astype(np.int64), np.ones((FRAMES, 1), dtype=bool),
        np.full(m, -np.inf), np.full(m, np.nan), np.full(uv.shape[1], np.nan),
    )  # fmt: skip
    return every, rows


def around(uv: Array, sigma_px: float = 300.0, false_points: float = 0.0) -> Surroundings:
    """A pose that says next to nothing, in all frames of the gap."""
    open_frames = np.zeros(FRAMES, dtype=bool)
    open_frames[GAP] = True
    density = max(false_points / 120.0**2, 1e-6)
    spread = np.tile(sigma_px**2 * np.eye(2), (*uv.shape[:2], 1, 1))
    camera = np.zeros(uv.shape[1], dtype=np.int64)
    return Surroundings(camera, uv + 50.0, spread, np.full(uv.shape[:2], np.log(density)), open_frames)


def without(rows: Ints, *frames: slice) -> Ints:
    out = rows.copy()
    for f in frames:
        out[f] = -1
    return out


@pytest.mark.parametrize("false_points", [0.0, 0.5, 1.0])
def test_paths_are_followed_through_frames_whose_pose_is_vague(false_points):
    uv = paths()
    for seed in range(6):
        every, rows = filmed(uv, np.ones((FRAMES, 2), dtype=bool), false_points, seed)
        out, probability = continued(every, without(rows, GAP), around(uv, false_points=false_points))
        given = out[GAP] >= 0
        assert np.array_equal(out[GAP][given], rows[GAP][given])
        assert given.mean() > 0.97
        assert np.array_equal(np.isfinite(probability[GAP]), given)
        assert np.all(probability[GAP][given] >= 0.99)


def test_other_frames_stay_as_they_are():
    uv = paths()
    every, rows = filmed(uv, np.ones((FRAMES, 2), dtype=bool), 0.5, 1)
    before = without(rows, slice(20, 30), GAP)
    out, _ = continued(every, before, around(uv, false_points=0.5))
    outside = np.ones(FRAMES, dtype=bool)
    outside[GAP] = False
    np.testing.assert_array_equal(out[outside], before[outside])


@pytest.mark.parametrize("length", [1, 2, 10, 25])
def test_false_points_where_nothing_shines_are_no_spots(length):
    uv = paths()
    dark = slice(GAP.start, GAP.start + length)
    labels = 0
    for seed in range(20):
        shining = np.ones((FRAMES, 2), dtype=bool)
        shining[dark] = False
        every, rows = filmed(uv, shining, 1.0, seed)
        out, _ = continued(every, without(rows, dark), around(uv, false_points=1.0))
        labels += int(np.count_nonzero(out[dark] >= 0))
    assert labels == 0


def test_a_path_that_vanishes_is_not_continued_by_false_points():
    """One spot goes out within the gap, the other stays: 40 false points for each of 20 runs lie about its path."""
    uv = paths()
    wrong = 0
    for seed in range(20):
        shining = np.ones((FRAMES, 2), dtype=bool)
        shining[60:, 0] = False
        every, rows = filmed(uv, shining, 1.0, seed)
        out, _ = continued(every, without(rows, GAP), around(uv, false_points=1.0))
        wrong += int(np.count_nonzero(out[60:, 0] >= 0))
    assert wrong <= 1


def test_a_bend_is_got_over_where_no_other_point_is_near():
    uv = paths(bend_at=62)
    every, rows = filmed(uv, np.ones((FRAMES, 2), dtype=bool), 0.0, 3)
    out, _ = continued(every, without(rows, GAP), around(uv))
    given = out[GAP] >= 0
    assert np.array_equal(out[GAP][given], rows[GAP][given])
    assert given.mean() > 0.9


def test_missed_detections_are_stepped_over():
    uv = paths()
    shining = np.ones((FRAMES, 2), dtype=bool)
    shining[[55, 60, 61, 66], 0] = False
    every, rows = filmed(uv, shining, 0.0, 4)
    out, _ = continued(every, without(rows, GAP), around(uv))
    np.testing.assert_array_equal(out[GAP], rows[GAP])


def test_a_pose_that_knows_better_is_believed():
    """What a path leads to but the pose excludes is another light: its label stays open."""
    uv = paths()
    every, rows = filmed(uv, np.ones((FRAMES, 2), dtype=bool), 0.0, 5)
    out, _ = continued(every, without(rows, GAP), around(uv, sigma_px=2.0))
    assert np.all(out[GAP] < 0)


def test_one_point_is_never_two_spots():
    """Two spots that meet and are one point of light for a while: both paths run into it, and neither gets it twice."""
    uv = paths()
    k = np.arange(FRAMES)
    uv[:, 1] = uv[:, 0] + np.stack([np.abs(k - 62.0) * 3, 0 * k], axis=1)
    shining = np.ones((FRAMES, 2), dtype=bool)
    shining[60:65, 1] = False
    every, rows = filmed(uv, shining, 0.0, 6)
    out, _ = continued(every, without(rows, GAP), around(uv))
    for k in range(FRAMES):
        used = out[k][out[k] >= 0] % BLENDED
        assert len(set(used.tolist())) == len(used)
    assert (out[GAP] >= 0).mean() >= 0.5


def test_a_single_spot_is_followed_for_long_or_not_at_all():
    uv = paths()[:, :1]
    for length in (LONG_CHAIN - 2, LONG_CHAIN + 5):
        every, rows = filmed(uv, np.ones((FRAMES, 1), dtype=bool), 0.0, 7)
        gap = slice(GAP.start, GAP.start + length)
        out, _ = continued(every, without(rows, gap), around(uv))
        assert np.all((out[gap] >= 0) == (length >= LONG_CHAIN))


def test_the_errors_of_a_path_are_of_its_own_labels():
    """Without enough labelled frames nothing is known of a path, and nothing is continued."""
    uv = paths()
    every, rows = filmed(uv, np.ones((FRAMES, 2), dtype=bool), 0.0, 8)
    few = np.full_like(rows, -1)
    few[GAP.start - 2 * MOST_AHEAD : GAP.start] = rows[GAP.start - 2 * MOST_AHEAD : GAP.start]
    out, probability = continued(every, few, around(uv))
    np.testing.assert_array_equal(out, few)
    assert np.isnan(probability).all()
