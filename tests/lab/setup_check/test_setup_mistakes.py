"""The usual mistakes of setting up are named by `check` or `run`, on files; a correct set-up raises no alarm."""

from __future__ import annotations

import json
import pickle
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
import yaml

from bench import refine as bench
from bench.mistakes.mistakes import CASES, read, turned_aside, write
from bench.mistakes.recordings import calibrated
from bench.random_scenes.scene import random_scene
from bench.random_scenes.write_folder import write_run_folder
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.rig import Beam, Rig
from geometry.rotations import matrix_from_quaternion, quaternion_from_matrix
from lab.calibrate.camera.photos import _frames
from lab.files.project.project import Cloud
from lab.files.rig.rig_file import save_rig
from lab.files.run.run_file import load_run
from lab.pictures.source import pictures, video_at
from lab.runs import setup_check
from lab.runs.frames.pipeline import Pipeline
from lab.runs.input_check import check
from lab.runs.process import process_run
from lab.runs.setup_check import SampledFrames, compared_with_mistakes, frames_of
from lab.simulate.scenarios import fan, unequal_fan
from lab.simulate.write import simulate
from tests.lab.command import typed
from tests.lab.run_folders import edit, write_run
from tests.marks import further_slow
from tracking.detections import Detections
from tracking.parameters import LabelParameters
from tracking.setup_mistakes.evidence import MOST_POINTS, MOST_TRIPLES, Comparison, Frames, compare, invisible_mistakes
from tracking.setup_mistakes.possible import possible_mistakes

FRAMES = 45
CASE = {case.name: case for case in CASES}


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """Points of a rig whose cameras differ as calibrated ones do; its truth is kept elsewhere."""
    folder = tmp_path_factory.mktemp("recording")
    save_rig(calibrated(unequal_fan(), 1), folder / "rig.yaml")
    run = simulate("huo2015", folder / "run", seed=1, frames=FRAMES, points=True, rig=folder / "rig.yaml")
    (run / "truth").rename(folder / "truth")
    return run


