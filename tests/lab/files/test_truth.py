"""Truth tables: mistakes are reported with their line, and the rig that made them is recognised."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from lab.errors import InputError
from lab.files.rig.rig_file import load_rig
from lab.files.run.run_file import load_run
from lab.files.run.truth import largest_disagreement_px, load_run_truth, load_truth
from lab.runs.input_check import check
from lab.runs.process import ready_run
from tests.lab.run_folders import edit, write_run

POSE = "frame,t_s,x_m,y_m,z_m,qw,qx,qy,qz\n"
SPOTS = "frame,camera,spot,u_px,v_px,in_view\n"


def write_truth(folder: Path, rig: Rig, count: int = 5) -> None:
    """The truth of a vehicle that moves and turns slowly, by the forward model."""
    model = SpotModel.of(rig)
    pose_lines, spot_lines = [], []
    for frame in range(count):
        pose = Pose.from_ypr(np.array([0.02, -0.01, 0.03]) * frame, np.array([0.01, 0.0, 0.02]) * frame)
        numbers = [*pose.translation, *pose.quaternion_wxyz]
        pose_lines.append(f"{frame},{frame / 100}," + ",".join(repr(float(v)) for v in numbers))
        pixels, _ = model.project(pose)
        for (camera, spot), (u, v), seen in zip(model.views, pixels, model.in_picture(pixels), strict=True):
            at = f"{u!r},{v!r}".replace("np.float64(", "").replace(")", "") if np.isfinite(u) else ","
            spot_lines.append(f"{frame},{camera},{spot},{at},{int(seen)}")
    (folder / "truth").mkdir()
    (folder / "truth" / "pose.csv").write_text(POSE + "\n".join(pose_lines) + "\n")
    (folder / "truth" / "spots.csv").write_text(SPOTS + "\n".join(spot_lines) + "\n")


def test_truth_made_with_this_rig_agrees_with_it_and_with_no_other(tmp_path):
    folder = write_run(tmp_path / "a")
    rig = load_rig(folder / "rig.yaml")
    assert load_truth(folder) is None
    write_truth(folder, rig)
    truth = load_truth(folder, rig.cameras, rig.spots)
    assert len(truth.pose.frame) == 5
    assert len(truth.spots.frame) == 30
    assert largest_disagreement_px(truth, rig)[0] < 1e-9
    edit(folder / "rig.yaml", "[-0.05, 0.01, 1e-3, 0, 0]", "[-0.06, 0.01, 1e-3, 0, 0]")
    worst, frame = largest_disagreement_px(truth, load_rig(folder / "rig.yaml"))
    assert worst > 0.015
    assert 0 <= frame < 5


def test_the_frame_that_disagrees_is_named(tmp_path):
    folder = write_run(tmp_path / "a")
    rig = load_rig(folder / "rig.yaml")
    write_truth(folder, rig)
    truth = load_truth(folder, rig.cameras, rig.spots)
    truth.spots.uv_px[truth.spots.frame == 3, 0] += 0.5
    worst, frame = largest_disagreement_px(truth, rig)
    np.testing.assert_allclose(worst, 0.5, atol=1e-9)
    assert frame == 3


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("pose.csv", "frame,t,x_m\n", "truth/pose.csv: expected a column 't_s', got frame,t,x_m"),
        ("pose.csv", POSE + "0,0,0,0,0,1,0,0,0\n0,0,0,0,0,1,0,0,0\n", "line 3: frame: expected rising numbers, got 0"),
        (
            "pose.csv",
            POSE + "0,0,0,0,0,1,0.1,0,0\n",
            "line 2: qw,qx,qy,qz: expected a quaternion of length 1, got one of length 1.004988;",
        ),
        ("pose.csv", POSE + "0,0,0,,0,1,0,0,0\n", "line 2: y_m: expected a number, got nothing"),
        ("pose.csv", POSE + "0.5,0,0,0,0,1,0,0,0\n", "line 2: frame: expected a whole number, got 0.5"),
        ("spots.csv", SPOTS + "0,left,1,1,2,3\n", "line 2: in_view: expected 0, 1 or 2, got 3"),
        ("spots.csv", SPOTS + "0,left,1,,,1\n", "line 2: u_px: expected a number where in_view is 1 or 2, got nothing"),
        (
            "spots.csv",
            SPOTS + "0,lft,1,1,2,1\n",
            "line 2: camera: expected a camera of the rig, got 'lft'; did you mean 'left'?",
        ),
        ("spots.csv", SPOTS + "0,left,9,1,2,1\n", "line 2: spot: expected a spot of the rig, got '9'; known: 1, 2, 3"),
        (
            "spots.csv",
            SPOTS + "0,left,1,1,2,1\n" * 2,
            "line 3: expected one row per frame, camera and spot, got a second one for frame 0",
        ),
    ],
)
def test_a_mistake_in_the_truth_is_reported_with_its_line(name, text, words, tmp_path):
    folder = write_run(tmp_path / "a", frames=1)
    (folder / "truth").mkdir()
    (folder / "truth" / name).write_text(text)
    with pytest.raises(InputError) as caught:
        load_run_truth(load_run(folder))
    assert words in str(caught.value)


def test_a_spot_without_projection_may_be_empty_outside_the_picture(tmp_path):
    folder = write_run(tmp_path / "a", frames=1)
    (folder / "truth").mkdir()
    (folder / "truth" / "spots.csv").write_text(SPOTS + "0,left,1,,,0\n")
    truth = load_run_truth(load_run(folder))
    assert truth.pose is None
    assert np.isnan(truth.spots.uv_px[0, 0])


def test_check_and_run_accept_truth_of_a_camera_that_the_run_leaves_out(tmp_path):
    folder = write_run(tmp_path / "a")
    write_truth(folder, load_rig(folder / "rig.yaml"))
    edit(folder / "run.yaml", "  right: {frames: frames/right}\n", "")
    run = load_run(folder)
    assert run.left_out == ("right",)
    assert load_run_truth(run).spots.camera.words == ("left", "right")
    assert not any("truth" in line for line in check(folder).lines if "problem" in line)
    assert any("Truth: pose.csv frames 0 to 4" in line for line in check(folder).lines)
    ready_run(folder)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("pose.csv", POSE.encode() + b"0,0,0,0,0,1,0,0,0\n\xff", "pose.csv: line 3: expected text in UTF-8"),
        ("spots.csv", SPOTS.encode() + b"0,left,9,1,2,1\n", "line 2: spot: expected a spot of the rig, got '9'"),
    ],
)
def test_check_and_run_refuse_the_same_truth_before_anything_is_processed(name, content, words, tmp_path):
    folder = write_run(tmp_path / "a")
    (folder / "truth").mkdir()
    (folder / "truth" / name).write_bytes(content)
    assert any(words in line for line in check(folder).lines)
    with pytest.raises(InputError) as caught:
        ready_run(folder)
    assert words in str(caught.value)
