"""A camera that is knocked during the recording keeps its labels, and other lights get none."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.arrays import Array, Bools
from tests.tracking.smoothing.labels.path_recordings import FRAMES, filmed
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.labels.neighbouring_frames import MAX_SHIFT_PX, MIN_FRAMES, displaced

KNOCKED = np.arange(FRAMES) >= 60  # (T,)


def paths(spots: int, moving: bool = True) -> Array:
    """Paths (T, n, 2), px, of spots that are not on a grid."""
    k = np.arange(FRAMES, dtype=float) if moving else np.zeros(FRAMES)
    swing = np.stack([400 + 60 * np.sin(0.09 * k), 500 + 30 * np.cos(0.07 * k)], axis=1)
    return swing[:, None] + np.array([[0.0, 0], [130, 20], [90, -160]])[:spots]


def everywhere(spots: int) -> Bools:
    return np.ones((FRAMES, spots), dtype=bool)


@pytest.mark.parametrize(("spots", "shift"), [(2, (0.6, -0.8)), (3, (-9.0, 12.0)), (1, (0.6, -0.8))])
@pytest.mark.parametrize("false_points", [0.0, 0.5])
def test_all_spots_of_a_knocked_camera_are_labelled_and_do_not_contribute_to_the_pose(spots, shift, false_points):
    expected = paths(spots)
    seen = expected + np.where(KNOCKED[:, None, None], shift, 0.0)
    every, rows = filmed(seen, everywhere(spots), false_points, 1)
    before = np.where(KNOCKED[:, None], -1, rows)
    out = displaced(every, before, np.zeros(spots, dtype=np.int64), expected, everywhere(spots))
    np.testing.assert_array_equal(out[~KNOCKED], before[~KNOCKED])
    given = out[KNOCKED] >= 0
    if spots > 1 or false_points == 0:  # a single point among other lights stays open
        assert given.mean() > 0.97
    np.testing.assert_array_equal(out[KNOCKED][given], rows[KNOCKED][given] + BLENDED)


@pytest.mark.parametrize("spots", [1, 2, 3])
def test_false_points_beside_occluded_spots_get_no_labels(spots):
    expected = paths(spots)
    for seed in range(10):
        every, _ = filmed(expected, ~everywhere(spots) | ~KNOCKED[:, None], 1.0, seed)
        labels = np.full((FRAMES, spots), -1)
        visible = everywhere(spots) & KNOCKED[:, None]
        out = displaced(every, labels, np.zeros(spots, dtype=np.int64), expected, visible)
        assert not (out[KNOCKED] >= 0).any()


def test_a_single_point_beside_a_spot_at_rest_may_be_a_reflection():
    expected = paths(1, moving=False)
    every, _ = filmed(expected + 2.0, everywhere(1), 0.0, 1)
    out = displaced(every, np.full((FRAMES, 1), -1), np.zeros(1, dtype=np.int64), expected, everywhere(1))
    assert not (out >= 0).any()


@pytest.mark.parametrize(("frames", "shift_px"), [(MIN_FRAMES - 1, 2.0), (60, MAX_SHIFT_PX + 1)])
def test_short_or_large_displacements_get_no_labels(frames, shift_px):
    expected = paths(3)
    short = (np.arange(FRAMES) >= 60) & (np.arange(FRAMES) < 60 + frames)
    every, rows = filmed(expected + np.where(short[:, None, None], (shift_px, 0.0), 0.0), everywhere(3), 0.0, 1)
    before = np.where(short[:, None], -1, rows)
    out = displaced(every, before, np.zeros(3, dtype=np.int64), expected, everywhere(3))
    np.testing.assert_array_equal(out, before)
