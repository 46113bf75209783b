"""Conversion between camera files: formats are recognised, losses are noted, and no other file is overwritten."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.errors import InputError
from lab.files.rig.camera_file import CameraFile, load_camera, save_camera
from lab.files.rig.interchange import FORMATS, convert, read_cameras, recognised_format, same_lens
from lab.files.rig.rig_file import RigFile, load_rig_file, save_rig
from tests.lab.run_folders import RIG

NAMES = {
    "beampose": "camera.yaml",
    "opencv": "left.yml",
    "kalibr": "camchain.yaml",
    "ros": "camera_info.yaml",
    "colmap": "cameras.txt",
    "mrcal": "left.cameramodel",
}
K = np.array([[1180.1, 0, 639.4], [0, 1181.3, 511.7], [0, 0, 1]])
LENS = CameraFile("left", (1280, 1024), K, (-0.1, 1 / 3, 1e-3, -5e-7))


@pytest.fixture
def source(tmp_path):
    save_camera(LENS, tmp_path / "source.yaml")
    return tmp_path / "source.yaml"


@pytest.mark.parametrize(("first", "second"), list(itertools.permutations(NAMES, 2)))
def test_a_lens_survives_any_two_conversions(first, second, source, tmp_path):
    a, b, back = tmp_path / "a", tmp_path / "b", tmp_path / "back" / "camera.yaml"
    for folder in (a, b, back.parent):
        folder.mkdir()
    convert(source, a / NAMES[first])
    outcome = convert(a / NAMES[first], b / NAMES[second])
    assert outcome.exit_status == 0
    assert recognised_format((b / NAMES[second]).read_text(), b / NAMES[second]) == second
    convert(b / NAMES[second], back)
    (model,), (again,) = read_cameras(source), read_cameras(back)
    assert same_lens(model, again)
    np.testing.assert_allclose(load_camera(back).camera_matrix, K, rtol=1e-12)


def test_the_line_names_both_formats_and_what_was_left_out(source, tmp_path):
    save_camera(
        CameraFile("left", (1280, 1024), K, (), covariance=RigCovariance(("fx", "fy"), np.eye(2))), tmp_path / "c.yaml"
    )
    outcome = convert(tmp_path / "c.yaml", tmp_path / "left.yml")
    lines = outcome.line().splitlines()
    assert lines[0].startswith("left: beampose camera.yaml -> OpenCV YAML, ")
    assert lines[1:] == ["  note: opencv cannot hold a covariance: that of left is not written"]


@pytest.fixture
def rig(tmp_path):
    (tmp_path / "rig.yaml").write_text(RIG)
    return tmp_path / "rig.yaml"


def test_all_cameras_of_a_rig_are_converted_with_their_poses(rig, tmp_path):
    outcome = convert(rig, tmp_path / "camchain.yaml", camera="left")
    assert [model.name for model in outcome.result] == ["left"]
    bent = rig.read_text().replace("[-0.05, 0.01, 1e-3, 0.0, 0.0]", "[-0.05, 0.01, 1e-3, 0, 0]")
    rig.write_text(bent)
    convert(rig, tmp_path / "camchain.yaml")
    cameras = load_rig_file(rig).rig.cameras
    for model in read_cameras(tmp_path / "camchain.yaml"):
        pose = cameras[model.name].camera_from_world
        np.testing.assert_allclose(model.camera_from_reference.rotation, pose.rotation, atol=1e-12)
        np.testing.assert_allclose(model.camera_from_reference.translation, pose.translation, atol=1e-12)
    outcome = convert(rig, tmp_path / "cameras.txt")
    assert outcome.lines[1:] == (
        "  note: colmap numbers its cameras: left is camera 1, right is camera 2",
        "  note: colmap cannot hold poses: the pose of left, right is not written",
    )


def test_a_format_for_one_camera_requires_a_choice(rig, tmp_path):
    with pytest.raises(
        InputError, match="has cameras left, right, but ROS camera_info holds one; choose with --camera"
    ):
        convert(rig, tmp_path / "camera_info.yaml")
    with pytest.raises(InputError, match=r"expected a camera 'lft', found none; did you mean 'left'\?"):
        convert(rig, tmp_path / "camera_info.yaml", camera="lft")
    assert not (tmp_path / "camera_info.yaml").exists()


@pytest.mark.parametrize("joint", [True, False])
def test_a_camera_of_a_rig_keeps_the_covariance_of_its_lens(joint, rig, tmp_path):
    prefix = "cameras.right." if joint else ""
    names = tuple(prefix + n for n in ("fx", "x_m", "k1", "rot_x_rad"))
    C = np.diag([4.0, 9.0, 16.0, 25.0]) + 0.5
    block = RigCovariance(("beams.A.point_x_m", *names), np.pad(C, (1, 0))) if joint else RigCovariance(names, C)
    file = load_rig_file(rig)
    save_rig(RigFile(file.rig, {"target" if joint else "cameras.right": block}), rig)
    convert(rig, tmp_path / "camera.yaml", camera="right")
    covariance = load_camera(tmp_path / "camera.yaml").covariance
    assert covariance.names == ("fx", "k1")
    np.testing.assert_array_equal(covariance.matrix, [[4.5, 0.5], [0.5, 16.5]])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<?xml version='1.0'?><opencv_storage/>", "expected YAML, got OpenCV's XML"),
        ("Model = CAHVOR = perspective, distorted\n", "got a CAHVOR model"),
        ("a: 1\n", "expected one of beampose camera.yaml, beampose rig.yaml, OpenCV YAML"),
        ("", "expected one of beampose camera.yaml"),
        ("cam0: [\n", "expected one of beampose camera.yaml"),
    ],
)
def test_a_file_of_unknown_format_is_refused(text, words, tmp_path):
    (tmp_path / "x.dat").write_text(text)
    with pytest.raises(InputError) as caught:
        convert(tmp_path / "x.dat", tmp_path / "camera.yaml")
    assert words in str(caught.value)
    assert not (tmp_path / "camera.yaml").exists()


def test_a_failed_conversion_leaves_the_destination_as_it_was(source, tmp_path):
    save_camera(CameraFile("left", (1280, 1024), K, (0.1,) * 12), source)
    old = tmp_path / "camchain.yaml"
    save_camera(CameraFile("right", (1280, 1024), K, (0.1, 0.0, 0.0, 0.0)), tmp_path / "right.yaml")
    convert(tmp_path / "right.yaml", old)
    before = old.read_text()
    with pytest.raises(InputError, match="kalibr cannot hold this lens"):
        convert(source, old)
    assert old.read_text() == before


@pytest.mark.parametrize(
    "text",
    ["my notes\n", "%YAML:1.0\n---\nbackground: 7\n", "schema: beampose/board/1\nboard: x\n", b"\x89PNG\0\xff"],
)
def test_only_cameras_of_the_same_format_are_overwritten(source, tmp_path, text):
    old = tmp_path / "existing.yml"
    old.write_bytes(text if isinstance(text, bytes) else text.encode())
    before = old.read_bytes()
    for target in ("opencv", "beampose"):
        with pytest.raises(InputError, match=r"exists and is not .*; choose another name, or remove that file first"):
            convert(source, old, to_format=target)
    assert old.read_bytes() == before
    old.write_text("")
    for _ in range(2):  # nothing is lost of an empty file, nor of what an earlier conversion wrote
        convert(source, old)
    assert "opencv-matrix" in old.read_text()


def test_a_folder_as_destination_is_refused_with_a_remedy(source, tmp_path):
    (tmp_path / "a.yml").mkdir()
    with pytest.raises(InputError, match="expected a file to write, found a folder; name a file in it"):
        convert(source, tmp_path / "a.yml")
    with pytest.raises(InputError, match="Is a directory; name a file in it"):
        convert(tmp_path, tmp_path / "b.yml")
    with pytest.raises(InputError, match="No such file or directory; make its folder first"):
        convert(source, tmp_path / "none" / "b.yml")


def test_the_source_and_a_rig_are_not_overwritten(rig, source):
    with pytest.raises(InputError, match="source and destination are the same file"):
        convert(source, source, to_format="opencv")
    with pytest.raises(InputError, match="is a rig; a camera must not replace it"):
        convert(source, rig, to_format="beampose")
    assert rig.read_text() == RIG


def test_a_destination_with_an_unknown_name_needs_a_format(source, tmp_path):
    with pytest.raises(InputError, match="the name does not indicate the format; add --to with one of beampose"):
        convert(source, tmp_path / "left.yaml")
    with pytest.raises(InputError, match=r"--to: expected .*, got 'kalib'; did you mean 'kalibr'\?"):
        convert(source, tmp_path / "left.yaml", to_format="kalib")
    convert(source, tmp_path / "left.yaml", to_format="ros")
    assert recognised_format((tmp_path / "left.yaml").read_text(), tmp_path / "left.yaml") == "ros"


def test_every_format_is_recognised_by_its_content_alone(source, tmp_path):
    for name in FORMATS:
        convert(source, tmp_path / "anything.dat", to_format=name)
        assert recognised_format((tmp_path / "anything.dat").read_text(), tmp_path / "anything.dat") == name
        (tmp_path / "anything.dat").unlink()
