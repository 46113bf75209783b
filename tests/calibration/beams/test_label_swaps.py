"""Labels exchanged in one picture are distinguished from outliers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.beams.beams import calibrate_beams
from lab.calibrate.beams.beams_page import beam_findings
from lab.findings.finding import Level
from lab.simulate.scenarios import RIGS
from tests.calibration.beams.bench import drawn, exact, positions, recorded

RIG = RIGS["unequal-fan"]()
RNG = np.random.default_rng(1)
POSES = positions(RNG, 12)
SPOTS = recorded(RNG, RIG, POSES)
DRAWN = drawn(RIG, RNG, 0.005, 0.003)


def findings_of(spots, poses=POSES):
    names = [f"P{k}" for k in range(len(poses.translation))]
    return beam_findings(calibrate_beams(DRAWN, spots, exact(poses)), DRAWN, names)


def test_two_labels_exchanged_at_one_position_are_identified():
    (i,) = np.flatnonzero((SPOTS.position == 4) & (SPOTS.view == 0))
    (j,) = np.flatnonzero((SPOTS.position == 4) & (SPOTS.view == 1))
    view = SPOTS.view.copy()
    view[i], view[j] = view[j], view[i]
    (camera, first), (_, second) = RIG.views()[0], RIG.views()[1]
    found = {f.what: f.level for f in findings_of(replace(SPOTS, view=view))}
    assert found[f"position P4: spots {second} and {first} of camera {camera!r} are exchanged"] == Level.WARN


def test_two_outliers_of_one_picture_are_not_exchanged_labels():
    pixels = SPOTS.pixels.copy()
    pixels[(SPOTS.position == 4) & (SPOTS.view < 2)] += 30.0
    found = findings_of(replace(SPOTS, pixels=pixels))
    assert any(f.what.startswith("2 of ") for f in found)
    assert not any("exchanged" in f.what for f in found)


def test_fewer_than_8_positions_fail():
    few = findings_of(SPOTS.pick(SPOTS.position < 7), POSES[np.arange(7)])
    assert any(f.level == Level.FAIL and f.what.startswith("only 7 positions, expected 8") for f in few)
    enough = findings_of(SPOTS.pick(SPOTS.position < 8), POSES[np.arange(8)])
    assert not any(f.level == Level.FAIL for f in enough)
