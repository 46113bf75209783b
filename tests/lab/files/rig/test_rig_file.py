"""rig.yaml: values, saving and loading, and a line for each mistake."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry.camera import Camera, SensorNoise
from geometry.pose import Pose
from geometry.rig import Beam, Rig, Screen, Spot
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.errors import InputError
from lab.files.rig.rig_file import RigFile, load_rig, load_rig_file, save_rig
from lab.files.text import atomic_write
from lab.files.text.error_text import FileError
from lab.files.text.yaml_text import parse_mapping
from tests.lab.run_folders import RIG

ROUNDING = 1e-15  # of an entry of a rotation matrix or of a direction: some units in the last place of 1
QUATERNION = "quaternion_wxyz: [0.5, -0.5, 0.5, 0.5]"
BEAM_A = "A: {direction: [1.0, 0.0, 0.0], point_m: [0, 0, 0]}"
SPOT_6 = '"6": {beam: C, end: "+", screen: right}'


def written(folder: Path, text: str) -> Path:
    path = folder / "rig.yaml"
    path.write_text(text)
    return path


def test_a_rig_has_the_values_of_its_file(tmp_path):
    rig = load_rig(written(tmp_path, RIG))
    assert list(rig.cameras) == ["left", "right"]
    assert list(rig.spots) == ["1", "2", "3", "4", "5", "6"]
    assert rig.cameras["left"].image_size_px == (64, 48)
    assert rig.cameras["left"].noise == SensorNoise(38.0, 30.0, 8.0)
    assert rig.cameras["right"].distortion == (-0.05, 0.01, 1e-3, 0.0, 0.0)
    assert rig.screens["left"].size_m == (4.0, 3.0)
    assert (rig.spots["2"].beam, rig.spots["2"].sign, rig.spots["5"].sign) == ("B", -1, 1)
    # the contract's example: screen x, y, z = world y, z, x
    np.testing.assert_array_equal(rig.screens["left"].world_from_screen.apply([1, 2, 3]), [3 - 2.5, 1, 2])
    np.testing.assert_allclose(rig.beams["B"].direction, np.array([1, 0.3, 0]) / np.hypot(1, 0.3), rtol=1e-15)


def same(a: Rig, b: Rig) -> None:
    """Fails unless two rigs are equal: rotations and directions to ROUNDING, all else to the last bit."""
    assert list(a.screens) == list(b.screens)
    assert a.spots == b.spots
    for x, y in zip(a.screens.values(), b.screens.values(), strict=True):
        assert x.size_m == y.size_m
        np.testing.assert_allclose(x.world_from_screen.rotation, y.world_from_screen.rotation, rtol=0, atol=ROUNDING)
        np.testing.assert_array_equal(x.world_from_screen.translation, y.world_from_screen.translation)
    for c, d in zip(a.cameras.values(), b.cameras.values(), strict=True):
        assert (c.name, c.screen, c.image_size_px, c.distortion, c.noise) == (
            d.name, d.screen, d.image_size_px, d.distortion, d.noise,
        )  # fmt: skip
        np.testing.assert_array_equal(c.matrix, d.matrix)
        np.testing.assert_allclose(c.camera_from_world.rotation, d.camera_from_world.rotation, rtol=0, atol=ROUNDING)
        np.testing.assert_array_equal(c.camera_from_world.translation, d.camera_from_world.translation)
    for p, q in zip(a.beams.values(), b.beams.values(), strict=True):
        assert p.name == q.name
        np.testing.assert_allclose(p.direction, q.direction, rtol=0, atol=ROUNDING)
        np.testing.assert_array_equal(p.point, q.point)


def test_a_rig_that_is_saved_and_loaded_is_the_same_rig(tmp_path):
    rig = load_rig(written(tmp_path, RIG))
    save_rig(rig, tmp_path / "again.yaml")
    same(rig, load_rig(tmp_path / "again.yaml"))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_saving_and_loading_changes_no_number_of_a_rig(seed, tmp_path_factory):
    """All plain numbers to the last bit; rotation matrices to ROUNDING, as they are written as quaternions."""
    rng = np.random.default_rng(seed)

    def pose() -> Pose:
        return Pose.from_quaternion(rng.normal(size=4), rng.normal(size=3) * 10.0 ** rng.integers(-9, 4))

    rig = Rig(
        screens={"on": Screen("on", pose(), tuple(rng.uniform(1e-3, 9, 2)))},
        cameras={
            "1e-3": Camera(
                "1e-3", "on", (640, 480),
                np.array([[rng.uniform(1, 5e3), 0, rng.normal()], [0, rng.uniform(1, 5e3), rng.normal()], [0, 0, 1]]),
                tuple(rng.normal(size=14) * 1e-3), pose(), SensorNoise(1 / 3, 0.1, -0.7),
            )
        },
        beams={n: Beam(n, rng.normal(size=3), rng.normal(size=3)) for n in ("007", "true")},
        spots={"~": Spot("~", "007", -1, "on"), "0x1": Spot("0x1", "true", 1, "on")},
    )  # fmt: skip
    path = tmp_path_factory.mktemp("rigs") / "rig.yaml"
    save_rig(rig, path)
    back = load_rig(path)
    assert list(back.cameras) == ["1e-3"]
    assert back.spots == rig.spots
    before, after = rig.cameras["1e-3"], back.cameras["1e-3"]
    assert after.distortion == before.distortion
    assert after.noise == before.noise
    np.testing.assert_array_equal(after.matrix, before.matrix)
    np.testing.assert_array_equal(after.camera_from_world.translation, before.camera_from_world.translation)
    turn = after.camera_from_world.rotation - before.camera_from_world.rotation
    assert np.abs(turn).max() <= ROUNDING
    for name in rig.beams:
        np.testing.assert_array_equal(back.beams[name].point, rig.beams[name].point)
        np.testing.assert_allclose(back.beams[name].direction, rig.beams[name].direction, rtol=0, atol=ROUNDING)


def test_covariance_blocks_are_loaded_and_saved(tmp_path):
    block = "    covariance: {parameters: [fx, fy], matrix: [[1.0, 0.1], [0.1, 2.0]]}\n"
    text = RIG.replace("    noise: {gain", block + "    noise: {gain")
    text += "  covariance: {parameters: [A.x], matrix: [[1e-8]]}\n"
    file = load_rig_file(written(tmp_path, text))
    assert set(file.covariances) == {"cameras.left", "target"}
    save_rig(file, tmp_path / "again.yaml")
    again = load_rig_file(tmp_path / "again.yaml")
    assert again.covariances["cameras.left"].names == ("fx", "fy")
    np.testing.assert_array_equal(again.covariances["cameras.left"].matrix, [[1.0, 0.1], [0.1, 2.0]])
    np.testing.assert_array_equal(again.covariances["target"].matrix, [[1e-8]])
    same(load_rig(tmp_path / "again.yaml"), load_rig(written(tmp_path, RIG)))


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = written(tmp_path, RIG)
    rig = load_rig(path)

    def full_disk(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(atomic_write.os, "fsync", full_disk)
    with pytest.raises(InputError, match="cannot be written: No space left"):
        save_rig(RigFile(rig, {"target": RigCovariance(("a",), np.eye(1))}), path)
    assert path.read_text() == RIG
    assert [p.name for p in tmp_path.iterdir()] == ["rig.yaml"]


def test_a_rig_that_could_not_be_loaded_is_not_saved(tmp_path):
    rig = load_rig(written(tmp_path, RIG))
    nowhere = Screen("left", Pose(np.eye(3), np.array([np.nan, 0, 0])))
    with pytest.raises(InputError, match=r"screens\.left\.world_from_screen\.translation_m: expected a finite number"):
        save_rig(Rig({**rig.screens, "left": nowhere}, rig.cameras, rig.beams, rig.spots), tmp_path / "rig.yaml")
    assert (tmp_path / "rig.yaml").read_text() == RIG


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("schema:", "\ufeffschema:"),  # a byte order mark
        ('    "1": {beam: A', "    1: {beam: A"),  # a number as a name
        (
            "fx: 40.0, fy: 40.0, cx: 31.5, cy: 23.5}\n    distortion: []",
            "fx: 4e1, fy: +40, cx: 315e-1, cy: 23.5}\n    distortion: []",
        ),
        (QUATERNION, "quaternion_wxyz: [-0.5, 0.5, -0.5, -0.5]"),  # the same turn
        (QUATERNION, "quaternion_wxyz: [0.5000002, -0.5, 0.5, 0.5]"),  # seven digits are unit enough
        (
            "image_size_px: [64, 48]\n    camera_matrix: {fx: 40.0, fy: 40.0, cx: 31.5, cy: 23.5}\n    distortion: []",
            "image_size_px: [64.0, 48]\n    camera_matrix: {fx: 40.0, fy: 40.0, cx: 31.5, cy: 23.5}",
        ),
        ("\n", "\r\n"),
    ],
)
def test_equivalent_spellings_give_the_same_rig(old, new, tmp_path):
    assert old in RIG
    (tmp_path / "rig.yaml").write_bytes(RIG.replace(old, new).encode())
    rig, plain = load_rig(tmp_path / "rig.yaml"), load_rig(written(tmp_path, RIG))
    assert rig.spots == plain.spots
    for name, camera in plain.cameras.items():
        assert rig.cameras[name].image_size_px == camera.image_size_px
        assert rig.cameras[name].distortion == camera.distortion
        np.testing.assert_array_equal(rig.cameras[name].matrix, camera.matrix)
        turn = rig.cameras[name].camera_from_world.rotation - camera.camera_from_world.rotation
        assert np.abs(turn).max() < 1e-6


def test_names_like_numbers_or_booleans_stay_names(tmp_path):
    text = RIG.replace("screen: right", "screen: on").replace("  right:\n    world", "  on:\n    world")
    text = text.replace("beam: A", "beam: 007").replace("    A: {", "    007: {")
    rig = load_rig(written(tmp_path, text))
    assert set(rig.screens) == {"left", "on"}
    assert rig.spots["1"].beam == "007"


# (what is replaced, by what, the words that the message must have)
BROKEN = [
    (
        "schema: beampose/rig/1",
        "schema: beampose/rig/2",
        "rig.yaml: schema: expected 'beampose/rig/1', got 'beampose/rig/2'",
    ),
    ("schema: beampose/rig/1\n", "", "rig.yaml: schema: expected 'beampose/rig/1', got nothing"),
    (
        "schema: beampose/rig/1",
        "schema: [",
        "rig.yaml: line 1: expected YAML, found a bracket that is not closed, or a missing comma",
    ),
    ("screens:\n", "screens:\n\t", "rig.yaml: line 3: expected YAML, found a tab; indent with spaces"),
    ("  beams:\n", "  beams: {}\n  old:\n", "target: unknown key 'old'; known: beams, spots, covariance"),
    ("target:\n", "taget:\n", "rig.yaml: unknown key 'taget'; did you mean 'target'?"),
    ("    distortion: []", "    distorsion: []", "cameras.left: unknown key 'distorsion'; did you mean 'distortion'?"),
    ("    distortion: []", "    Distortion: []", "cameras.left: unknown key 'Distortion'; did you mean 'distortion'?"),
    (
        "    distortion: []",
        "    distortion: [1, 2, 3]",
        "cameras.left.distortion: expected 0, 4, 5, 8, 12 or 14 numbers, got 3",
    ),
    (
        "    distortion: []",
        "    distortion: 0.1",
        "cameras.left.distortion: expected a list of 0, 4, 5, 8, 12 or 14 numbers, got 0.1",
    ),
    (
        "    distortion: []",
        "    distortion: [0, 0, 0, .nan]",
        "cameras.left.distortion: expected a finite number, got nan",
    ),
    ("-0.05, 0.01,", "-0.05, true,", "cameras.right.distortion: expected a finite number, got true"),
    ("-0.05, 0.01,", "-0.05, 0..1,", "cameras.right.distortion: expected a finite number, got '0..1'"),
    (
        "translation_m: [-2.5, 0, 0]",
        "translation_m: [-2.5, 0]",
        "screens.left.world_from_screen.translation_m: expected 3 numbers, got 2",
    ),
    (
        "translation_m: [-2.5, 0, 0]",
        "translation_m: [-.inf, 0, 0]",
        "translation_m: expected a finite number, got -inf",
    ),
    (
        "translation_m: [-2.5, 0, 0]",
        "translation_mm: [-2500, 0, 0]",
        "unknown key 'translation_mm'; did you mean 'translation_m'?",
    ),
    (
        QUATERNION,
        "quaternion_wxyz: [1, 1, 0, 0]",
        "cameras.left.camera_from_world.quaternion_wxyz: expected a quaternion of length 1, got one of length 1.414214",
    ),
    (QUATERNION, "quaternion_wxyz: [0, 0, 0, 0]", "expected a quaternion of length 1, got one of length 0"),
    (
        QUATERNION,
        "quaternion_wxyz: [0.50001, -0.5, 0.5, 0.5]",
        "expected a quaternion of length 1, got one of length 1.000005",
    ),
    (QUATERNION, "quaternion_wxyz: 1", "quaternion_wxyz: expected a list of 4 numbers, got 1"),
    (
        f"camera_from_world: {{{QUATERNION}, translation_m: [0, 0.4, 0]}}",
        "camera_from_world: [1, 2]",
        "cameras.left.camera_from_world: expected a mapping with quaternion_wxyz, rotation_matrix, yaw_pitch_roll_deg,"
        " translation_m, look_at, got [1, 2]",
    ),
    (
        "noise: {gain_e_per_dn: 38.0",
        "noise: {gain_e_per_dn: 0",
        "cameras.left.noise.gain_e_per_dn: expected a number above 0, got 0",
    ),
    (
        "read_noise_e: 30.0",
        "read_noise_e: -1",
        "cameras.left.noise.read_noise_e: expected a number of 0 or more, got -1",
    ),
    (
        BEAM_A,
        "A: {direction: [0, 0, 0], point_m: [0, 0, 0]}",
        "target.beams.A.direction: expected a direction, not the zero vector",
    ),
    (BEAM_A, "A: {direction: [1, 0, 0]}", "target.beams.A: expected point_m beside direction, got nothing"),
    (
        BEAM_A,
        "A:",
        "target.beams.A: expected a mapping with direction, azimuth_elevation_deg, points_m, point_m, got nothing",
    ),
    (BEAM_A, f"{BEAM_A}\n    {BEAM_A}", "expected YAML, found the key 'A' a second time"),
    (
        '"1": {beam: A, end: "-"',
        '"1": {beam: D, end: "-"',
        "target.spots.1.beam: expected a beam of this file, got 'D'; known: A, B, C",
    ),
    (
        '"1": {beam: A, end: "-", screen: left}',
        '"1": {beam: A, end: "-", screen: lft}',
        "target.spots.1.screen: expected a screen of this file, got 'lft'; did you mean 'left'?",
    ),
    (SPOT_6, SPOT_6.replace('"+"', "1"), "target.spots.6.end: expected '+' or '-', got 1"),
    (SPOT_6, SPOT_6.replace('"+"', "plus"), "target.spots.6.end: expected '+' or '-', got 'plus'"),
    (
        SPOT_6,
        '"6":\n      beam: C\n      end: -\n      screen: right',
        'expected YAML, found a lone minus; quote it: "-"',
    ),
    (
        SPOT_6,
        SPOT_6.replace("C", "A"),
        "target.spots.6: expected one spot per beam end, got beam 'A' end '+' a second time (spot '4' has it)",
    ),
    (SPOT_6, f"{SPOT_6}\n    6: {{beam: C, end: '+', screen: right}}", "the key '6' a second time"),
    (SPOT_6, SPOT_6.replace("C, ", "null, "), "target.spots.6.beam: expected a word, got nothing"),
]


@pytest.mark.parametrize(("old", "new", "words"), BROKEN)
def test_a_mistake_is_one_line_with_field_expected_and_found(old, new, words, tmp_path):
    assert old in RIG
    path = written(tmp_path, RIG.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        load_rig(path)
    message = str(caught.value).replace(f"{tmp_path}/", "")
    assert words in message
    assert message.startswith("rig.yaml: ")
    assert len(message.splitlines()) <= 2
    assert caught.value.exit_status == 2


# Fields that stand twice in the small lab are broken everywhere.
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("size_m: [4.0, 3.0]", "size_m: [4.0, -3.0]", "screens.left.size_m: expected a number above 0, got -3.0"),
        (
            "image_size_px: [64, 48]",
            "image_size_px: [64.5, 48]",
            "cameras.left.image_size_px: expected a whole number, got 64.5",
        ),
        (
            "image_size_px: [64, 48]",
            "image_size_px: [64, 0]",
            "image_size_px: expected a width and a height of at least 1 pixel, got [64, 0]",
        ),
        ("image_size_px: [64, 48]", "image_size_px: 64x48", "image_size_px: expected a list of 2 numbers, got '64x48'"),
        ("fx: 40.0", "fx: -40.0", "cameras.left.camera_matrix.fx: expected a number above 0, got -40.0"),
        ("cy: 23.5", "cy: '23,5'", "cameras.left.camera_matrix.cy: expected a finite number, got '23,5'"),
        (
            "    screen: left\n",
            "    screen: lefft\n",
            "cameras.left.screen: expected a screen of this file, got 'lefft'; did you mean 'left'?",
        ),
        ("    screen: left\n", "", "cameras.left.screen: expected a value, got nothing"),
    ],
)
def test_the_first_of_several_mistakes_is_shown_and_the_rest_counted(old, new, words, tmp_path):
    assert old in RIG
    with pytest.raises(FileError) as caught:
        load_rig(written(tmp_path, RIG.replace(old, new)))
    assert words in str(caught.value)
    assert words in caught.value.lines[0]
    more = len(caught.value.lines) - 1
    assert more == RIG.count(old) - 1
    assert (f"and {more} more" in str(caught.value)) == (more > 0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "rig.yaml: expected `key: value` lines, got nothing"),
        ("- 1\n- 2\n", "rig.yaml: expected `key: value` lines, got a list"),
        ("just words", "rig.yaml: expected `key: value` lines, got other text"),
        ("a: 1\n---\nb: 2\n", "rig.yaml: line 2: expected YAML, found another document"),
        ("a: *nothing\n", "rig.yaml: line 1: expected YAML, found undefined alias 'nothing'"),
        ("a: !!python/object/apply:os.getcwd []\n", "rig.yaml: line 1: expected YAML, found a tag of another program"),
        ("\x00", "rig.yaml: expected YAML, found unacceptable character"),
        ("[" * 5000, "rig.yaml: line 1: expected YAML, found a nesting deeper than 60 levels"),
    ],
)
def test_a_file_that_is_not_a_rig_is_refused(text, words, tmp_path):
    with pytest.raises(InputError) as caught:
        load_rig(written(tmp_path, text))
    assert words in str(caught.value).replace(f"{tmp_path}/", "")


def test_a_missing_file_and_a_binary_file_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"rig\.yaml: expected a file, found none; check the path"):
        load_rig(tmp_path / "rig.yaml")
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        load_rig(tmp_path)
    (tmp_path / "rig.yaml").write_bytes("name: Prüfstand".encode("latin-1"))
    with pytest.raises(InputError, match="expected UTF-8 text, got an invalid byte at position 8"):
        load_rig(tmp_path / "rig.yaml")


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_beams_are_refused(count, tmp_path):
    head, _ = RIG.split("  beams:\n")
    beams = "  beams: {" + "A: {direction: [1, 0, 0], point_m: [0, 0, 0]}" * count + "}\n"
    spots = '  spots: {1: {beam: A, end: "+", screen: right}}\n'
    with pytest.raises(InputError, match=f"target.beams: expected two or more, got {count}; one line does not"):
        load_rig(written(tmp_path, head + beams + spots))


@pytest.mark.parametrize(
    ("block", "words"),
    [
        ("{parameters: [a, b], matrix: [[1]]}", "expected a matrix row for each of 2 parameters, got 1"),
        ("{parameters: [a], matrix: [[1, 2]]}", "covariance.matrix: expected a square matrix, as a list of rows"),
        ("{parameters: a, matrix: [[1]]}", "covariance.parameters: expected a list of parameter names, got 'a'"),
        ("{parameters: [a], matrix: [[.nan]]}", "covariance.matrix: expected a finite number, got nan"),
    ],
)
def test_a_covariance_block_needs_names_and_a_square_matrix(block, words, tmp_path):
    with pytest.raises(InputError) as caught:
        load_rig(written(tmp_path, RIG + f"  covariance: {block}\n"))
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("rig: a\nrate 100\nname: b\n", 2, "text without a colon"),
        ("rig:a\nrate: 1\n", 2, "a space after the colons of this line and the one above"),
        ("a: 1\n  b: 2\n", 2, "indent them alike"),
        ("a: b: c\n", 1, "quote a text that holds a colon"),
        ("a: [1, 2\nb: 3\n", 1, "a bracket that is not closed"),
        ("a: {b: 1 c: 2}\n", 1, "or a missing comma"),
        ("a: 1\nb: 'x\nc: 1\n", 2, "a quote that is not closed"),
        ("a: it\nb: 'it's'\n", 2, "check indents, brackets and quotes"),
        ("a:\n    b: 1\n  c: 2\n", 3, "check indents, brackets and quotes"),
        ("a: {b: 1,, c: 2}\n", 1, "a comma or a bracket in place of a value"),
        ("a: @x\n", 1, "a value that begins with @; quote it"),
        ('a: "C:\\lab\\rig.yaml"\n', 1, "use single quotes, or / between folders"),
        ("a: -\n", 1, 'a lone minus; quote it: "-"'),
    ],
)
def test_a_mistake_of_yaml_is_named_in_its_line_and_in_the_words_of_the_user(text, line, words):
    with pytest.raises(InputError) as error:
        parse_mapping(text, "f")
    assert f"f: line {line}: expected YAML, found " in str(error.value)
    assert words in str(error.value)
    assert not re.search("<|token|stream|node|found expected|, but", str(error.value))