@pytest.fixture(scope="module")
def symmetric(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("symmetric")
    save_rig(fan(), folder / "rig.yaml")
    return simulate("huo2015", folder / "run", seed=1, frames=FRAMES, points=True, rig=folder / "rig.yaml")


@pytest.fixture
def compared_once(monkeypatch) -> dict[bytes, Comparison]:
    """A run and a check of one recording compare the same frames with the same mistakes: once, which takes seconds."""
    known: dict[bytes, Comparison] = {}

    def once(*inputs) -> Comparison:
        key = pickle.dumps(inputs)
        if key not in known:
            known[key] = compare(*inputs)
        return known[key]

    monkeypatch.setattr(setup_check, "compare", once)
    return known


def with_mistake(name: str, run: Path, out: Path) -> Path:
    files = read(run)
    CASE[name].make(files)
    return write(files, out)


def checked(path: Path) -> tuple[str, int]:
    result = check(path)
    return "\n".join(result.lines), result.exit_status


def far_away(rig: Rig, offset_m: float) -> Rig:
    """The rig in a world whose origin is so far away, as in a national grid."""
    moved = Pose(np.eye(3), np.full(3, offset_m))
    cameras = {n: replace(c, camera_from_world=c.camera_from_world @ moved.inverse()) for n, c in rig.cameras.items()}
    screens = {n: replace(s, world_from_screen=moved @ s.world_from_screen) for n, s in rig.screens.items()}
    return replace(rig, cameras=cameras, screens=screens)


def in_millimetres(rig: Rig, cameras: tuple[str, ...], screens: tuple[str, ...]) -> Rig:
    def mm(pose: Pose) -> Pose:
        return Pose(pose.rotation, 1000 * pose.translation)

    changed = {n: replace(rig.cameras[n], camera_from_world=mm(rig.cameras[n].camera_from_world)) for n in cameras}
    others = {n: replace(rig.screens[n], world_from_screen=mm(rig.screens[n].world_from_screen)) for n in screens}
    return replace(rig, cameras={**rig.cameras, **changed}, screens={**rig.screens, **others})


def with_sizes(rig: Rig, **sizes: tuple[float, float]) -> Rig:
    return replace(rig, screens={**rig.screens, **{n: replace(rig.screens[n], size_m=s) for n, s in sizes.items()}})


@pytest.mark.parametrize(
    ("rig", "words"),
    [
        (unequal_fan(), []),
        (with_sizes(unequal_fan(), left=(40.0, 30.0)), []),
        (with_sizes(unequal_fan(), left=(4000.0, 3000.0)), ["size_m of `left`"]),
        (
            with_sizes(in_millimetres(unequal_fan(), (), ("left", "right")), left=(4000.0, 3000.0)),
            ["world_from_screen of `left`, `right` and size_m of `left`"],
        ),
        (far_away(unequal_fan(), 4e6), []),
        (in_millimetres(unequal_fan(), ("left",), ()), ["camera_from_world of `left`"]),
        (in_millimetres(unequal_fan(), ("left", "right"), ()), ["camera_from_world of `left`, `right`"]),
        (in_millimetres(unequal_fan(), (), ("left", "right")), ["world_from_screen of `left`, `right`"]),
        (
            in_millimetres(unequal_fan(), ("left", "right"), ("left", "right")),
            ["camera_from_world of `left`, `right` and world_from_screen of `left`, `right`"],
        ),
    ],
)
def test_lengths_in_millimetres_show_by_themselves_wherever_the_world_has_its_origin(rig, words):
    found = [m.what for m in possible_mistakes(rig) if m.by_itself]
    assert found == [f"the lengths of {w} are in millimetres" for w in words]


def test_a_correct_set_up_is_fine(recording):
    text, status = checked(recording)
    assert status == 0
    assert text.splitlines()[0].endswith(": fine")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("two cameras' names exchanged", "the pictures of cameras `left` and `right` are exchanged"),
        ("mirrored left-right", "the pictures of camera `left` are mirrored left to right"),
        ("turned by 90 deg", "the pictures of camera `right` are turned by 90 deg clockwise"),
        ("half resolution, all cameras", "the pictures of all cameras have half the resolution"),
        ("camera_from_world inverted, one", "camera_from_world of camera `left` is world_from_camera: the inverse"),
        ("xyzw quaternions, all", "in the order x, y, z, w"),
        ("two lenses exchanged", "cameras `left` and `right` have each other's lens"),
        ("two cameras' places exchanged", "cameras `left` and `right` have each other's place"),
        ("numbered from 1, another camera", "numbers one too"),
        ("fx in millimetres", "fx, fy of `left` (5.677) are in millimetres"),
        ("millimetres, one camera", "the lengths of camera_from_world of `left` are in millimetres"),
        ("prior in millimetres", "prior: position_m or within_m is in millimetres"),
        ("prior in radians", "prior: yaw_pitch_roll_deg and within_deg are in radians"),
    ],
)
def test_a_mistake_that_the_recording_shows_is_a_problem_at_check(recording, tmp_path, try_only, name, words):
    try_only(re.escape(words))
    text, status = checked(with_mistake(name, recording, tmp_path / "run"))
    assert status == 2
    assert words in text
    assert "(BP-M06)" in text


@pytest.mark.parametrize(
    "turn", further_slow([np.diag([-1.0, 1.0]), np.eye(2)[::-1], np.diag([1.0, -1.0]), -np.eye(2)], fast=2)
)
def test_pictures_of_all_cameras_turned_or_mirrored_alike_are_distinguished(recording, try_only, turn):
    try_only("^turned")
    run, frames = load_run(recording), SampledFrames()
    for number, found in Pipeline.of(run).detections():
        named = dict(zip(run.rig.cameras, found, strict=True))
        frames.add(number, {n: replace(d, uv_px=changed(run.rig.cameras[n], turn, d.uv_px)) for n, d in named.items()})
    compared = compared_with_mistakes(run, frames.blocks)
    assert [np.array_equal(c.turn, turn) for m, _ in compared.found for c in m.pictures.values()] == [True, True]


def changed(camera: Camera, turn: Array, uv_px: Array) -> Array:
    """As recorded: about the middle of the picture."""
    middle = (np.array(camera.image_size_px) - 1) / 2
    return (uv_px - middle) @ turn + (middle if turn[0, 0] else middle[::-1])


@pytest.mark.parametrize("name", [None, "numbered from 1, another camera"])
def test_wrong_numbers_show_although_a_turntable_moves_in_few_frames_only(recording, tmp_path, try_only, name):
    try_only("^numbers")
    files, rest = read(recording), 40
    pose_of = [0] * rest + [3, 6, 9] + [12] * rest + [15, 18, 21] + [24] * rest  # frame of the recording
    at = {n: [row for row in files.rows if row["frame"] == str(n)] for n in set(pose_of)}
    files.rows = [{**row, "frame": str(k)} for k, n in enumerate(pose_of) for row in at[n]]
    if name is not None:
        CASE[name].make(files)
    text, status = checked(write(files, tmp_path / "run"))
    assert (status, "numbers one too" in text) == ((0, False) if name is None else (2, True))


