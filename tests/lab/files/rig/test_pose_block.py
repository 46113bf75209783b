"""A rig described in the forms in which laboratories measure it: each is the same rig, and mistakes are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from geometry.pose import Pose, look_at
from geometry.rig import Rig
from lab.errors import InputError
from lab.files.rig.rig_file import RigFile, as_mapping, load_rig, load_rig_file, save_rig
from lab.simulate.scenarios import RIGS

EXACT = 1e-12  # m, and of an entry of a rotation matrix: some roundings of numbers of up to 100 m
SIZE_M = (1.7, 1.1)


def placed(seed: int) -> dict:
    """The rig of the issue in another place and orientation, with screens of SIZE_M."""
    rng = np.random.default_rng(seed)
    world = Pose.from_quaternion(rng.normal(size=4), rng.uniform(-40, 40, 3))
    rig = RIGS["fan"]()
    content = as_mapping(RigFile(rig))
    for name, screen in rig.screens.items():
        moved = world @ screen.world_from_screen
        content["screens"][name] = {"world_from_screen": quaternion_form(moved), "size_m": list(SIZE_M)}
    for name, camera in rig.cameras.items():
        content["cameras"][name]["camera_from_world"] = quaternion_form(camera.camera_from_world @ world.inverse())
    for beam in content["target"]["beams"].values():  # past the origin of the body
        beam["point_m"] = rng.uniform(-0.2, 0.2, 3).tolist()
    return content


def quaternion_form(pose: Pose) -> dict:
    return {"quaternion_wxyz": pose.quaternion_wxyz.tolist(), "translation_m": pose.translation.tolist()}


def matrix_form(pose: Pose) -> dict:
    return {"rotation_matrix": pose.rotation.tolist(), "translation_m": pose.translation.tolist()}


def angles_form(pose: Pose) -> dict:
    return {"yaw_pitch_roll_deg": np.rad2deg(pose.ypr).tolist(), "translation_m": pose.translation.tolist()}


def look_at_form(pose: Pose) -> dict:
    """Of camera_from_world: the centre, a point 3 m along the axis, and up, tilted out of the picture's plane."""
    back = pose.inverse()
    at = lambda point: back.apply(np.array(point, dtype=float)).tolist()  # noqa: E731
    up = back.turn(np.array([0.0, -1.0, 0.4]))
    return {"look_at": {"eye_m": at([0, 0, 0]), "target_m": at([0, 0, 3.0]), "up": up.tolist()}}


def corner_form(pose: Pose) -> dict:
    x, y = np.array(SIZE_M) / 2
    return {"corner_m": [pose.apply(np.array([a, b, 0.0])).tolist() for a, b in ((-x, -y), (x, -y), (-x, y))]}


def written(content: dict, folder: Path) -> Path:
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def pose_of(block: dict) -> Pose:
    return Pose.from_quaternion(np.array(block["quaternion_wxyz"]), np.array(block["translation_m"]))


def assert_same(a: Rig, b: Rig) -> None:
    for x, y in zip(a.screens.values(), b.screens.values(), strict=True):
        np.testing.assert_allclose(x.size_m, y.size_m, rtol=0, atol=EXACT)
        for field in ("rotation", "translation"):
            got, expected = getattr(x.world_from_screen, field), getattr(y.world_from_screen, field)
            np.testing.assert_allclose(got, expected, rtol=0, atol=EXACT)
    for c, d in zip(a.cameras.values(), b.cameras.values(), strict=True):
        np.testing.assert_allclose(c.camera_from_world.rotation, d.camera_from_world.rotation, rtol=0, atol=EXACT)
        # the camera's place: the translation is 40 m times the rotation
        centre, expected = c.camera_from_world.inverse().translation, d.camera_from_world.inverse().translation
        np.testing.assert_allclose(centre, expected, rtol=0, atol=10 * EXACT)
    for p, q in zip(a.beams.values(), b.beams.values(), strict=True):
        np.testing.assert_allclose(p.direction, q.direction, rtol=0, atol=EXACT)


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize(
    ("screen_form", "camera_form"),
    [(matrix_form, matrix_form), (angles_form, angles_form), (corner_form, look_at_form)],
)
def test_each_form_describes_the_same_rig(screen_form, camera_form, seed, tmp_path):
    content = placed(seed)
    rig = load_rig(written(content, tmp_path))
    for screen in content["screens"].values():
        screen["world_from_screen"] = screen_form(pose_of(screen["world_from_screen"]))
        if screen_form is corner_form:
            del screen["size_m"]
    for camera in content["cameras"].values():
        camera["camera_from_world"] = camera_form(pose_of(camera["camera_from_world"]))
    for i, beam in enumerate(content["target"]["beams"].values()):
        d, point = np.array(beam.pop("direction")), np.array(beam["point_m"])
        if i % 2:
            del beam["point_m"]
            beam["points_m"] = [point.tolist(), (point + 0.3 * d).tolist()]
        else:
            beam["azimuth_elevation_deg"] = np.rad2deg(
                [np.arctan2(d[1], d[0]), np.arctan2(d[2], np.hypot(d[0], d[1]))]
            ).tolist()
    assert_same(load_rig(written(content, tmp_path)), rig)


