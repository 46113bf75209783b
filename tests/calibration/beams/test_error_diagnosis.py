"""Diagnosis of recordings with one common mistake; other inconsistent recordings have no diagnosis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.beams.error_diagnosis import diagnose_error, swap_views
from geometry.pose import Pose
from lab.simulate.scenarios import RIGS
from tests.calibration.beams.bench import drawn, positions, recorded, unknown_place

RIG = RIGS["unequal-fan"]()
POSES = positions(np.random.default_rng(1), 20)
SPOTS = recorded(np.random.default_rng(2), RIG, POSES)
DRAWN = drawn(RIG, np.random.default_rng(3), 0.005, 0.003)


@pytest.mark.parametrize(
    ("written", "words"),
    [
        (Pose.from_quaternion(np.roll(POSES.quaternion_wxyz, -1, axis=1), POSES.translation), "the order x, y, z, w"),
        pytest.param(POSES.inverse(), "inverted", marks=pytest.mark.slow),
        pytest.param(
            Pose(np.swapaxes(POSES.rotation, 1, 2), POSES.translation),
            "their rotations inverted",
            marks=pytest.mark.slow,
        ),
        pytest.param(Pose(POSES.rotation, 1e3 * POSES.translation), "millimetres were written", marks=pytest.mark.slow),
        (POSES[np.roll(np.arange(20), 3)], "3 rows below"),
        pytest.param(POSES[np.roll(np.arange(20), -1)], "1 row above", marks=pytest.mark.slow),
    ],
)
def test_a_common_mistake_in_the_stands_record_is_identified(written, words):
    found = diagnose_error(DRAWN, SPOTS, unknown_place(written))
    assert found is not None
    assert words in found.words
    assert not found.in_labels


def test_two_labels_exchanged_in_all_pictures_are_identified():
    mixed = swap_views(SPOTS, 0, 2)
    found = diagnose_error(DRAWN, mixed, unknown_place(POSES))
    assert found is not None
    assert found.in_labels
    (camera, first), (_, second) = RIG.views()[0], RIG.views()[2]
    assert found.words == f"with the labels {first} and {second} of camera {camera!r} exchanged everywhere"


def test_shuffled_positions_have_no_diagnosis():
    order = np.random.default_rng(5).permutation(20)
    assert diagnose_error(DRAWN, SPOTS, unknown_place(POSES[order])) is None


def test_random_spots_have_no_diagnosis():
    noise = np.random.default_rng(6).uniform(100, 900, SPOTS.pixels.shape)
    assert diagnose_error(DRAWN, replace(SPOTS, pixels=noise), unknown_place(POSES)) is None