@pytest.mark.parametrize("name", further_slow(["turned by 180 deg", "numbered from 1, one camera"]))
def test_a_mistake_fails_the_run_and_is_its_only_explanation(recording, tmp_path, name):
    outcome = process_run(with_mistake(name, recording, tmp_path / "run"), tmp_path / "out")
    assert outcome.exit_status == 4
    codes = [r.as_mapping()["code"] for r in outcome.verdict.findings]
    assert codes.count("BP-M06") == 1
    assert codes[0] == "BP-M06"  # before what follows from it, such as an ambiguous first frame
    assert outcome.verdict.findings[0].remedy.split(". ")[0].rstrip(".") in outcome.line()
    assert "BP-M01" not in codes  # the deviations of a rig with a mistake are its consequences


def test_a_mistake_that_symmetry_hides_is_a_remark_with_the_measurement_that_shows_it(symmetric, tmp_path):
    run = with_mistake("two cameras' names exchanged", symmetric, tmp_path / "run")
    text, status = checked(run)
    assert status == 0
    assert "no recording with this rig would show, because it is symmetric, that the pictures of cameras" in text
    assert "cover the lens of one camera for some frames" in text
    verdict = process_run(run, tmp_path / "out").verdict
    assert [f.code for f in verdict.findings] == ["BP-M10"]
    assert (
        "the recording does not show whether the pictures of cameras `left` and `right` are exchanged"
        in (verdict.texts[0])
    )


@pytest.mark.parametrize(
    ("first_m", "within_m", "codes"),
    [
        (0.3, 1.0, ["BP-M10"]),
        (0.3, 0.2, []),  # the other first pose is outside
        (0.0, 0.2, ["BP-M10"]),  # on the axis of symmetry: the first pose is the same, the others are not
    ],
)
def test_only_a_prior_that_excludes_the_other_first_pose_shows_what_symmetry_hides(
    symmetric, tmp_path, first_m, within_m, codes
):
    files, model, rng = read(symmetric), SpotModel.of(fan()), np.random.default_rng(0)
    files.run["prior"] = {
        "position_m": [first_m, 0, 0], "yaw_pitch_roll_deg": [0, 0, 0], "within_m": within_m, "within_deg": 20.0
    }  # fmt: skip
    usual, files.rows = files.rows[0], []
    for k in range(30):
        pose = Pose.from_ypr(np.deg2rad([0.5 * k, 0.2 * k, 0]), np.array([first_m + 0.004 * k, 0.003 * k, 0]))
        pixels = model.project(pose)[0] + rng.normal(0, 0.1, (len(model), 2))
        for c, (u, v) in zip(model.camera_of, pixels, strict=True):
            camera = model.camera_names[c]
            files.rows.append({**usual, "frame": str(k), "camera": camera, "u_px": str(u), "v_px": str(v)})
    outcome = process_run(write(files, tmp_path / "run"), tmp_path / "out")
    assert [f.code for f in outcome.verdict.findings] == codes


def test_poses_that_contradict_the_truth_fail_the_run(symmetric, tmp_path):
    run = with_mistake("two cameras' names exchanged", symmetric, tmp_path / "run")
    shutil.copytree(symmetric / "truth", run / "truth")
    outcome = process_run(run, tmp_path / "out")
    assert outcome.exit_status == 4
    assert [r.as_mapping()["code"] for r in outcome.verdict.findings] == ["BP-V20"]
    assert "contradict the truth of the run by more than 10 of their sigmas" in outcome.line()


def test_poses_that_agree_with_the_truth_pass(symmetric, tmp_path):
    assert process_run(symmetric, tmp_path / "out").verdict.status == "pass"
    assert (
        "no recording with this rig would show" not in checked(symmetric)[0]
    )  # the truth would show what symmetry hides


