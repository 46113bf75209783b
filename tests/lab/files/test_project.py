"""calibration.yaml and its tables: values and error messages."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.boards.board_types import Chessboard
from lab.errors import InputError
from lab.files.project.point_files import read_observations, read_poses, read_survey
from lab.files.project.project import load_project, placement_of
from lab.files.rig.board_file import save_board
from lab.files.text.csv_text import MAX_SCAN_COORDINATE
from lab.files.text.yaml_text import read_mapping, write_mapping
from tests.lab.calibrate.screen_projects import write_project

TARGET = {
    "beams": {
        "A": {"direction": [1.0, 0.0, 0.0], "point_m": [0, 0, 0]},
        "B": {"direction": [1.0, 0.3, 0.0], "point_m": [0, 0, 0]},
    },
    "spots": {"1": {"beam": "A", "end": "-", "screen": "left"}, "2": {"beam": "B", "end": "+", "screen": "right"}},
}
POSE = {"quaternion_wxyz": [1.0, 0.0, 0.0, 0.0], "translation_m": [0.1, 0.2, 0.3]}


def changed(path, **changes):
    """The project with some keys changed: `a__b=value` for nested ones."""
    content = read_mapping(path)
    for place, value in changes.items():
        block = content
        *inner, last = place.split("__")
        for key in inner:
            block = block[key]
        block[last] = value
    write_mapping(content, path)
    return path


def test_a_project_has_the_values_of_its_file(tmp_path):
    (tmp_path / "poses.csv").write_text("frame,t_s,x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,0,0,1,0,0,0\n")
    (tmp_path / "spots.csv").write_text("frame,camera,spot,u_px,v_px\n")
    path = write_project(
        tmp_path,
        target=TARGET,
        valid_days=90,
        stand={"world_from_stand": POSE, "sigma_m": 0.001, "sigma_deg": 0.1, "pose_sigma_deg": 0.01},
        recordings=[{"spots": "spots.csv", "poses": "poses.csv"}],
    )
    project = load_project(path)
    assert (project.name, str(project.date), project.valid_days) == ("bay 3", "2026-03-14", 90)
    assert list(project.cameras) == list(project.screens) == ["left", "right"]
    assert project.cameras["left"].lens.image_size_px == (1280, 1024)
    assert project.screens["right"].size_m == (2.4, 2.0)
    assert list(project.beams) == ["A", "B"]
    assert project.spots["1"].sign == -1
    assert project.stand.sigma_rad == pytest.approx(np.radians(0.1))
    np.testing.assert_array_equal(project.stand.world_from_stand.pose().translation, [0.1, 0.2, 0.3])
    assert project.recordings[0].poses == tmp_path / "poses.csv"
    tables = {"survey.csv", "points.csv", "spots.csv", "poses.csv"}
    lenses = {"left-camera.yaml", "right-camera.yaml"}
    assert {p.name for p in project.inputs} == {"calibration.yaml"} | lenses | tables
    assert load_project(tmp_path).path == path


def board(photos):
    return {"boards": [{"board": "chessboard:9x6:25mm", "photos": photos}]}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"schema": "beampose/calibraton/1"}, "schema: expected 'beampose/calibration/1'"),
        ({"survay": "survey.csv"}, "unknown key 'survay'; did you mean 'survey'?"),
        (
            {"cameras__left__screen": "lft"},
            "cameras.left.screen: expected a screen of this file, got 'lft'; did you mean",
        ),
        (
            {"cameras__left__intrinsics": "left-camra.yaml"},
            "cameras.left.intrinsics: .* did you mean 'left-camera.yaml'",
        ),
        ({"survey": "survey2.csv"}, "calibration.yaml: survey: expected a file, found none"),
        ({"survey": "."}, "calibration.yaml: survey: expected a file, found a folder at .*; name a file in it"),
        ({"points": ["points.csv", "pts.csv"]}, "calibration.yaml: points.1: expected a file, found none"),
        ({"name": "../../x y"}, r"name: expected a name without / and \\, got '../../x y'"),
        ({"cameras": {"a/b": {"screen": "left", "intrinsics": "left-camera.yaml"}}}, "expected a name without /"),
        ({"screens__left__size_m": [4.0, -3.0]}, "screens.left.size_m: expected a number above 0, got -3.0"),
        ({"screens__left__bow": "maybe"}, "screens.left.bow: expected 'auto', 'always' or 'never', got 'maybe'"),
        ({"screens": {}}, "screens: expected one or more, got none"),
        ({"world": "ceiling"}, "world: expected a screen of this file, got 'ceiling'"),
        ({"valid_days": 0}, "valid_days: expected a whole number of days"),
        ({"date": "14 March"}, "date: expected a date such as 2026-03-14"),
        ({"stand": {"sigma_m": 0.1}}, "stand: sigma_m, sigma_deg: expected world_from_stand"),
        ({"recordings": [{"poses": "p.csv"}]}, "recordings.0: expected run or spots, got neither"),
        ({"recordings": [{"run": "nowhere"}]}, "recordings.0.run: expected a run folder, found no run.yaml"),
        ({"boards": [{"board": "chesboard:9x6:25mm", "photos": {}}]}, r"boards.0.board: .*did you mean 'chessboard'"),
        (board({"left": "l/*.png"}), r"boards.0.photos.left: expected photographs, found none for 'l/\*.png'"),
        (board({"top": "survey.csv"}), "boards.0.photos.top: expected a camera of this file"),
        ({"screens__left__cloud": {"file": "survey.csv", "unit": "yd"}}, "screens.left.cloud.unit: expected 'm', 'cm'"),
        (
            {"target": {**TARGET, "spots": {"1": {"beam": "C", "end": "-", "screen": "left"}}}},
            "target.spots.1.beam: expected a beam",
        ),
    ],
)
def test_mistakes_name_file_field_and_remedy(tmp_path, changes, words):
    path = changed(write_project(tmp_path), **changes)
    with pytest.raises(InputError, match=words) as caught:
        load_project(path)
    assert str(caught.value).startswith(str(path))


def test_a_board_may_be_named_by_its_file(tmp_path):
    path = write_project(tmp_path)
    save_board(Chessboard(9, 6, 0.025), tmp_path / "board.yaml")
    (tmp_path / "left-1.png").write_bytes(b"")
    project = load_project(changed(path, boards=[{"board": "board.yaml", "photos": {"left": "left-*.png"}}]))
    assert project.boards[0].board == Chessboard(9, 6, 0.025)
    with pytest.raises(InputError, match=r"boards.0.board: .*other.yaml"):
        load_project(changed(path, boards=[{"board": "other.yaml", "photos": {"left": "left-*.png"}}]))


def test_lenses_come_from_exchange_formats_too(tmp_path):
    path = write_project(tmp_path)
    (tmp_path / "left.yaml").write_text(
        "cam0:\n  camera_model: pinhole\n  intrinsics: [1180.0, 1181.0, 639.5, 511.5]\n  distortion_model: radtan\n"
        "  distortion_coeffs: [-0.1, 0.02, 0.0, 0.0]\n  resolution: [1280, 1024]\n  rostopic: /cam0\n"
    )
    lens = load_project(changed(path, cameras__left__intrinsics="left.yaml")).cameras["left"].lens
    assert lens.camera_matrix[1, 1] == 1181.0
    assert lens.distortion[:2] == (-0.1, 0.02)


@pytest.mark.parametrize(
    ("name", "placement"), [("left07.jpg", "000007"), ("cam1-shot12.png", "000012"), ("a.png", "a")]
)
def test_the_last_number_of_a_name_is_the_placement(tmp_path, name, placement):
    assert placement_of(tmp_path / name) == placement


SURVEY = "point,x_m,y_m,z_m,sigma_x_m,sigma_y_m,sigma_z_m,screen\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "got an empty file"),
        (SURVEY, "expected rows .* below the header, got none"),
        ("point,x,y,z\nP1,0,0,0\n", r"expected a column 'x_m', got point,x,y,z"),
        (SURVEY + "P1,0,0,nan,,,,\n", "line 2: z_m: expected a number, got 'nan'"),
        (SURVEY + "P1,0,0,a lot,,,,\n", "line 2: z_m: expected a number, got 'a lot'"),
        (SURVEY + "P1,0,0\n", "line 2: z_m: expected a number, got nothing"),
        (
            SURVEY + "P1,0,0,0,,,,\nP2,0,1e300,0,,,,\n",
            "line 3: y_m: expected metres, within 10 km of .* got 1e\\+300; ",
        ),
        (SURVEY + "P1,0,0,0,0.3mm,,,\n", "line 2: sigma_x_m: expected a number above 0, got '0.3mm'; leave the field"),
        (SURVEY + "P1,0,0,0,,nan,,\n", "line 2: sigma_y_m: expected a number above 0, got 'nan'"),
        (SURVEY + "P1,0,0,0,,,1e300,\n", "line 2: sigma_z_m: expected .* up to 10000 m, got 1e\\+300"),
        (SURVEY.replace("screen", "x_m") + "P1,0,0,0,,,,\n", "each column once, got 'x_m' twice in the header"),
        (SURVEY.replace(",", ";"), "expected columns separated by commas, got semicolons; separate columns"),
        (SURVEY.encode("utf-16"), "not text in UTF-8; save it as CSV"),
        (b"\x89PNG\r\n\0\0", "not text in UTF-8; save it as CSV"),
        (SURVEY.encode() + b"P\xfcnkt,0,0,0,,,,\n", "line 2: expected text in UTF-8, got an invalid byte; save"),
        (
            SURVEY + "P1,0,0,0,,,,\nP1,1,0,0,,,,\n",
            r"line 3: .* each point once, got 'P1' again \(first in survey.csv, line 2\)",
        ),
        (SURVEY + "P1,0,0,0,0,1,1,\n", "line 2: sigma_x_m: expected a number above 0, got 0"),
        (SURVEY + "P1,0,0,0,,,,lefd\n", "line 2: screen: .* got 'lefd'; did you mean 'left'"),
        (SURVEY + ",0,0,0,,,,\n", "line 2: point: expected a name"),
        (SURVEY + "P1,0,0,0,,,,\nP2,1,5,0,0,1,1,1,left,9\n", "line 3: expected 8 fields as in the header, got more"),
    ],
)
def test_an_unusable_survey_is_refused_with_line_and_reason(tmp_path, text, words):
    path = tmp_path / "survey.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=words) as caught:
        read_survey([path], ["left", "right"])
    assert str(caught.value).isprintable()  # nothing of a binary file goes to the terminal


def test_only_an_empty_sigma_counts_as_unknown(tmp_path):
    (tmp_path / "points.csv").write_text(POINTS + "left,P1,2560,1,\nleft,P2,-1280,1,0.3\n")
    with pytest.raises(InputError, match="of the survey, which has none, got 'P1'; add `survey`"):
        read_observations([tmp_path / "points.csv"], {"left": (1280, 1024)}, [])
    seen = read_observations([tmp_path / "points.csv"], {"left": (1280, 1024)}, ["P1", "P2"])
    assert seen.sigma_px.tolist() == [0.2, 0.3]
    (tmp_path / "poses.csv").write_text(f"{POSES},sigma_x_m\n0,,0,0,0,1,0,0,0,\n1,,0,0,0,1,0,0,0,0.1 mm\n")
    with pytest.raises(InputError, match=r"line 3: sigma_x_m: expected 0 or more, got '0.1 mm'; leave the field empty"):
        read_poses(tmp_path / "poses.csv")


def test_targets_of_a_scan_may_be_millimetres_in_a_national_grid(tmp_path):
    path = tmp_path / "targets.csv"
    path.write_text("point,x_m,y_m,z_m\n1,3500000,5400000,21000\n")
    assert read_survey([path], [], MAX_SCAN_COORDINATE).xyz[0, 1] == 5.4e6
    with pytest.raises(InputError, match=r"line 2: x_m: expected metres, within 10 km .*are these millimetres"):
        read_survey([path], [])


def test_a_survey_without_sigmas_gets_a_millimetre_which_is_noted(tmp_path):
    path = tmp_path / "survey.csv"
    path.write_text("point,x_m,y_m,z_m\n1,0,0,0\n2,1,0,0\n")
    survey = read_survey([path], [])
    assert survey.names == ("1", "2")
    np.testing.assert_allclose(survey.covariance[0], np.eye(3) * 1e-6)
    assert "1 mm is assumed" in survey.notes[0]


POINTS = "camera,point,u_px,v_px,sigma_px\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            POINTS + "lft,P1,1,2,0.1\n",
            "line 2: camera: expected a camera of the project, got 'lft'; did you mean 'left'",
        ),
        (POINTS + "left,P9,1,2,0.1\n", "line 2: point: expected a point of the survey, got 'P9'; known: P1, P2"),
        (POINTS + "left,P1,1,2,0.1\nleft,P1,1,2,0.1\n", "line 3: expected each point once per camera"),
        (POINTS + "left,P1,,2,0.1\n", "line 2: u_px: expected a number"),
        (POINTS + "left,P1,1,2,-1\n", "line 2: sigma_px: expected a number above 0, got -1"),
        (POINTS + "left,P1,1,2,abc\n", "line 2: sigma_px: expected a number above 0, got 'abc'"),
        (
            POINTS + "left,P1,1e300,2,0.1\n",
            "line 2: u_px: expected .* 'left' .1280 x 1024 px., got 1e\\+300; correct it",
        ),
        (POINTS + "left,P1,1,-5e6,0.1\n", "line 2: v_px: expected a pixel in or near the picture .* got -5000000; "),
        (POINTS + "left,P1,2561,1,0.1\n", "line 2: u_px: expected a pixel in or near the picture"),
    ],
)
def test_unusable_points_are_refused_with_line_and_reason(tmp_path, text, words):
    path = tmp_path / "points.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_observations([path], {"left": (1280, 1024)}, ["P1", "P2"])


POSES = "frame,t_s,x_m,y_m,z_m,qw,qx,qy,qz"


def test_poses_of_a_stand_are_read_with_their_sigmas(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text(f"{POSES},sigma_rot_z_deg\n3,0,1,2,3,1,0,0,0,0.1\n5,1,1,2,3,0,0,0,1,\n")
    poses = read_poses(path)
    np.testing.assert_array_equal(poses.frames, [3, 5])
    np.testing.assert_allclose(poses.stand_from_body.rotation[1], np.diag([-1, -1, 1]))
    assert poses.sigmas[0, 5] == pytest.approx(np.radians(0.1))
    assert np.isnan(poses.sigmas[1]).all()


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("0,0,0,0,0,1,0,0,0\n0,1,0,0,0,1,0,0,0\n", "line 3: frame: expected rising numbers"),
        (
            "0,0,0,0,0,1,1,0,0\n",
            "line 2: .*quaternion of length 1, got one of length 1.414214; give all digits, or divide",
        ),
        ("0,0,0,0,0,0,0,0,0\n", "line 2: .*got one of length 0; without rotation it is 1,0,0,0"),
        ("0,0,0,inf,0,1,0,0,0\n", "line 2: y_m: expected a number, got inf"),
        ("0,0,0,1e300,0,1,0,0,0\n", "line 2: y_m: expected metres, within 10 km"),
        ("0,later,0,0,0,1,0,0,0\n", "line 2: t_s: expected seconds, got 'later'"),
    ],
)
def test_invalid_poses_are_refused(tmp_path, rows, words):
    path = tmp_path / "poses.csv"
    path.write_text(f"{POSES}\n{rows}")
    with pytest.raises(InputError, match=words):
        read_poses(path)


def test_a_folder_that_is_no_project_is_said_to_be_none(tmp_path):
    with pytest.raises(InputError, match=r"expected a folder with a calibration.yaml, found none in it; `beampose cal"):
        load_project(tmp_path)