def test_a_rig_is_written_with_quaternions_and_the_measured_form_beside_them(tmp_path):
    content = placed(3)
    corners = corner_form(pose_of(content["screens"]["left"]["world_from_screen"]))
    content["screens"]["left"] = {"world_from_screen": corners}
    file = load_rig_file(written(content, tmp_path))
    save_rig(file, tmp_path / "again.yaml")
    lines = (tmp_path / "again.yaml").read_text().splitlines()
    at = lines.index("  left:") + 1
    assert lines[at].startswith("    # measured as {corner_m: [[")
    assert lines[at + 1] == "    world_from_screen:"
    assert_same(load_rig(tmp_path / "again.yaml"), file.rig)


def test_corners_that_are_not_square_share_their_error(tmp_path):
    content = placed(0)
    slanted = {"corner_m": [[0, 0, 0], [2, 0, 0], [0.02, 1, 0]]}
    content["screens"]["left"] = {"world_from_screen": slanted}
    pose = load_rig(written(content, tmp_path)).screens["left"].world_from_screen
    off = np.arctan(0.02) / 2
    np.testing.assert_allclose(pose.rotation[:, 0], [np.cos(off), -np.sin(off), 0], atol=EXACT)
    np.testing.assert_allclose(pose.translation, [1.01, 0.5, 0], atol=EXACT)


def test_a_camera_looks_at_its_target_with_up_upwards():
    camera = look_at(np.array([1.0, 2.0, 3.0]), np.array([-2.0, 0.0, 1.0]), (0.0, 1.0, 0.0))
    assert camera.apply(np.array([-2.0, 0.0, 1.0])) == pytest.approx([0, 0, np.sqrt(17)])
    assert camera.turn(np.array([0.0, 1.0, 0.0]))[1] < 0  # y of a picture points down


MISTAKES = [
    ("world_from_screen", {"translation_m": [0, 0, 0]}, "expected quaternion_wxyz, rotation_matrix, yaw_pitch_roll_deg"
     " or corner_m, got none of them"),
    ("world_from_screen", {"yaw_pitch_roll_deg": [0, 0, 0]}, "expected translation_m beside yaw_pitch_roll_deg"),
    ("world_from_screen", {"rotation_matrix": [[1, 0, 0], [0, 1, 0]], "translation_m": [0, 0, 0]}, "expected three rows"
     " of three numbers"),
    ("world_from_screen", {"rotation_matrix": [[1, 0, 0], [0, 1, 0], [0, 0, -1]], "translation_m": [0, 0, 0]}, "got a"
     " mirroring"),
    ("world_from_screen", {"rotation_matrix": [[1, 0, 0], [0, 2, 0], [0, 0, 1]], "translation_m": [0, 0, 0]}, "not"
     " perpendicular"),
    ("world_from_screen", {"corner_m": [[0, 0, 0], [1, 0, 0], [1, 1, 0]]}, "expected a right angle at the first corner,"
     " got 45.0 or 135.0 deg"),
    ("world_from_screen", {"corner_m": [[0, 0, 0], [0, 0, 0], [1, 1, 0]]}, "got two at the same place"),
    ("world_from_screen", {"corner_m": [[0, 0, 0], [1, 0, 0], [0, 1, 0]], "translation_m": [0, 0, 0]}, "expected no"
     " translation_m beside corner_m"),
    ("world_from_screen", {"look_at": {}}, "unknown key 'look_at'"),
    ("camera_from_world", {"look_at": {"eye_m": [0, 0, 0], "target_m": [0, 0, 0]}}, "got the same eye_m and target_m"),
    ("camera_from_world", {"look_at": {"eye_m": [0, 0, 0], "target_m": [0, 0, 2]}}, "look_at.up: expected a direction"
     " that is not the line of sight"),
    ("camera_from_world", {"look_at": {"eye_m": [0, 0, 0], "target_m": [1, 0, 2]}, "quaternion_wxyz": [1, 0, 0, 0]},
     "got quaternion_wxyz and look_at; keep one"),
]  # fmt: skip


@pytest.mark.parametrize(("where", "block", "words"), MISTAKES)
def test_a_mistake_in_a_form_is_one_line_with_its_place(where, block, words, tmp_path):
    content = placed(1)
    kind = "screens" if where == "world_from_screen" else "cameras"
    content[kind]["left"][where] = block
    with pytest.raises(InputError) as caught:
        load_rig(written(content, tmp_path))
    (line,) = str(caught.value).splitlines()
    assert f"rig.yaml: {kind}.left.{where}" in line
    assert words in line