@pytest.mark.slow
def test_poses_that_the_limited_search_misses_in_a_crowd_are_no_evidence_for_a_mistake(try_only):
    scene = random_scene(50025)  # 13 points per picture, of which 6 are spots
    pictures = SampledFrames()
    for k in range(len(scene)):
        pictures.add(k, dict(zip(scene.rig.cameras, scene.found(k), strict=True)))
    frames = frames_of(pictures.blocks, scene.prior, LabelParameters().min_spots)
    try_only("^numbers", always=True)
    limited = LabelParameters(max_points=MOST_POINTS, max_triples=MOST_TRIPLES)
    assert not compare(scene.known_rig, frames, limited, scene.covariance).given.is_certain
    found = compare(scene.known_rig, frames, LabelParameters(), scene.covariance)
    assert not found.found


@pytest.mark.parametrize(("seed", "camera"), further_slow([(5113, "left1"), (6113, "left")]))
def test_turned_pictures_are_named_although_spots_are_hidden_or_few(try_only, seed, camera):
    """6113: half of the spots of another camera are hidden. 5113: six frames with four spots are no evidence.

    Inverted transforms of the camera explain them as well as leaving it out does: no point of it has a label.
    """
    scene, pictures = random_scene(seed, 40), SampledFrames()
    end = np.array(scene.rig.cameras[camera].image_size_px) - 1
    for k in range(len(scene)):
        found = dict(zip(scene.rig.cameras, scene.found(k), strict=True))
        pictures.add(k, found | {camera: replace(found[camera], uv_px=end - found[camera].uv_px)})
    frames = frames_of(pictures.blocks, scene.prior, LabelParameters().min_spots)
    try_only(f"camera `{camera}`", always=True)
    found = compare(scene.known_rig, frames, LabelParameters(), scene.covariance).found
    assert [m.what for m, _ in found] == [f"the pictures of camera `{camera}` are turned by 180 deg"]


@pytest.mark.parametrize(("hidden", "before"), [((1, 2, 3), True), ((1, 7, 8, 9), False)])
def test_hidden_spots_of_a_vehicle_at_rest_are_no_wrong_numbers(try_only, hidden, before):
    """The spot of camera `left` is missing in some frames, and not in the picture after.

    before: nor in the picture before, so that either number explains the frame. Otherwise only one of the first six
    frames looks wrongly numbered.
    """
    try_only("^numbers")
    scene, rng, blocks = random_scene(68015), np.random.default_rng(0), []
    model = SpotModel.of(scene.known_rig)
    pixels = model.project(scene.poses[0])[0]
    for k in range(12):
        shown = [before or k not in hidden, k not in hidden, True]
        blocks.append([])
        for left in shown:
            points = {}
            for c, (name, camera) in enumerate(scene.known_rig.cameras.items()):
                mine = pixels[(model.camera_of == c) & model.in_picture(pixels) & (left or name != "left")]
                false = rng.uniform(0, camera.image_size_px, (2, 2))
                uv = np.concatenate([mine + rng.normal(0, 0.01, mine.shape), false])
                points[name] = Detections.at(uv, np.tile(1e-4 * np.eye(2), (len(uv), 1, 1)))
            blocks[-1].append(points)
    frames = Frames(blocks, scene.prior, at_start=True)
    assert not compare(scene.known_rig, frames, LabelParameters(), scene.covariance).found


def test_a_wrong_prior_whose_angles_are_too_large_for_radians_is_not_in_radians(recording, tmp_path):
    files = read(recording)
    files.run["prior"] |= {"position_m": [1.0, 0, 0], "within_m": 0.3, "within_deg": 4.0}
    text, _ = checked(write(files, tmp_path / "run"))
    assert "radians" not in text


def test_exchanged_beams_of_a_fan_change_names_only():
    hidden = list(invisible_mistakes(unequal_fan(), None, LabelParameters()))
    beams = [one for one in hidden if one.mistake.kind == "target"]
    assert len(beams) == 3
    assert all(one.is_harmless for one in beams)


@pytest.mark.parametrize(
    ("longer", "model_px", "harmless"), [(1e-4, 0.3, True), (1e-4, 0.003, False), (5e-4, 0.3, True)]
)
def test_poses_are_the_same_if_they_differ_by_less_than_their_sigmas(longer, model_px, harmless):
    """Exchanged lenses that hardly differ: the poses are .3 mm and 1.3 mm off."""
    rig = fan()
    right = rig.cameras["right"]
    matrix = right.matrix * np.array([[1 + longer, 1, 1], [1, 1 + longer, 1], [1, 1, 1]])
    rig = replace(rig, cameras={**rig.cameras, "right": replace(right, matrix=matrix)})
    first = Pose.from_ypr(np.deg2rad([1, 2, 0]), np.array([0.02, 0.01, 0]))
    hidden = list(invisible_mistakes(rig, None, LabelParameters(model_sigma_px=model_px), first))
    assert [one.is_harmless for one in hidden if "each other's lens" in one.mistake.what] == [harmless]


