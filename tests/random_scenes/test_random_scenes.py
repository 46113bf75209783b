"""The random scenes are what they claim to be, and their judge sees what is wrong.

No test here depends on how well the tracker does: `python -m bench.random_scenes` measures that.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.random_scenes.__main__ import main
from bench.random_scenes.answers import LOST, MEASURED, Answers, Pass, answers_in_memory, answers_through_files
from bench.random_scenes.drafts import bends_px
from bench.random_scenes.draw.motions import MOTIONS
from bench.random_scenes.draw.vehicles import LEAST_SPOTS
from bench.random_scenes.families import FAMILIES, family_scene
from bench.random_scenes.judge import figures, independent_poses, judge
from bench.random_scenes.oracle import ask_oracle, measured_pixels
from bench.random_scenes.report import summary
from bench.random_scenes.scene import CLUTTER, HIDDEN, OUTSIDE, SHINING, Scene, random_scene
from bench.random_scenes.write_folder import write_run_folder
from geometry.forward_model import SpotModel
from geometry.pose_solver.gauss_newton import fit_pose
from lab.files.run.run_file import load_run
from lab.files.run.truth import load_run_truth
from lab.pictures.picture_file import MissingPicture
from lab.runs.frames.frames import open_frames
from tests.marks import further_slow
from tracking.detections import Detections

FRAMES = 40
SEEDS = range(1, 13)
px = 1.0


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [random_scene(seed, FRAMES) for seed in SEEDS]


def true_answers(scene: Scene) -> Pass:
    """What a tracker says that knows the truth: every shining spot labelled, poses fitted to them."""
    model = SpotModel.of(scene.rig)
    uv = np.stack([measured_pixels(scene, k) for k in range(len(scene))])
    covariance = np.tile(np.eye(6), (len(scene), 1, 1))
    rotation, translation = scene.poses.rotation.copy(), scene.poses.translation.copy()
    for k in range(len(scene)):
        rows = np.flatnonzero(scene.shining[k])
        fit = fit_pose(model, rows, uv[k, rows], scene.sigma_px[rows, None, None] ** 2 * np.eye(2), scene.poses[k])
        if fit is not None and fit.observable:
            rotation[k], translation[k] = fit.world_from_body.rotation, fit.world_from_body.translation
            covariance[k] = fit.covariance
    status = np.full(len(scene), MEASURED)
    return Pass(
        scene.shining.copy(), uv, status, replace(scene.poses, rotation=rotation, translation=translation), covariance
    )


def answers_of(one: Pass) -> Answers:
    return Answers(one, one, 0, (), (), 0, 1.0, 1.0, 1.0, 1)


@pytest.fixture(scope="module")
def easy() -> Scene:
    """A scene without hidden spots, in which truth gives a pose in every frame."""
    return family_scene("uniform", 2, FRAMES)


def test_the_scenes_projection_agrees_with_the_programs(scenes):
    for scene in scenes:
        uv = SpotModel.of(scene.rig).project(scene.poses)[0]
        inside = scene.in_view != OUTSIDE
        np.testing.assert_allclose(scene.uv_px[inside], uv[inside], rtol=0, atol=1e-9 * px)
        np.testing.assert_array_equal(SpotModel.of(scene.rig).in_picture(uv), inside)


def test_the_same_seed_gives_the_same_scene_and_another_one_another(scenes):
    again = random_scene(SEEDS[0], FRAMES)
    np.testing.assert_array_equal(again.uv_px, scenes[0].uv_px)
    for a, b in zip(again.detections, scenes[0].detections, strict=True):
        for x, y in zip(a, b, strict=True):
            np.testing.assert_array_equal(x.uv_px, y.uv_px)
    assert again.text == scenes[0].text
    assert len({scene.text for scene in scenes}) == len(scenes)


def test_each_point_is_its_spots_with_the_stated_noise(scenes):
    whitened = []
    for scene in scenes:
        for k in range(len(scene)):
            uv = measured_pixels(scene, k)
            np.testing.assert_array_equal(~np.isnan(uv[:, 0]), scene.shining[k])
            whitened.append(((uv - scene.uv_px[k]) / scene.sigma_px[:, None])[scene.shining[k]].ravel())
    values = np.concatenate(whitened)
    assert np.mean(values**2) == pytest.approx(1.0, abs=5 * np.sqrt(2 / len(values)))


def test_the_first_frames_show_enough_spots_and_hide_none(scenes):
    for scene in scenes:
        assert not np.any(scene.in_view[:10] == HIDDEN)
        assert scene.has_image[:10].all()
        assert min(len(np.unique(scene.spot_of[row])) for row in scene.shining[:10]) >= LEAST_SPOTS
        assert scene.prior is not None
        assert scene.prior.contains(scene.poses[0])


def test_the_draws_are_wide():
    drawn = [random_scene(seed, FRAMES) for seed in range(100, 140)]
    assert {len(s.rig.beams) for s in drawn} >= {2, 3, 4, 5}
    assert {len(s.rig.cameras) for s in drawn} >= {2, 3, 4}
    assert {len(s.rig.screens) for s in drawn} == {2, 3}
    rates = np.array([s.frame_rate_hz for s in drawn])
    focal = np.array([c.matrix[0, 0] for s in drawn for c in s.rig.cameras.values()])
    noise = np.array([np.median(s.sigma_px) for s in drawn])
    assert rates.min() < 60
    assert rates.max() > 300
    assert focal.min() < 800
    assert focal.max() > 4000
    assert noise.min() < 0.01
    assert noise.max() > 0.15
    assert any((s.in_view == OUTSIDE).any() for s in drawn)
    assert any(not s.has_image.all() for s in drawn)
    assert any(any((o == CLUTTER).any() for o in s.origin[0]) for s in drawn)


@pytest.mark.parametrize("name", MOTIONS)
def test_no_motion_jumps_within_the_first_exposure(name):
    """A picture at time 0 is exposed from before it on."""
    before = np.concatenate([[0.0, 0.01], [-2e-5, -1e-5, 0.0, 1e-5, 2e-5], [1.0]])
    for seed in range(10):
        shape = MOTIONS[name](np.random.default_rng(seed), before).shape[2:-1]
        assert np.abs(np.diff(shape, axis=0)).max() < 0.01


def test_the_oracle_finds_its_own_poses_consistent(scenes):
    nees = np.concatenate([ask_oracle(scene).nees for scene in scenes])
    nees = nees[~np.isnan(nees)]
    assert len(nees) > 200
    assert nees.mean() / 6 == pytest.approx(1.0, abs=5 * np.sqrt(12 / len(nees)) / 6)


def test_the_oracle_leaves_out_what_shows_no_pose(easy):
    assert ask_oracle(easy).counts
    occluded = replace(easy, in_view=np.where(easy.camera_of == 0, HIDDEN, easy.in_view))
    found = tuple((Detections.none(), frame[1]) for frame in easy.detections)
    origin = tuple((np.zeros(0, dtype=np.int64), frame[1]) for frame in easy.origin)
    oracle = ask_oracle(replace(occluded, detections=found, origin=origin))
    assert not oracle.counts
    assert oracle.why_not == "first frames give no pose"


def test_right_answers_are_clean(easy):
    judgement = judge(easy, ask_oracle(easy), answers_of(true_answers(easy)))
    assert judgement.clean, judgement.classes
    assert judgement.smoothed.identity == 1.0
    assert judgement.smoothed.nees / 6 == pytest.approx(1.0, abs=5 * np.sqrt(12 / FRAMES) / 6)


def test_a_swapped_label_is_seen(easy):
    right = true_answers(easy)
    uv = right.uv_px.copy()
    uv[20, [0, 1]] = uv[20, [1, 0]]
    judgement = judge(easy, ask_oracle(easy), answers_of(replace(right, uv_px=uv)))
    assert judgement.smoothed.wrong == 2
    assert "wrong labels" in judgement.classes


def test_a_label_on_a_hidden_spots_clutter_is_seen(easy):
    in_view = easy.in_view.copy()
    in_view[20, 0] = HIDDEN
    points = easy.detections[20][0]
    rows = np.flatnonzero(easy.origin[20][0] == 0)
    moved = points.uv_px.copy()
    moved[rows] += 12.0
    origin = easy.origin[20][0].copy()
    origin[rows] = CLUTTER
    frame = (Detections.at(moved, points.cov_px2), easy.detections[20][1])
    scene = replace(
        easy,
        in_view=in_view,
        detections=(*easy.detections[:20], frame, *easy.detections[21:]),
        origin=(*easy.origin[:20], (origin, easy.origin[20][1]), *easy.origin[21:]),
    )
    right = true_answers(easy)
    uv = right.uv_px.copy()
    uv[20, 0] = moved[rows[0]]
    assert figures(scene, replace(right, uv_px=uv), np.ones(FRAMES, dtype=bool)).wrong == 1


def test_a_confidently_wrong_pose_is_seen(easy):
    right = true_answers(easy)
    sigma = np.sqrt(right.covariance[20, 4, 4])
    moved = right.poses.translation.copy(), right.poses.rotation.copy()
    moved[0][20] = right.poses[20].plus(np.array([0, 0, 0, 0, 20 * sigma, 0])).translation
    moved[1][20] = right.poses[20].plus(np.array([0, 0, 0, 0, 20 * sigma, 0])).rotation
    wrong = replace(right, poses=replace(right.poses, translation=moved[0], rotation=moved[1]))
    judgement = judge(easy, ask_oracle(easy), answers_of(wrong))
    assert judgement.smoothed.wrong_measured == 1
    assert judgement.smoothed.beyond_6 == 1
    assert "confidently wrong measured" in judgement.classes


def test_a_covariance_that_is_none_is_seen(easy):
    right = true_answers(easy)
    covariance = right.covariance.copy()
    covariance[20, 2, 2] *= -1
    judgement = judge(easy, ask_oracle(easy), answers_of(replace(right, covariance=covariance)))
    assert judgement.smoothed.not_definite == 1
    assert not judgement.clean


def test_errors_that_stay_count_as_one_pose_and_white_ones_as_many():
    white = np.random.default_rng(5).normal(size=(400, 6))
    assert independent_poses(white) > 200
    assert independent_poses(np.ones((400, 6))) < 2
    assert 15 < independent_poses(np.repeat(white[:40], 10, axis=0)) < 60


def test_a_pose_that_is_lost_at_once_is_no_lock(easy):
    right = true_answers(easy)
    late = np.where(np.arange(FRAMES) < 5, LOST, MEASURED)
    oracle = ask_oracle(easy)
    assert judge(easy, oracle, answers_of(right)).smoothed.locked_in == 0
    assert judge(easy, oracle, answers_of(replace(right, status=late))).smoothed.locked_in == 5
    flash = np.where(np.arange(FRAMES) == 0, MEASURED, LOST)
    judgement = judge(easy, oracle, answers_of(replace(right, status=flash)))
    assert judgement.smoothed.locked_in == -1
    assert "never locked" in judgement.classes


def test_a_written_run_folder_reads_back_as_the_scene(tmp_path: Path):
    scene = next(s for s in (random_scene(seed, FRAMES) for seed in range(1, 100)) if not s.has_image.all())
    run = load_run(write_run_folder(scene, tmp_path / "run"))
    assert SpotModel.of(run.rig).views == SpotModel.of(scene.rig).views
    uv = SpotModel.of(run.rig).project(scene.poses)[0]
    inside = scene.in_view != OUTSIDE
    np.testing.assert_allclose(uv[inside], scene.uv_px[inside], rtol=0, atol=1e-8 * px)
    assert run.prior is not None
    assert run.prior.contains(scene.poses[0])
    truth = load_run_truth(run)
    assert truth is not None
    assert truth.spots is not None
    assert set(truth.spots.in_view.tolist()) <= {OUTSIDE, SHINING, HIDDEN}
    for k, frames in enumerate(open_frames(run)):
        for c, name in enumerate(scene.rig.cameras):
            picture = frames.images[name]
            assert isinstance(picture, MissingPicture) == (not scene.has_image[k, c])
            if isinstance(picture, Detections):
                assert len(picture) == len(scene.detections[k][c])


def test_in_memory_and_through_files_are_the_same_program(tmp_path: Path):
    scene = random_scene(2, FRAMES)
    memory = answers_in_memory(scene)
    files = answers_through_files(scene, write_run_folder(scene, tmp_path / "run"))
    assert memory.exit_status == files.exit_status
    assert memory.reasons == files.reasons
    np.testing.assert_array_equal(memory.smoothed.status, files.smoothed.status)
    np.testing.assert_array_equal(memory.smoothed.labelled, files.smoothed.labelled)
    np.testing.assert_allclose(memory.smoothed.poses.translation, files.smoothed.poses.translation, rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", further_slow(FAMILIES, fast=5))
def test_each_family_makes_scenes(name):
    scene = family_scene(name, 3)
    assert len(scene) == FAMILIES[name].frames
    assert ask_oracle(scene).counts or name == "camera-gaps"
    np.testing.assert_array_equal(scene.uv_px, family_scene(name, 3).uv_px)


def test_corners_are_as_hard_or_soft_as_their_family_says():
    for name, low, high in (("corners-hard", 1.0, 120.0), ("corners-soft", 0.0, 0.6)):
        for seed in range(4):
            scene = family_scene(name, seed)
            assert low < np.median(bends_px(scene.uv_px, scene.corner_frames)) < high


def test_the_command_prints_a_summary_and_writes_rows(tmp_path: Path, monkeypatch, capsys):
    out = tmp_path / "rows.csv"
    arguments = ["--seeds", "2:3", "--frames", str(FRAMES), "--out", str(out), "--keep", str(tmp_path / "kept")]
    monkeypatch.setattr("sys.argv", ["bench.random_scenes", *arguments])
    main()
    printed = capsys.readouterr().out
    assert "clean: " in printed
    assert len(out.read_text().splitlines()) == 2
    assert (tmp_path / "kept" / "seed-2" / "run.yaml").exists()


def test_a_summary_names_the_classes_and_the_worst_seeds(easy):
    right = true_answers(easy)
    uv = right.uv_px.copy()
    uv[20, [0, 1]] = uv[20, [1, 0]]
    oracle = ask_oracle(easy)
    text = summary([judge(easy, oracle, answers_of(right)), judge(easy, oracle, answers_of(replace(right, uv_px=uv)))])
    assert "clean: 1 of 2 = 50.0%" in text
    assert "wrong labels: 1 | 1" in text
    assert f"seed {easy.seed}: wrong labels" in text
