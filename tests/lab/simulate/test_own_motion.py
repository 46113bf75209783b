"""Recordings of a rig of one's own: the motion goes to where the rig sees the vehicle, or along stated poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.visibility import middle_of_view
from geometry.rig import Beam, Rig
from lab.errors import InputError
from lab.files.rig.rig_file import load_rig, save_rig
from lab.files.run.run_file import load_run
from lab.files.run.truth import load_truth
from lab.setup.init import Layout, rig_of
from lab.simulate.scenarios import RIGS
from lab.simulate.write import simulate
from tests.lab.simulate.test_write import files_of

RIGS_ELSEWHERE = [*RIGS, *(f"{c} cameras, {s} screens, {b} beams" for c, s, b in ((1, 1, 3), (3, 3, 4), (4, 2, 5)))]


def elsewhere(name: str, seed: int) -> Rig:
    """A rig in another place, with another body frame."""
    rng = np.random.default_rng(seed)
    if name in RIGS:
        rig = RIGS[name]()
    else:
        cameras, screens, beams = (int(word.split()[0]) for word in name.split(","))
        rig = rig_of(Layout(cameras, screens, beams))
    world = Pose.from_quaternion(rng.normal(size=4), rng.uniform(-30, 30, 3))
    body = Pose.from_quaternion(rng.normal(size=4), rng.uniform(-0.2, 0.2, 3))
    return Rig(
        {n: replace(s, world_from_screen=world @ s.world_from_screen) for n, s in rig.screens.items()},
        {n: replace(c, camera_from_world=c.camera_from_world @ world.inverse()) for n, c in rig.cameras.items()},
        {n: Beam(n, body.turn(b.direction), body.apply(b.point)) for n, b in rig.beams.items()},
        rig.spots,
    )


@pytest.mark.parametrize("name", RIGS_ELSEWHERE)
def test_a_rig_sees_all_its_spots_at_the_middle_of_its_view_wherever_it_stands(name):
    rig = elsewhere(name, seed=len(name))
    model = SpotModel.of(rig)
    seen = model.in_picture(model.project(middle_of_view(rig))[0])
    assert {model.spot_names[i] for i in model.spot_of[seen]} == set(rig.spots)


@pytest.mark.parametrize(
    ("name", "scenario"),
    [
        pytest.param(name, scenario, marks=pytest.mark.slow if (i + k) % 2 else ())  # every rig, both scenarios
        for i, name in enumerate(RIGS_ELSEWHERE)
        for k, scenario in enumerate(("small-motion", "sharp-turns"))
    ],
)
def test_a_scenario_is_recorded_by_a_rig_that_stands_elsewhere(name, scenario, tmp_path):
    save_rig(elsewhere(name, seed=3), tmp_path / "own.yaml")
    folder = simulate(scenario, tmp_path / "run", frames=40, points=True, rig=tmp_path / "own.yaml", clutter=0)
    truth = load_truth(folder)
    in_view = truth.spots.in_view.reshape(40, -1)
    assert in_view[0].all()
    assert (in_view > 0).sum(axis=1).min() >= 3
    prior = load_run(folder).prior
    assert prior.contains(Pose.from_quaternion(truth.pose.quaternion_wxyz[0], truth.pose.position_m[0]))


@pytest.mark.parametrize("name", ["smooth", "four-skew-beams"])
def test_a_rig_that_allows_the_scenario_as_it_is_keeps_it(name, tmp_path):
    own = simulate(name, tmp_path / "own", seed=4, frames=5, points=True)
    again = simulate(name, tmp_path / "again", seed=4, frames=5, points=True, rig=own / "rig.yaml")
    one, two = files_of(own), files_of(again)
    del one["rig.yaml"], two["rig.yaml"]  # directions are scaled to length 1 once more
    assert one == two


def poses(path: Path, translation, degrees, rate_hz: float = 50.0) -> Path:
    pose = Pose.from_ypr(np.deg2rad(degrees), translation)
    rows = [
        ",".join(map(repr, (k, k / rate_hz + 7.0, *map(float, p), *map(float, q))))
        for k, (p, q) in enumerate(zip(pose.translation, pose.quaternion_wxyz, strict=True))
    ]
    path.write_text("\n".join(["frame,t_s,x_m,y_m,z_m,qw,qx,qy,qz", *rows, ""]))
    return path


def test_a_recording_along_a_trajectory_has_its_poses_its_rate_and_its_length(tmp_path):
    t = np.linspace(0, 1, 41)
    table = poses(
        tmp_path / "mine.csv",
        np.stack([0.1 * t, 0.05 * np.sin(9 * t), 0 * t], -1),
        np.stack([9 * t, 4 * t, -5 * t], -1),
    )
    folder = simulate("clean", tmp_path / "run", points=True, trajectory=table)
    truth, stated = load_truth(folder).pose, np.loadtxt(table, delimiter=",", skiprows=1)
    assert load_run(folder).frame_rate_hz == pytest.approx(50.0)
    np.testing.assert_allclose(truth.position_m, stated[:, 2:5], rtol=0, atol=1e-11)
    np.testing.assert_allclose(np.abs(np.sum(truth.quaternion_wxyz * stated[:, 5:], axis=1)), 1.0, rtol=0, atol=1e-11)
    twice = simulate("clean", tmp_path / "twice", points=True, trajectory=table, rate_hz=100.0)
    assert len(load_truth(twice).pose.frame) == 81


def test_a_trajectory_that_leaves_the_view_says_when_and_which_spot(tmp_path):
    t = np.linspace(0, 1, 21)
    table = poses(tmp_path / "away.csv", np.zeros((21, 3)), np.stack([60 * t, 0 * t, 0 * t], -1))
    lines: list[str] = []
    simulate("clean", tmp_path / "run", points=True, trajectory=table, note=lines.append)
    assert lines
    truth = load_truth(tmp_path / "run").spots
    rig = load_rig(tmp_path / "run" / "rig.yaml")
    for line in lines:
        spot = line.split(":")[0].removeprefix("spot ")
        of_spot = np.array([rig_spot == spot for rig_spot in np.array(list(rig.spots))[truth.spot.codes]])
        by_frame = np.array([truth.in_view[of_spot & (truth.frame == k)].any() for k in range(21)])
        assert f"out of view in frame {int(np.argmin(by_frame))} " in line


def test_a_camera_whose_screen_no_beam_meets_shows_an_empty_picture(tmp_path):
    turns = [0.0, 45.0, 90.0, 135.0]
    table = poses(tmp_path / "away.csv", np.zeros((4, 3)), np.stack([turns, [0.0] * 4, [0.0] * 4], -1))
    folder = simulate("clean", tmp_path / "run", scale=0.25, trajectory=table)
    lit = [
        {int(cv2.imread(str(p), cv2.IMREAD_UNCHANGED).max()) > 60 for p in folder.rglob(f"*{k:04d}.png")}
        for k in range(4)
    ]
    assert (lit[0], lit[2]) == ({True}, {False})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"start": Pose(np.eye(3), np.array([50.0, 0, 0]))}, "expected 3 spots or more in view at .50, 0, 0. m"),
        ({"exposure_s": 0.5}, "exposure: expected a time above 0, up to 0.01 s"),
    ],
)
def test_what_cannot_be_simulated_is_one_line(change, words, tmp_path):
    with pytest.raises(InputError, match=words):
        simulate("clean", tmp_path / "run", frames=3, points=True, **change)


def test_a_trajectory_nobody_sees_says_where_the_rig_sees_the_vehicle(tmp_path):
    table = poses(tmp_path / "far.csv", np.full((5, 3), 90.0), np.zeros((5, 3)))
    with pytest.raises(InputError, match=r"far.csv: no spot is in any picture .* at \(0, 0, 0\) m"):
        simulate("clean", tmp_path / "run", points=True, trajectory=table)