def test_a_pose_with_which_the_mirrored_camera_sees_nothing_hides_no_mirror():
    """The one spot of camera `right` is near the middle of its picture; from the pose 5 cm beside it sees none."""
    scene = random_scene(91159)
    hidden = invisible_mistakes(scene.known_rig, scene.prior, LabelParameters(), scene.poses[0])
    assert [one.mistake.what for one in hidden] == ["beams `C` and `D` are exchanged"]


def test_each_possible_mistake_can_be_undone():
    rig = unequal_fan()
    rng = np.random.default_rng(0)
    for mistake in possible_mistakes(rig, PosePrior.everywhere(rig)):
        for change in mistake.pictures.values():
            uv: Array = rng.uniform(0, 1000, (20, 2))
            np.testing.assert_allclose(change.recorded(uv) @ change.turn.T + change.shift, uv, atol=1e-9)


def test_a_camera_whose_points_are_never_labelled_is_reported(tmp_path, recording):
    """A third camera with a pose of another day, which none of the usual mistakes explains."""
    files = read(recording)
    files.rig["cameras"]["third"] = yaml.safe_load(yaml.safe_dump(files.rig["cameras"]["left"]))
    turned_aside(files.rig["cameras"]["third"]["camera_from_world"])
    files.rig["cameras"]["third"]["camera_matrix"]["fx"] *= 1.7
    files.run["cameras"]["third"] = {"detections": "detections.csv"}
    files.rows = [row for row in files.rows if int(row["frame"]) < 24]
    files.rows += [{**row, "camera": "third"} for row in files.rows if row["camera"] == "left"]
    outcome = process_run(write(files, tmp_path / "run"), tmp_path / "out")
    assert outcome.verdict.status == "check"
    assert any("camera `third`: none of its" in text for text in outcome.verdict.texts)


def test_the_other_cameras_are_not_blamed_for_one_that_shows_nothing(tmp_path, recording):
    """A covered lens: no pose is found, and whether the rest of the set-up is right cannot be seen."""
    files = read(recording)
    files.rows = [row for row in files.rows if int(row["frame"]) < 6 and row["camera"] == "right"]
    files.run["cameras"]["left"] = {"frames": "left"}
    run = write(files, tmp_path / "run")
    width, height = files.rig["cameras"]["left"]["image_size_px"]
    (run / "left").mkdir()
    for frame in range(6):
        cv2.imwrite(str(run / "left" / f"{frame}.png"), np.zeros((height, width), np.uint8))
    text, _ = checked(run)
    assert "left: all pictures are black; is the lens covered?" in text
    assert "BP-M0" not in text


@pytest.mark.parametrize("aside_deg", further_slow([180.0, 0.0]))
def test_false_points_of_a_camera_are_reported_only_where_the_poses_put_spots_into_its_pictures(
    tmp_path, recording, compared_once, aside_deg
):
    """A third camera beside the left one, or with its back to it, that sees four false points per picture."""
    files = read(recording)
    left = files.rig["cameras"]["left"]
    third = yaml.safe_load(yaml.safe_dump(left))
    pose = Pose(matrix_from_quaternion(np.array(left["camera_from_world"]["quaternion_wxyz"])), np.zeros(3))
    turned = Pose.from_ypr(np.radians([0.0, aside_deg, 0.0]), np.zeros(3)) @ pose
    third["camera_from_world"]["quaternion_wxyz"] = quaternion_from_matrix(turned.rotation).tolist()
    files.rig["cameras"]["third"] = third
    files.run["cameras"]["third"] = {"detections": "detections.csv"}
    rng, first = np.random.default_rng(3), files.rows[0]
    uv = rng.uniform(20, 400, (FRAMES, 4, 2)).tolist()
    files.rows += [
        {**first, "camera": "third", "frame": k, "u_px": u, "v_px": v} for k, four in enumerate(uv) for u, v in four
    ]
    run = write(files, tmp_path / "run")
    outcome = process_run(run, tmp_path / "out")
    said = "camera `third`: none of its"
    assert any(said in text for text in outcome.verdict.texts) == (aside_deg == 0)
    assert (said in checked(run)[0]) == (aside_deg == 0)
    assert len(compared_once) == 1


