"""Labels of two spots whose paths are followed together, where each by itself cannot be extrapolated."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.arrays import Array
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from lab.simulate.scenarios import RIGS
from tests.tracking.smoothing.labels.path_recordings import FRAMES, GAP, context, filmed, without
from tracking.smoothing.labels.continuity import pair_labels, transfers_between_cameras

BOTH = np.ones((FRAMES, 2), dtype=bool)


def jerking(seed: int, step_px: float = 12.0) -> Array:
    """Paths (T, 2, 2), px, of two spots: both jump at random from frame to frame; one slowly circles the other."""
    rng = np.random.default_rng([seed, 1])
    k = np.arange(FRAMES)
    one = 500 + np.cumsum(rng.uniform(-step_px, step_px, (FRAMES, 2)), axis=0)
    turn = 0.02 * k + 0.5
    return np.stack([one, one + 90 * np.stack([np.cos(turn), np.sin(turn)], axis=1)], axis=1)


@pytest.mark.parametrize("false_points", [0.0, 1.0])
def test_two_spots_that_jump_together_are_followed(false_points):
    given = 0
    for seed in range(6):
        uv = jerking(seed)
        every, rows = filmed(uv, BOTH, false_points, seed)
        out, probability = pair_labels(every, without(rows, GAP), context(uv, false_points=false_points), {})
        found = out[GAP] >= 0
        assert np.array_equal(out[GAP][found], rows[GAP][found])
        assert np.array_equal(np.isfinite(probability[GAP]), found)
        given += np.count_nonzero(found)
    assert given > 0.95 * 6 * 2 * (GAP.stop - GAP.start)


@pytest.mark.parametrize("hidden", [(0,), (0, 1)])
def test_false_points_are_hardly_ever_the_right_distance_apart(hidden):
    """In each of 20 runs, 50 false points lie near the paths of spots of which one or both are hidden."""
    wrong = 0
    for seed in range(20):
        uv, visible = jerking(seed), BOTH.copy()
        visible[GAP, hidden] = False
        every, rows = filmed(uv, visible, 1.0, seed)
        out, _ = pair_labels(every, without(rows, GAP), context(uv, false_points=1.0), {})
        wrong += np.count_nonzero(out[GAP, hidden] >= 0)
    assert wrong <= 1


def test_a_pair_at_rest_keeps_its_labels():
    uv = np.tile(jerking(1)[:1], (FRAMES, 1, 1))
    uv[:48] += np.linspace(-60, 0, 48)[:, None, None]
    every, rows = filmed(uv, BOTH, 0.0, 2)
    out, _ = pair_labels(every, without(rows, GAP), context(uv), {})
    np.testing.assert_array_equal(out[GAP], rows[GAP])


def test_one_spot_in_two_pictures_is_followed():
    """It jumps at random in both; the second camera sees it turned and half as large."""

    def seen(uv: Array) -> Array:
        return 100 + 0.5 * uv @ np.array([[0.8, 0.6], [-0.6, 0.8]])

    for seed in range(6):
        one = jerking(seed, 20.0)[:, 0]
        uv = np.stack([one, seen(one)], axis=1)
        every, rows = filmed(uv, BOTH, 1.0, seed, (0, 1))
        around = context(uv, false_points=1.0, cameras=(0, 1))
        out, _ = pair_labels(every, without(rows, GAP), around, {(0, 1): seen})
        found = out[GAP] >= 0
        assert np.array_equal(out[GAP][found], rows[GAP][found])
        assert found.mean() > 0.9
        nothing, _ = pair_labels(every, without(rows, GAP), around, {})
        assert np.all(nothing[GAP] < 0)


def test_a_pair_that_the_pose_excludes_is_not_labelled():
    uv = jerking(3)
    every, rows = filmed(uv, BOTH, 0.0, 3)
    out, _ = pair_labels(every, without(rows, GAP), context(uv, sigma_px=2.0), {})
    assert np.all(out[GAP] < 0)


def test_labels_that_exist_are_kept():
    uv = jerking(4)
    every, rows = filmed(uv, BOTH, 0.5, 4)
    before = without(rows, slice(60, 64))
    before[GAP.start : 60, 1] = -1  # of one of the two only
    out, _ = pair_labels(every, before, context(uv, false_points=0.5), {})
    kept = before >= 0
    np.testing.assert_array_equal(out[kept], before[kept])
    np.testing.assert_array_equal(out[60:64], rows[60:64])


def test_the_transfer_between_two_cameras_of_one_screen_agrees_with_the_forward_model():
    rig = RIGS["two-cameras-per-screen"]()
    model = SpotModel.of(rig)
    transfers = transfers_between_cameras(rig, model.views)
    spots = len(rig.spots)
    assert len(transfers) == spots  # each is seen by two cameras
    rng = np.random.default_rng(6)
    for _ in range(3):
        pose = Pose.from_ypr(np.deg2rad(rng.uniform(-4, 4, 3)), rng.uniform(-0.05, 0.05, 3))
        uv = model.project(pose)[0]
        for (a, b), transfer in transfers.items():
            assert model.views[a][1] == model.views[b][1]
            np.testing.assert_allclose(transfer(uv[[a]])[0], uv[b], atol=1e-6)
    unknown = next(iter(transfers.values()))(np.full((2, 2), np.nan))
    assert np.isnan(unknown).all()
