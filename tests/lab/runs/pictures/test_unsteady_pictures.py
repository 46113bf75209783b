"""Runs on recordings whose cameras turn a little or whose light changes, and on such that repeat pictures."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy import ndimage
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from geometry.camera import Camera
from geometry.pose import Pose
from lab.files.rig.rig_file import load_rig
from lab.pictures.delivery import without_repeats
from tests.lab.command import typed
from tests.marks import further_slow
from tests.tracking.rendering import round_lights
from tracking.background.camera_motion import CameraMotion, shift_between
from tracking.noise import NoiseModel
from tracking.parameters import DetectParameters

SIZE, FRAMES, MARGIN, STEP = (512, 640), 24, 8, 16
EVERY = [np.arange(0, n + STEP, STEP) for n in SIZE]
Y, X = np.mgrid[-MARGIN : SIZE[0] + MARGIN, -MARGIN : SIZE[1] + MARGIN]
# A room with shelves and boxes, as a camera sees it that does not turn.
ROOM = cv2.GaussianBlur(
    24.0
    + 30.0 * (np.sin(X / 21.0 + 1.0) * np.sin(Y / 17.0) > 0.0)
    + 25.0 * (np.sin(X / 9.0 - Y / 31.0) > 0.8)
    + np.random.default_rng(4).normal(0.0, 8.0, X.shape),
    (0, 0),
    0.9,
)
SPLINE = ndimage.spline_filter(ROOM, order=3)
# An even wall, in front of which the tops of three balls are.
BALLS = [np.hypot(X - u, Y - v) < r for u, v, r in ((90, 380, 80), (360, 540, 90), (600, 430, 70))]
WALL = ndimage.spline_filter(cv2.GaussianBlur(40.0 - 30.0 * np.any(BALLS, axis=0), (0, 0), 0.9), order=3)


def turned(camera: Camera, by_rad: np.ndarray) -> Camera:
    """The camera after a small rotation about its own axes."""
    pose = camera.camera_from_world
    R = Rotation.from_rotvec(by_rad).as_matrix()
    return replace(camera, camera_from_world=Pose(R @ pose.rotation, R @ pose.translation))


def add_person(picture: np.ndarray, frame: int) -> None:
    """Somebody in black clothes who walks past the camera during the recording, and hides a sixth of it."""
    middle = SIZE[1] * (1.4 * frame / FRAMES - 0.2)
    columns = slice(*np.clip([middle - 64, middle + 64], 0, SIZE[1]).astype(int))
    seen, (v, u) = picture[:, columns], np.mgrid[: SIZE[0], columns]
    if seen.size:
        hides = cv2.GaussianBlur((np.hypot((u - middle) / 48, (v - 300) / 260) < 1).astype(float), (0, 0), 2.0)
        seen += hides * (12 + 5 * np.sin(u / 17 + v / 23) - seen)


def steady(frame: int) -> Any:
    """The light of a room that does not change."""
    return 1.0


@dataclass(frozen=True)
class Unsteady:
    """What a camera sees beside the spots, and how it moves."""

    shake_px: float = 0.0  # root mean square of its turns
    light: Callable[[int], Any] = steady  # of the room in a frame, a number or one for each row (h, 1)
    walks: bool = False  # a person, through all pictures
    step_px: float = 0.0  # by which it is moved in a frame; it was calibrated before
    step_at: int = 0
    wall: bool = False  # an even one, in place of a room


def recording(folder: Path, **by_camera: Unsteady) -> tuple[Path, Path]:
    """A run folder with pictures of the cameras left and right, and its truth beside it."""
    made = typed("simulate", "four-skew-beams", "--frames", FRAMES, "--scale", "0.5", "--points", "--out", folder)
    assert made.exit_code == 0, made.output
    run = folder / "run.yaml"
    run.write_text(re.sub(r"(left|right):\n +detections: detections.csv", r"\1: {frames: frames/\1}", run.read_text()))
    (folder / "detections.csv").unlink()
    truth = shutil.move(folder / "truth", folder.with_name("truth"))
    spots, rig, rng = pd.read_csv(truth / "spots.csv"), load_rig(folder / "rig.yaml"), np.random.default_rng(2)
    ends = np.stack(np.meshgrid(np.arange(SIZE[1] + STEP), np.arange(SIZE[0] + STEP)), axis=-1).astype(float)
    pixels = ends[: SIZE[0], : SIZE[1]]
    for name, camera in rig.cameras.items():
        (folder / "frames" / name).mkdir(parents=True)
        its = by_camera.get(name, Unsteady())
        turns = rng.normal(0.0, its.shake_px / camera.matrix[0, 0], (FRAMES, 3))
        room = np.zeros(SIZE)
        turns -= turns.mean(axis=0)
        turns[its.step_at :, :2] += its.step_px / camera.matrix[0, 0]
        for frame, turn in enumerate(turns):
            now = turned(camera, turn)
            if frame == 0 or its.shake_px or (its.step_px and frame == its.step_at):
                origin, rays = now.rays(ends[::STEP, ::STEP])  # they vary smoothly
                seen = np.moveaxis(camera.project(origin + 3.0 * rays)[..., ::-1] + MARGIN, -1, 0)
                at_all = [RectBivariateSpline(*EVERY, x)(np.arange(SIZE[0]), np.arange(SIZE[1])) for x in seen]
                room = ndimage.map_coordinates(WALL if its.wall else SPLINE, at_all, order=3, prefilter=False)
            picture = room * its.light(frame)
            at = spots[(spots.camera == name) & (spots.frame == frame)][["u_px", "v_px"]].dropna().to_numpy()
            start, towards = camera.rays(at)
            for u, v in now.project(start + 3.0 * towards):
                near = tuple(slice(max(int(x) - 12, 0), max(int(x) + 13, 0)) for x in (v, u))  # beyond, 1e-10 DN
                picture[near] += 90.0 * np.exp(-0.5 * np.sum((pixels[near] - [u, v]) ** 2, axis=-1) / 1.6**2)
            if its.walks:
                add_person(picture, frame)
            picture = np.clip(np.rint(picture + rng.normal(0.0, 1.0, SIZE)), 0, 255).astype(np.uint8)
            cv2.imwrite(str(folder / "frames" / name / f"{frame:06d}.png"), picture)
    return folder, truth


@pytest.fixture(scope="module")
def first_resting(tmp_path_factory) -> Path:
    return recording(tmp_path_factory.mktemp("resting") / "run")[0].parent


@pytest.fixture
def resting(first_resting, tmp_path) -> tuple[Path, Path]:
    """A run folder of cameras at rest that a test may change, and its truth."""
    shutil.copytree(first_resting, tmp_path, dirs_exist_ok=True)
    return tmp_path / "run", tmp_path / "truth"


def nees(out: Path, truth: Path) -> np.ndarray:
    """Of the measured poses, over 6."""
    rows = pd.read_csv(out / "attitude.csv").merge(pd.read_csv(out / "covariance.csv"), on="frame")
    rows = rows.merge(pd.read_csv(truth / "pose.csv"), on="frame", suffixes=("", "_true"))
    found = []
    for _, row in rows[rows.status == "measured"].iterrows():
        q, q_true = (Rotation.from_quat(row[[f"q{k}{s}" for k in "xyzw"]].to_numpy(float)) for s in ("", "_true"))
        away = [row[f"{k}_m_true"] - row[f"{k}_m"] for k in "xyz"]
        P = np.zeros((6, 6))
        P[np.triu_indices(6)] = row[[f"c{i}{j}" for i in range(6) for j in range(i, 6)]].to_numpy(float)
        off = np.append(away, (q.inv() * q_true).as_rotvec())
        found.append(off @ np.linalg.solve(P + P.T - np.diag(np.diag(P)), off) / 6)
    return np.array(found)


def processed(folder: Path, out: Path) -> dict[str, Any]:
    """The summary of a run by the command line."""
    done = typed("run", folder, "--out", out)
    assert done.exit_code == 0, done.output
    return dict(json.loads((out / "summary.json").read_text()))


def test_cameras_that_shake_are_named_and_their_poses_are_as_good_as_their_sigmas(tmp_path):
    shakes = {"left": 0.15, "right": 1.0}
    folder, truth = recording(tmp_path / "run", **{name: Unsteady(px) for name, px in shakes.items()})
    summary = processed(folder, tmp_path / "out")
    found = nees(tmp_path / "out", truth)
    assert len(found) >= FRAMES - 1
    assert found.mean() < 2.0
    assert found.max() < 6.0
    for camera, noise in summary["parameters"]["noise"].items():
        assert noise["camera_motion_px"] == pytest.approx(shakes[camera], rel=0.35)
        assert any(note.startswith(f"{camera}: the camera moves by") for note in summary["notes"])


@pytest.mark.parametrize(
    ("step_at", "wall"),
    further_slow([(FRAMES // 2, True), (FRAMES // 2, False), (4, False), (FRAMES - 6, False)]),
)
def test_cameras_that_are_moved_during_a_recording_are_named_and_the_sigmas_contain_the_step(tmp_path, step_at, wall):
    """Which of the two attitudes is that of the calibration cannot be seen; the truth here is the first."""
    moved = Unsteady(step_px=1.5, step_at=step_at, wall=wall)
    folder, truth = recording(tmp_path / "run", left=moved, right=moved)
    summary = processed(folder, tmp_path / "out")
    found = nees(tmp_path / "out", truth)
    assert len(found) >= FRAMES - 1
    assert found.mean() < 3.0
    assert found.max() < 6.0
    for camera in summary["parameters"]["noise"]:
        assert any(note.startswith(f"{camera}: the camera moves by") and "once" in note for note in summary["notes"])
    assert not any("Find out when" in note for note in summary["notes"])  # the finding says when
    assert summary["verdict"]["status"] == "check"
    named = {e["numbers"]["camera"]: e["numbers"] for e in summary["verdict"]["evidence"] if e["code"] == "BP-V19"}
    assert {name: n["moved_px"] for name, n in named.items()} == pytest.approx(
        dict.fromkeys(("left", "right"), 2.1), rel=0.15
    )
    assert [n["moved_between"] for n in named.values()] == [[step_at - 1, step_at]] * 2


@pytest.mark.slow
def test_cameras_that_are_moved_by_many_pixels_are_named(tmp_path):
    """They are not corrected: with all of them moved alike, the later spots fit a wrong pose."""
    moved = Unsteady(step_px=25.0, step_at=FRAMES // 2)
    summary = processed(recording(tmp_path / "run", left=moved, right=moved)[0], tmp_path / "out")
    assert summary["verdict"]["status"] == "check"
    named = [e["numbers"] for e in summary["verdict"]["evidence"] if e["code"] == "BP-V19"]
    assert [n["camera"] for n in named] == ["left", "right"]
    assert [n["moved_px"] for n in named] == pytest.approx([25.0 * np.sqrt(2)] * 2, rel=0.1)


@pytest.mark.parametrize("share", further_slow([0.5, 0.0]))
def test_cameras_that_average_their_pictures_over_time_are_named(resting, tmp_path, share):
    """A filter against noise takes this share of each picture from the one before; all spots then lag by a picture."""
    folder, _ = resting
    for camera in ("left", "right"):
        shown = 0.0
        for k, file in enumerate(sorted((folder / "frames" / camera).iterdir())):
            picture = cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(float)
            shown = picture if k == 0 else (1 - share) * picture + share * shown
            cv2.imwrite(str(file), np.rint(shown).astype(np.uint8))
    verdict = processed(folder, tmp_path / "out")["verdict"]
    named = [camera for e in verdict["evidence"] if e["code"] == "BP-V22" for camera in e["numbers"]]
    assert named == (["left", "right"] if share else [])
    assert verdict["status"] == ("check" if share else "pass")


@pytest.mark.slow
def test_cameras_with_interlaced_pictures_are_named(tmp_path):
    """The odd rows of the camera on the left are those of the next picture. The room has lines along the rows."""
    folder, _ = recording(tmp_path / "run", right=Unsteady(light=lined))
    files = sorted((folder / "frames" / "left").iterdir())
    pictures = [cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in files]
    for file, picture, after in zip(files, pictures, pictures[1:], strict=False):
        picture[1::2] = after[1::2]
        cv2.imwrite(str(file), picture)
    evidence = processed(folder, tmp_path / "out")["verdict"]["evidence"]
    assert [e["numbers"]["camera"] for e in evidence if e["code"] == "BP-V23"] == ["left"]


def lined(frame: int) -> Any:
    return 1 + 0.3 * (np.arange(SIZE[0])[:, None] % 2)


def flickers(frame: int) -> Any:
    return 1 + 0.12 * np.sin(0.7 * frame + 1.0)


def falls(frame: int) -> Any:
    return 1 - 0.5 * np.clip(frame / 8 - 1, 0, 1)


def in_bands(frame: int) -> Any:
    return 1 + 0.1 * np.sin(0.9 * frame + np.arange(SIZE[0])[:, None] / 27)


@pytest.mark.slow
def test_spots_are_found_in_front_of_rooms_whose_light_changes(tmp_path):
    folder, truth = recording(tmp_path / "run", left=Unsteady(light=flickers), right=Unsteady(light=falls))
    summary = processed(folder, tmp_path / "out")
    assert all(noise["background_pictures"] > 0 for noise in summary["parameters"]["noise"].values())
    found = nees(tmp_path / "out", truth)
    assert len(found) == FRAMES
    assert found.mean() < 2.0
    spots = pd.read_csv(tmp_path / "out" / "spots.csv")
    assert (spots.groupby("camera").status.agg(lambda s: (s == "matched").mean()) > 0.97).all()


def door_opens(frame: int) -> Any:
    """A bright stripe of the room from the middle of the recording on."""
    columns = np.arange(SIZE[1])
    return 1 + 0.8 * (frame >= FRAMES // 2) * ((columns > 110) & (columns < 200))


@pytest.mark.slow
def test_spots_are_found_where_the_room_changes_during_the_recording(tmp_path):
    """No background fits both halves of the recording there: the pictures themselves show the spots."""
    folder, truth = recording(tmp_path / "run", left=Unsteady(light=door_opens), right=Unsteady(light=door_opens))
    processed(folder, tmp_path / "out")
    found = nees(tmp_path / "out", truth)
    assert len(found) == FRAMES
    assert found.mean() < 2.0
    spots = pd.read_csv(tmp_path / "out" / "spots.csv")
    assert (spots.groupby(["camera", "spot"]).status.agg(lambda s: (s == "matched").mean()) > 0.75).all()


@pytest.mark.slow
def test_light_in_bands_hides_no_spot(tmp_path):
    folder, truth = recording(tmp_path / "run", left=Unsteady(light=in_bands))
    matched = shares_of_a_run_without_wrong_poses(folder, truth)
    assert matched["left"] > 0.97


@pytest.mark.slow
def test_somebody_who_walks_past_hides_some_spots_and_causes_no_wrong_pose(tmp_path):
    folder, truth = recording(tmp_path / "run", right=Unsteady(walks=True))
    matched = shares_of_a_run_without_wrong_poses(folder, truth)
    assert matched["left"] > 0.97
    assert matched["right"] > 0.5


def shares_of_a_run_without_wrong_poses(folder: Path, truth: Path) -> dict[str, float]:
    """The share of matched rows of spots.csv, by camera; all poses are measured and have the errors that they state."""
    out = folder.with_name("out")
    summary = processed(folder, out)
    assert all(noise["background_pictures"] > 0 for noise in summary["parameters"]["noise"].values())
    found = nees(out, truth)
    assert len(found) == FRAMES
    assert found.mean() < 2.0
    assert found.max() < 6.0
    spots = pd.read_csv(out / "spots.csv")
    return {camera: float((of.status == "matched").mean()) for camera, of in spots.groupby("camera")}


def test_pictures_that_repeat_the_one_before_wholly_or_in_part_have_no_spots(resting, tmp_path):
    """A grabber that has no new picture gives the last one again, or its lower half: spots of another instant.

    The cameras stand still, and are not corrected.
    """
    folder, truth = resting
    again, torn = [9, 14, 15, 20], [5, 11, 18]
    for frame in (*again, *torn):
        for camera in ("left", "right"):
            now, before = (folder / "frames" / camera / f"{frame - k:06d}.png" for k in (0, 1))
            halves = [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in (now, before)]
            kept = SIZE[0] // 2 if frame in torn else 0
            cv2.imwrite(str(now), np.vstack([halves[0][:kept], halves[1][kept:]]))
    summary = processed(folder, tmp_path / "out")
    rows = pd.read_csv(tmp_path / "out" / "attitude.csv").set_index("frame")
    assert (rows.status[[*again, *torn]] != "measured").all()
    assert (rows.status.drop([*again, *torn]) == "measured").all()
    assert nees(tmp_path / "out", truth).mean() < 2.0
    notes = " ".join(summary["notes"])
    assert "left: 4 frames repeated" in notes
    assert "left: 3 frames torn" in notes
    assert [noise["camera_motion_px"] for noise in summary["parameters"]["noise"].values()] == [0.0, 0.0]
    assert "camera moves" not in notes


def test_rows_without_noise_may_be_equal():
    """Black rows, and blocks that a video has not coded again."""
    rng = np.random.default_rng(2)
    pictures = [rng.integers(0, 20, (400, 600), np.uint8) for _ in range(4)]
    for k, picture in enumerate(pictures):
        picture[:40] = 0
        if k:
            picture[200:, : 100 * k] = pictures[k - 1][200:, : 100 * k]
    assert all(isinstance(p, np.ndarray) for _, p in without_repeats((k, p) for k, p in enumerate(pictures)))


def test_pictures_without_noise_may_be_equal_while_all_is_at_rest():
    bright = np.zeros((400, 600), np.uint8)
    bright[180:192, 300:312] = 200
    moved = np.roll(bright, 9, axis=1)
    stream = ((k, p) for k, p in enumerate([bright, bright, moved, moved, moved]))
    assert [k for k, p in without_repeats(stream) if isinstance(p, np.ndarray)] == [0, 1, 2, 3, 4]


def test_lights_of_an_unlit_room_do_not_show_how_a_camera_moves():
    """They may be those of the vehicle, which would be taken for at rest."""
    rng = np.random.default_rng(3)
    places = rng.uniform(40, 400, (14, 2))
    v, u = np.mgrid[:480, :640]
    pictures = []
    for _ in range(15):
        light = sum(120.0 * np.exp(-0.5 * ((u - x) ** 2 + (v - y) ** 2) / 2.0**2) for x, y in places)
        places += rng.normal(0.0, 0.3, 2)
        pictures.append(np.clip(np.rint(light + rng.normal(8.0, 1.0, light.shape)), 0, 255).astype(np.uint8))
    matrix = np.array([[700.0, 0, 320], [0, 700.0, 240], [0, 0, 1]])
    camera = Camera("left", "wall", (640, 480), matrix, (), Pose.identity())
    assert CameraMotion.of(pictures, camera, NoiseModel(1.0, 0.0, 8.0), DetectParameters()) is None


@pytest.mark.parametrize("quality", [None, 60, 90])
def test_lights_that_move_alike_before_an_even_screen_are_no_moved_camera(quality):
    """Compression takes the noise away, by which other pictures of an even screen differ everywhere."""
    pictures, places = [], np.random.default_rng(1).uniform(100, 300, (4, 2))
    for moved in ([0.0, 0.0], [53.0, -4.0]):
        picture = np.clip(np.rint(12 + round_lights((480, 640), places + moved, 250.0, 2.0)), 0, 255).astype(np.uint8)
        if quality:
            picture = cv2.imdecode(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], -1)
        pictures.append(picture)
    assert not shift_between(*pictures).any()
