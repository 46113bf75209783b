"""A rig that is symmetric within its stated sigmas: what this hides is reported, and nothing of other rigs is."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench import refine as bench
from bench.mistakes.mistakes import read, write
from calibration.model_check.linearised_frames import ModelCheckRecording
from geometry.arrays import Array
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from lab.calibrate.refine.refine import refine_rig
from lab.errors import CalibrationError
from lab.files.rig.rig_file import RigFile, covariance_blocks, save_rig
from lab.files.run.run_file import load_run
from lab.findings.finding import Level
from lab.runs.model_check.symmetry import Recorded
from lab.runs.process import process_run
from lab.simulate.scenarios import four_skew_beams, unequal_fan
from lab.simulate.write import simulate
from tests.marks import further_slow
from tracking.parameters import LabelParameters

MIRROR_SIGMAS = bench.Sigmas((3e-3, 1.7e-3), (2e-3, 1e-3), (1e-3, 1e-3), clocks=0.0)
SIGMAS = bench.Sigmas((3e-3, 2e-3), (2e-3, 1e-3), (1e-3, 1e-3), clocks=0.0)
EXCHANGED = "the pictures of cameras `left` and `right` are exchanged, or they have each other's place"
PRIOR = PosePrior(Pose.from_ypr(np.deg2rad([12.0, 5.0, 3.0]), np.array([0.1, 0.05, 0.02])), 0.5, float(np.deg2rad(40)))
NARROW = replace(PRIOR, within_rad=float(np.deg2rad(5)))


def off(true: Rig) -> Rig:
    return bench.drawn_rig(np.random.default_rng(1), true, SIGMAS)


def recorded(true: Rig, prior: PosePrior, wrong: tuple[int, ...] = ()) -> Recorded:
    """As labelled with a rig that is off. wrong: frames with a wrong label."""
    t = np.linspace(0, 1, 30)[:, None]
    way: Array = np.sin(2 * np.pi * t * np.arange(1, 7) / 2) * np.repeat([0.05, 0.05], 3)
    poses = prior.centre.plus(way)
    model, known = SpotModel.of(true), off(true)
    uv = model.project(poses)[0] + np.random.default_rng(2).normal(0, 0.1, (30, len(model), 2))
    for k in wrong:
        uv[k, 0] += 15.0
    recording = ModelCheckRecording(
        t[:, 0], model.in_picture(uv), uv, np.broadcast_to(0.01 * np.eye(2), (*uv.shape, 2)), poses
    )
    return Recorded.of(known, bench.rig_covariance(known, SIGMAS), prior, LabelParameters(), recording)


@pytest.mark.parametrize(
    ("true", "prior", "wrong", "words"),
    [
        (unequal_fan(), PRIOR, (), [EXCHANGED]),
        (unequal_fan(), PRIOR, (7, 20), [EXCHANGED]),
        (unequal_fan(), NARROW, (), []),
        (four_skew_beams(), PRIOR, (), []),
    ],
)
def test_only_a_symmetric_rig_and_a_wide_prior_hide_exchanged_cameras(true, prior, wrong, words):
    assert [one.mistake.what for one, _ in recorded(true, prior, wrong).hidden()] == words


def test_a_rest_shows_too_little_of_a_rig_for_a_statement():
    given = recorded(unequal_fan(), PRIOR)
    still = replace(given.recording.at(np.zeros(30, dtype=int)), t_s=given.recording.t_s)
    assert not list(replace(given, recording=still).hidden(least=10))


def test_a_camera_without_labels_says_nothing_about_its_pictures(try_only):
    try_only("`third`")
    lab, scenes, _ = bench.campaign(78422, 60, 1)
    recording, model = bench.with_true_labels(scenes[0]), SpotModel.of(lab.rig)
    without = replace(recording, seen=recording.seen & (model.camera_of != model.camera_names.index("third")))
    covariance = bench.rig_covariance(lab.rig, bench.Sigmas(clocks=0.0))
    assert not list(Recorded.of(lab.rig, covariance, scenes[0].prior, LabelParameters(), without).hidden())


def exchanged(folder: Path, *, truth: bool) -> Path:
    """A recording whose rig.yaml is off by its sigmas, and has the cameras in each other's place."""
    run = simulate("unequal-fan", folder / "run", seed=3, frames=60, points=True, clutter=0.0)
    if not truth:
        shutil.rmtree(run / "truth")
    true = load_run(run).rig
    places = {
        a: replace(true.cameras[a], camera_from_world=true.cameras[b].camera_from_world, screen=true.cameras[b].screen)
        for a, b in (("left", "right"), ("right", "left"))
    }
    known = off(replace(true, cameras={**true.cameras, **places}))
    save_rig(RigFile(known, covariance_blocks(bench.rig_covariance(known, SIGMAS))), run / "rig.yaml")
    return run


@pytest.mark.parametrize(("truth", "level", "code"), [(False, Level.WARN, "BP-M10"), (True, Level.FAIL, "BP-M06")])
def test_a_refinement_does_not_absorb_exchanged_cameras_of_a_symmetric_rig(tmp_path, try_only, truth, level, code):
    try_only("^exchanged")
    run = exchanged(tmp_path, truth=truth)
    outcome = refine_rig([run], run / "rig.yaml", tmp_path / "new")
    assert outcome.level is level
    assert [f.code for f in outcome.findings if EXCHANGED in f.what] == [code]
    assert (tmp_path / "new" / "rig.yaml").exists() is not truth


def test_a_run_whose_rig_has_a_covariance_reports_what_it_hides(tmp_path, try_only):
    try_only("^exchanged")
    verdict = process_run(exchanged(tmp_path, truth=False), tmp_path / "out").verdict
    assert [f.code for f in verdict.findings] == ["BP-M10"]
    assert EXCHANGED in verdict.texts[0]


@pytest.mark.parametrize(
    ("seed", "names", "words"),
    further_slow([(9121, ["left"], "camera `left`"), (9121, ["left", "right"], "all cameras")]),
)
def test_mirrored_pictures_are_named_although_other_labels_give_poses(tmp_path, seed, names, words):
    """Too few of these poses were determined, or none explained the recording: refused without the reason, or a FAIL.

    Pictures of both cameras were twice as large, as far as the search knew.
    """
    run = simulate("smooth", tmp_path / "run", seed=seed, frames=60, points=True, clutter=0.0)
    shutil.rmtree(run / "truth")
    known = bench.drawn_rig(np.random.default_rng([seed, 7]), load_run(run).rig, MIRROR_SIGMAS)
    save_rig(RigFile(known, covariance_blocks(bench.rig_covariance(known, MIRROR_SIGMAS))), run / "rig.yaml")
    files = read(run)
    for name in names:
        files.pixels(name, lambda uv, size: [size[0] - 1, 0] + uv * [-1, 1])
    mirrored = write(files, tmp_path / "mirrored")
    with pytest.raises(CalibrationError, match=f"the pictures of {words} are mirrored left to right"):
        refine_rig([mirrored], mirrored / "rig.yaml", tmp_path / "new")
