"""Masks over the frames of a run by what the neighbouring frames show."""

from __future__ import annotations

import numpy as np

from tracking.smoothing.labels.neighbouring_frames import connected, isolated, labelled_once, next_to


def frames(text: str) -> np.ndarray:
    """A mask with one frame per character; x: True."""
    return np.array([c == "x" for c in text])


def test_measured_frames_in_a_row_with_a_confirmed_one_are_connected_to_it():
    np.testing.assert_array_equal(connected(frames("xxx.xx.xx"), frames("..x....x.")), frames("xxx....xx"))


def test_a_confirmed_frame_without_a_measured_pose_is_not_connected():
    assert not connected(frames("...x"), frames("xx..")).any()


def test_the_neighbours_of_a_mask_do_not_include_single_frames_of_it():
    np.testing.assert_array_equal(next_to(frames("x..xx...")), frames(".xxxxx.."))


def test_few_spots_after_a_frame_without_any_are_isolated_unless_the_next_frame_supports_them():
    np.testing.assert_array_equal(isolated(np.array([6, 0, 1, 0, 6])), frames("..x.."))
    np.testing.assert_array_equal(isolated(np.array([6, 0, 1, 6, 6])), frames("..x.."))
    np.testing.assert_array_equal(isolated(np.array([6, 0, 1, 2, 6])), frames("....."))
    np.testing.assert_array_equal(isolated(np.array([6, 0, 3, 6, 6])), frames("....."))


def test_labels_in_each_picture_of_a_slow_camera_are_not_labelled_once():
    """The frames between have no picture of it. A camera of full rate has no label beside a single one."""
    slow, every = np.arange(12) % 3 == 0, np.ones(12, dtype=bool)
    single = np.arange(12) == 6
    labelled = np.column_stack([slow, single, slow, single])
    has_image = np.column_stack([slow, slow, every, every])
    np.testing.assert_array_equal(labelled_once(labelled, has_image), np.column_stack([~every, single, slow, single]))