def video(path: Path, size: tuple[int, int] = (64, 48), rate: float = 25.0, fourcc: str = "FFV1") -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*fourcc), rate, size, False)
    ramp = np.tile(np.linspace(0, 250, size[0]).astype(np.uint8), (size[1], 1))
    for _ in range(5):
        writer.write(ramp)
    writer.release()
    return path


@pytest.mark.slow
def test_errors_larger_than_the_sigmas_do_not_accuse_lenses_that_are_the_same_by_design(symmetric, tmp_path):
    run = shutil.copytree(symmetric, tmp_path / "run")
    points = pd.read_csv(run / "detections.csv")
    points[["sigma_u_px", "sigma_v_px"]] /= 4
    points["cov_uv_px2"] /= 16
    points.to_csv(run / "detections.csv", index=False)
    found = process_run(run, tmp_path / "out").verdict.findings
    assert [f.code for f in found] == ["BP-M04"]
    rig = (run / "rig.yaml").read_text()
    (run / "rig.yaml").write_text(re.sub(r"fx: [\d.]+", "fx: 1100.0", rig))  # both cannot be right, nor explain it
    found = process_run(run, tmp_path / "wrong").verdict.findings
    assert [f.what.split(" have")[0] for f in found if f.code == "BP-M08"] == ["cameras `left` and `right`"]


def test_a_frame_rate_that_the_header_of_a_video_contradicts_is_reported(tmp_path):
    run = write_run(tmp_path / "run")
    for name in ("left", "right"):
        video(run / f"{name}.avi", rate=100.0)
        edit(run / "run.yaml", f"frames/{name}", f"{name}.avi")
    assert "BP-M08" not in checked(run)[0]
    edit(run / "run.yaml", "frame_rate_hz: 100.0", "frame_rate_hz: 7")
    text, _ = checked(run)
    assert "the header of the video of camera `left` states 100 pictures per second, run.yaml 7" in text
    outcome = process_run(run, tmp_path / "out")
    assert "BP-M08" in [r.as_mapping()["code"] for r in outcome.verdict.findings]


def test_a_frame_rate_that_programs_write_by_default_is_no_contradiction(tmp_path):
    run = write_run(tmp_path / "run")
    for name in ("left", "right"):
        video(run / f"{name}.avi", rate=25.0)
        edit(run / "run.yaml", f"frames/{name}", f"{name}.avi")
    assert "BP-M08" not in checked(run)[0]


def test_a_video_with_an_orientation_flag_is_read_the_same_when_calibrating_and_running(tmp_path):
    path = video(tmp_path / "film.mp4", fourcc="mp4v")
    data = bytearray(path.read_bytes())
    # The matrix of the track's header, 40 bytes after its first field; this one is a turn by 90 deg.
    at = data.index(b"tkhd") + 4 + 40
    data[at : at + 36] = np.array([0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30], dtype=">i4").tobytes()
    path.write_bytes(bytes(data))
    turned = cv2.VideoCapture(str(path)).read()[1]
    assert turned.shape[:2] == (64, 48)  # OpenCV applies the flag unless it is asked not to
    running = next(picture for _, picture in pictures(video_at(path)))
    calibrating = next(picture for _, picture in _frames(path))
    assert running.shape == calibrating.shape == (48, 64)
    assert np.corrcoef(running.ravel(), calibrating.ravel())[0, 1] > 0.99  # one is the luma, the other from BGR


@pytest.mark.parametrize("size_m", [2.0, 0.1])
@pytest.mark.parametrize(("unit", "noted"), [(1.0, False), (1000.0, True)])
def test_targets_of_a_scan_are_metres_and_its_unit_is_recognised(unit, noted, size_m):
    from lab.calibrate.screens.screen_inputs import _in_metres

    at = np.array([[0.0, 0, 0], [2, 0, 0], [0, 1, 0.5], [1, 1, 0]]) * size_m / 2
    cloud = Cloud(file="scan.ply", unit="mm", targets="targets.csv")
    metres, note = _in_metres((at + 3) * unit, at, cloud)
    np.testing.assert_allclose(metres, at + 3)
    assert bool(note) is noted


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ((48, 64), "turned by 90 deg"),
        ((32, 24), "0.5 times the resolution"),
        ((31, 24), "times the resolution"),  # a half that was rounded
        ((40, 40), "cropped?"),
    ],
)
def test_the_size_of_a_picture_shows_the_mistake(tmp_path, size, words):
    run = write_run(tmp_path / "run")
    for path in (run / "frames/left").iterdir():
        cv2.imwrite(str(path), np.full((size[1], size[0]), 9, np.uint8))
    text, status = checked(run)
    assert status == 2
    assert words in text
    processed = typed("run", run, "--out", tmp_path / "out")
    assert processed.exit_code == 4
    assert f"camera left has no usable picture at all (wrong size {size[0]}x{size[1]}," in processed.stdout


def test_of_a_vehicle_at_rest_a_false_point_that_fits_a_mistake_by_chance_counts_once(try_only):
    """The spot of the third camera is not found; with the camera mirrored, a false point lies where it would be."""
    try_only("`third`.*mirrored")
    scene = random_scene(60070)
    model, pose, rng = SpotModel.of(scene.rig), scene.poses[0], np.random.default_rng(60070)
    pixels = model.project(pose)[0]
    seen, pictures, still = model.in_picture(pixels), SampledFrames(), {}
    for c, (name, camera) in enumerate(scene.rig.cameras.items()):
        mine = pixels[seen & (model.camera_of == c)]
        hidden, spots = (mine, mine[:0]) if name == "third" else (mine[:0], mine)
        false = rng.uniform([0, 0], camera.image_size_px, (8, 2))
        still[name] = np.concatenate([spots, false, hidden + rng.normal(0, 25, hidden.shape)])
    for k in range(40):
        found = {}
        for name, uv in still.items():
            sigma = 2.0 if name == "third" else 0.03
            found[name] = Detections.at(
                uv + rng.normal(0, 0.03, uv.shape), np.tile(sigma**2 * np.eye(2), (len(uv), 1, 1))
            )
        pictures.add(k, found)
    frames = frames_of(pictures.blocks, PosePrior(pose, 0.3, 0.3), LabelParameters().min_spots)
    assert not compare(scene.rig, frames, LabelParameters()).found


def test_cameras_whose_points_have_labels_are_not_cropped(tmp_path):
    """At rest: spots are hidden in two of six sampled frames, and lie in a corner of two pictures."""
    run = write_run_folder(random_scene(94026), tmp_path / "run")
    (run / "truth").rename(tmp_path / "truth")
    assert "cropped" not in checked(run)[0]


@pytest.mark.slow
def test_the_one_spot_of_a_camera_that_stays_in_a_corner_is_not_cropped(tmp_path):
    run = write_run_folder(random_scene(95215), tmp_path / "run")
    (run / "truth").rename(tmp_path / "truth")
    assert "cropped" not in checked(run)[0]


@pytest.mark.parametrize("name", ["mirrored left-right", "camera_from_world inverted, one"])
def test_a_mistake_is_named_at_rest_without_a_false_point(tmp_path, name):
    save_rig(calibrated(unequal_fan(), 1), tmp_path / "rig.yaml")
    run = simulate(
        "static", tmp_path / "run", seed=1, frames=FRAMES, points=True, rig=tmp_path / "rig.yaml", clutter=0.0
    )
    (run / "truth").rename(tmp_path / "truth")
    outcome = process_run(with_mistake(name, run, tmp_path / "wrong"), tmp_path / "out")
    assert re.search(CASE[name].words, outcome.verdict.texts[0])


@pytest.mark.parametrize(
    "name", further_slow(["turned by 90 deg", "prior in radians", "the ends of a beam exchanged"], fast=2)
)
def test_four_spots_of_a_vehicle_at_rest_are_enough_evidence(tmp_path, name):
    """All frames are alike: 17.5 nats. Few of the prior's poses let the rig see its spots: they compare no rigs."""
    run = write_run_folder(random_scene(8116, 40), tmp_path / "run")
    assert re.search(CASE[name].words, checked(with_mistake(name, run, tmp_path / "wrong"))[0])


def test_a_prior_refers_to_the_first_frame_and_not_to_the_second(tmp_path):
    """The vehicle leaves the prior within a frame: 9 cm at 6.6 Hz."""
    run = write_run_folder(random_scene(96047), tmp_path / "run")
    (run / "truth").rename(tmp_path / "truth")
    assert "BP-M06" not in checked(run)[0]


@pytest.mark.parametrize("seed", further_slow([95277, 95245]))
def test_spots_that_are_hidden_in_one_of_two_pictures_are_no_wrong_numbers(tmp_path, try_only, seed):
    """Of a vehicle that moves by less than two pixels per frame the next picture shows them, and fits as well."""
    try_only("^numbers")
    run = write_run_folder(random_scene(seed), tmp_path / "run")
    (run / "truth").rename(tmp_path / "truth")
    assert "BP-M06" not in checked(run)[0]


def test_at_rest_only_the_first_and_last_number_show_a_camera_that_is_numbered_from_one(tmp_path):
    run = simulate("static", tmp_path / "run", seed=1, frames=12, points=True)
    text, status = checked(with_mistake("numbered from 1, one camera", run, tmp_path / "wrong"))
    assert status == 0
    assert "have 12 frames each, numbered from 1 and from 0" in text
    assert "numbered from" not in checked(run)[0]


def test_exchanged_spots_of_a_screen_are_said_to_be_invisible_where_no_beams_can_be_exchanged(tmp_path):
    save_rig(random_scene(7113).known_rig, tmp_path / "rig.yaml")
    assert "Exchanged names of two spots of a screen: no recording shows them" in checked(tmp_path / "rig.yaml")[0]


@pytest.mark.parametrize(
    ("wrong", "rows", "words"),
    [
        ("moved", (1, 20, 40, 58), "no spot of beam `B` is where the rig puts it: its direction or point is wrong"),
        ("reversed", (1, 30, 58), "the ends of beam `B` are exchanged"),
    ],
)
def test_a_beam_that_has_moved_is_not_one_whose_ends_are_exchanged(try_only, wrong, rows, words):
    """A reversed beam hardly ever meets a screen: such a rig explains all points but this beam's."""
    try_only("beam", always=True)
    lab, (scene,), _ = bench.campaign(8308, 60, recordings=1)
    beam, stated = lab.rig.beams["B"], None
    if wrong == "reversed":
        changed = replace(beam, direction=-beam.direction)
    else:  # by 13 mrad and 18 mm, where 1 mrad and 1 mm are stated
        turned = beam.direction + np.array([0.0, -0.003, -0.0126])
        changed = Beam("B", turned / np.linalg.norm(turned), beam.point + np.array([-0.007, 0.0, 0.0165]))
        stated = bench.rig_covariance(lab.rig, bench.Sigmas(clocks=0.0))
    rig = replace(lab.rig, beams={**lab.rig.beams, "B": changed})
    blocks = [[dict(zip(rig.cameras, scene.detections[k + i], strict=True)) for i in (-1, 0, 1)] for k in rows]
    found = compare(rig, Frames(blocks, None, at_start=False), LabelParameters(), stated).found
    assert [m.what for m, _ in found] == [words]


@pytest.mark.parametrize(("seed", "lamps"), further_slow([(0, (39, 20)), (4, (34, 28)), (7, (42, 20)), (10, (36, 28))]))
def test_a_spot_that_no_picture_shows_among_lamps_leaves_right_poses_and_no_mistake(tmp_path, seed, lamps):
    """The only spot of a camera is off, and lamps brighter than the spots stay where they are in both cameras."""
    run = simulate("four-skew-beams", tmp_path / "run", seed=seed, frames=30, points=True)
    rig = run / "rig.yaml"
    rig.write_text("".join(s for s in rig.read_text().splitlines(keepends=True) if not re.match(r"\s+'[13]':", s)))
    table = pd.read_csv(run / "detections.csv")
    spots = table[table.camera == "right"].assign(flux=800.0, peak=60.0)
    rng = np.random.default_rng(seed)
    room = pd.DataFrame({"camera": lamps[0] * ["left"] + lamps[1] * ["right"], "flux": 4000.0, "peak": 200.0})
    room[["u_px", "v_px"]] = rng.uniform([0, 0], [1280, 1024], (len(room), 2))
    rows = [room.assign(frame=frame, sigma_u_px=0.1, sigma_v_px=0.1) for frame in range(30)]
    every = pd.concat([spots, *rows]).sort_values(["frame", "camera"], kind="stable")
    every[["u_px", "v_px"]] += rng.normal(0.0, 0.02, (len(every), 2))
    every[table.columns].to_csv(run / "detections.csv", index=False)
    (run / "truth" / "spots.csv").unlink()
    process_run(run, tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["counts"]["pose_status"] == {"measured": 30}
    assert not {"BP-M01", "BP-M06", "BP-V20"} & {finding["code"] for finding in summary["verdict"]["evidence"]}
