"""`calibrate screen` from files to results, and its error messages."""

from __future__ import annotations

import csv
import datetime
import os
import re
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.boards.board_detection import find_board
from calibration.boards.board_types import Charuco, parse
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.calibrate.screens.screen import DOT_COLUMNS, RESIDUAL_COLUMNS, calibrate_screen
from lab.calibrate.screens.screen_page import camera_covariance
from lab.errors import CalibrationError, InputError
from lab.files.project.point_files import read_point_cloud
from lab.files.rig.camera_file import CameraFile, load_camera, save_camera
from lab.files.rig.rig_file import load_lab_file, load_rig_file, save_screens
from lab.files.text.yaml_text import write_mapping
from lab.findings.finding import Level
from lab.simulate.board_photo import PhotoSettings, photograph
from tests.lab.calibrate.screen_projects import truth, write_project
from tests.lab.files.test_project import TARGET, changed
from tests.lab.tables import rows_of
from tests.marks import needs_open3d
from tests.paths import DATA

BOARD = Charuco(8, 6, 0.15, 0.11, "DICT_4X4_50")


def rewritten(path, change):
    """Rewrite a CSV file with each row (a dict) changed; None removes a row."""
    rows = rows_of(path)
    changed_rows = [r for r in map(change, rows) if r is not None]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(changed_rows)


def scaled(factor):
    return lambda r: {**r, **{k: float(r[k]) * factor for k in ("x_m", "y_m", "z_m")}}


def files_below(folder):
    return sorted(os.listdir(folder)) if folder.is_dir() else None


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    path = write_project(folder / "project", valid_days=30, target=TARGET)
    return folder / "out", calibrate_screen(path, folder / "out", datetime.date(2026, 3, 14))


def test_a_good_survey_passes_and_the_line_states_the_uncertainty(good):
    out, outcome = good
    assert outcome.level in (Level.PASS, Level.WARN)
    warnings = [f.what for f in outcome.findings if f.level == Level.WARN]
    assert all("control points cover" in w for w in warnings), warnings
    assert outcome.exit_status == 0
    assert outcome.line().startswith(f"bay 3: {outcome.level.name}: 2 cameras, 2 screens, surfaces to 0.")
    assert files_below(out) == ["dots.csv", "report.html", "residuals.csv", "rig.yaml", "screens.yaml", "summary.json"]


def test_the_written_poses_are_near_the_truth_and_read_back_unchanged(good):
    out, outcome = good
    file = load_lab_file(out / "screens.yaml")
    for name, camera in truth().cameras.items():
        found = file.rig.cameras[name].camera_from_world.inverse().translation
        assert np.linalg.norm(found - camera.camera_from_world.inverse().translation) < 0.015
    assert str(file.calibration.date) == "2026-03-14"
    assert str(file.calibration.valid_until) == "2026-04-13"
    (covariance,) = file.covariances.values()
    np.testing.assert_array_equal(covariance.matrix, outcome.result.fit.covariance.matrix)
    assert covariance.names == outcome.result.fit.covariance.names
    save_screens("bay 3", file, out.parent / "again.yaml")
    again = load_lab_file(out.parent / "again.yaml")
    for name, screen in file.rig.screens.items():
        assert np.max(np.abs(again.rig.screens[name].world_from_screen.minus(screen.world_from_screen))) < 1e-15
    assert again.calibration == file.calibration
    assert "name: bay 3" in (out.parent / "again.yaml").read_text()


def test_rig_yaml_holds_the_nominal_beams_and_states_that_they_are_not_calibrated(good):
    out, _ = good
    file = load_rig_file(out / "rig.yaml")
    assert list(file.rig.beams) == ["A", "B"]
    assert file.calibration.verdict == "WARN"
    assert "not calibrated" in file.calibration.reasons[0]
    assert "cameras.left.x_m" in file.covariances["target"].names


def test_the_tables_have_a_row_per_observation_and_per_control_point(good):
    out, _ = good
    for name, columns in (("residuals.csv", RESIDUAL_COLUMNS), ("dots.csv", DOT_COLUMNS)):
        rows = rows_of(out / name)
        assert len(rows) == 32
        assert tuple(rows[0]) == columns


def test_the_table_of_control_points_has_their_heights_above_the_surfaces_and_which_were_used(good):
    out, outcome = good
    rows = rows_of(out / "dots.csv")
    for screen in outcome.result.screens:
        mine = [rows[k] for k in screen.control_points]
        heights = [float(r["height_m"]) for r in mine]
        np.testing.assert_allclose(heights, screen.flatness.chosen.heights_m, atol=1e-7)
        assert np.ptp(heights) > 1e-5
        assert [int(r["used"]) for r in mine] == screen.used.astype(int).tolist()


def test_the_report_shows_screens_pixels_and_the_lab(good):
    out, _ = good
    text = (out / "report.html").read_text()
    for words in ("bay 3", "Screen left", "flat", "Cameras, screens and control points", "Correlations", "survey.csv"):
        assert words in text
    assert len(text) < 2_000_000


def test_the_report_states_the_sigma_of_a_cameras_place_in_millimetres(good):
    """By ten thousand draws of its pose from its covariance: the mean over the axes of their spread."""
    out, outcome = good
    text = (out / "report.html").read_text()
    for name, camera in outcome.result.fit.rig.cameras.items():
        chol = np.linalg.cholesky(camera_covariance(outcome.result, name))
        draws = camera.camera_from_world.plus(np.random.default_rng(1).normal(size=(10_000, 6)) @ chol.T)
        spread = 1e3 * np.sqrt(np.mean(np.var(draws.inverse().translation, axis=0)))
        row = re.search(rf"<tr><td[^>]*>{name}</td>(.*?)</tr>", text[text.index("sigma of position (mm)") :], re.DOTALL)
        cells = re.findall(r"<td[^>]*>(.*?)</td>", row[1])
        assert float(cells[2]) == pytest.approx(spread, rel=0.05)


def test_an_earlier_result_is_replaced_but_no_other_folder(good, tmp_path):
    path = write_project(tmp_path / "p", points_each=8)
    calibrate_screen(path, tmp_path / "out")
    calibrate_screen(path, tmp_path / "out")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match="something other"):
        calibrate_screen(path, tmp_path / "mine")
    assert files_below(tmp_path / "mine") == ["thesis.txt"]


def test_a_bent_screen_is_a_warning_and_its_bow_is_written(tmp_path):
    outcome = calibrate_screen(write_project(tmp_path / "p", bow=4e-3), tmp_path / "out")
    assert outcome.level == Level.WARN
    screen = load_lab_file(tmp_path / "out" / "screens.yaml").rig.screens["left"]
    assert abs(screen.bow[0]) == pytest.approx(4e-3, abs=8e-4)
    assert "screens.left.bow_xx_per_m" in outcome.result.fit.covariance.names


def test_a_rough_screen_fails_with_exit_status_3_and_no_yaml_is_written(tmp_path):
    path = write_project(tmp_path / "p")
    rng = np.random.default_rng(0)
    rewritten(tmp_path / "p" / "survey.csv", lambda r: {**r, "x_m": float(r["x_m"]) + 0.008 * rng.normal()})
    outcome = calibrate_screen(path, tmp_path / "out")
    assert outcome.level == Level.FAIL
    assert outcome.exit_status == 3
    assert files_below(tmp_path / "out") == ["dots.csv", "report.html", "residuals.csv", "summary.json"]
    assert "FAIL" in (tmp_path / "out" / "report.html").read_text()


def test_a_lens_covariance_is_propagated_to_the_result(tmp_path):
    path = write_project(tmp_path / "p", points_each=10)
    lens = tmp_path / "p" / "left-camera.yaml"
    file = load_camera(lens)
    save_camera(replace(file, covariance=RigCovariance(("fx", "fy"), np.diag([0.25, 0.25]))), lens)
    fit = calibrate_screen(path, tmp_path / "out").result.fit
    names = fit.covariance.names
    sigma = np.sqrt(fit.covariance.matrix[names.index("cameras.left.fx"), names.index("cameras.left.fx")])
    assert 0.05 < sigma <= 0.5
    assert "cameras.left.k1" not in names
    assert "cameras.right.fx" not in names


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (
            lambda p: rewritten(p / "survey.csv", scaled(1000)),
            r"extend over .* m, its size_m is 2.4 m x 2 m; .*millimetres",
        ),
        (lambda p: rewritten(p / "survey.csv", scaled(1 / 0.0254)), "inches"),
        (
            lambda p: rewritten(p / "survey.csv", lambda r: r if r["point"] in ("L1", "L2", "R1", "R2") else None),
            "point",
        ),
        (
            lambda p: rewritten(p / "points.csv", lambda r: r if r["point"][1:] in ("1", "2", "3") else None),
            "sees 3 surveyed dots, expected 4 or more",
        ),
        (lambda p: rewritten(p / "survey.csv", lambda r: {**r, "y_m": 0.0}), "on one line"),
        (lambda p: rewritten(p / "survey.csv", lambda r: {**r, "z_m": "nan"}), "line 2: z_m: expected a number"),
        (lambda p: (p / "points.csv").write_text(""), "got an empty file"),
        (lambda p: changed(p / "calibration.yaml", points=[]), "no measurement connects the cameras to the screens"),
    ],
)
def test_bad_input_has_its_own_message_and_nothing_is_overwritten(tmp_path, spoil, words):
    path = write_project(tmp_path / "p", points_each=6)
    spoil(tmp_path / "p")
    (tmp_path / "out").mkdir()
    with pytest.raises(InputError, match=words) as caught:
        calibrate_screen(path, tmp_path / "out")
    assert len(str(caught.value).splitlines()) <= 2
    assert files_below(tmp_path / "out") == []


def test_two_cameras_with_one_lens_file_have_a_warning(tmp_path):
    path = write_project(tmp_path / "p", points_each=6)
    changed(path, cameras__right__intrinsics="left-camera.yaml")
    outcome = calibrate_screen(path, tmp_path / "out")
    assert any("share the lens calibration left-camera.yaml" in f.what for f in outcome.findings)


@pytest.mark.slow
def test_swapped_axes_are_reported_if_the_cameras_positions_are_known(tmp_path):
    places = {n: c.camera_from_world.inverse().translation for n, c in truth().cameras.items()}
    path = write_project(tmp_path / "p", points_each=6)
    for name, place in places.items():
        changed(path, **{f"cameras__{name}__near_m": [float(v) for v in place]})
    rewritten(tmp_path / "p" / "survey.csv", lambda r: {**r, "y_m": r["z_m"], "z_m": r["y_m"]})
    with pytest.raises(InputError, match=r"survey.csv: does not fit .* with its columns y and z exchanged does"):
        calibrate_screen(path, tmp_path / "out")


def board_project(folder, seen=True):
    """One screen, one camera, a board of 3 mm fixed to the screen, photographed."""
    rig = truth()
    # Without distortion: rendering a photograph with distortion takes 3 s.
    camera, screen = replace(rig.cameras["left"], distortion=()), rig.screens["left"]
    folder.mkdir()
    save_camera(CameraFile("left", camera.image_size_px, camera.matrix, camera.distortion), folder / "left.yaml")
    lying = screen.world_from_screen @ Pose(np.diag([1.0, -1, -1]), np.array([-0.4, 0.45, 0.003]))
    picture = np.full((1024, 1280), 90, np.uint8)
    if seen:
        picture = photograph(BOARD, camera, lying, look=PhotoSettings(noise_dn=1.0, samples=16)).image
    cv2.imwrite(str(folder / "board.png"), picture)
    fixed = {"board": BOARD.describe(), "offset_m": 0.003, "photos": {"left": "board.png"}}
    write_mapping(
        {
            "schema": "beampose/calibration/1",
            "cameras": {"left": {"intrinsics": "left.yaml", "screen": "left"}},
            "screens": {"left": {"size_m": [2.4, 2.0], "boards": [fixed]}},
        },
        folder / "calibration.yaml",
    )
    return folder / "calibration.yaml", rig


def test_a_board_fixed_to_the_screen_is_sufficient_for_one_camera(tmp_path):
    path, rig = board_project(tmp_path / "p")
    outcome = calibrate_screen(path, tmp_path / "out")
    found = outcome.result.fit.rig
    got = found.cameras["left"].camera_from_world @ found.screens["left"].world_from_screen
    true = rig.cameras["left"].camera_from_world @ rig.screens["left"].world_from_screen
    np.testing.assert_allclose(got.rotation[:, 2], true.rotation[:, 2], atol=3e-3)
    assert abs((got.translation - true.translation) @ true.rotation[:, 2]) < 5e-3
    assert np.median(np.abs(outcome.result.fit.corner_errors_px)) < 0.1


def test_a_photograph_without_the_fixed_board_is_refused(tmp_path):
    path, _ = board_project(tmp_path / "p", seen=False)
    with pytest.raises(CalibrationError, match=r"board.png: .*a board that is fixed to a screen must be found"):
        calibrate_screen(path, tmp_path / "out")


# Scans ------------------------------------------------------------------------------------------------------------


def write_ply(path, points):
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
    )
    rows = "\n".join(" ".join(f"{v:.6g}" for v in p) for p in points)
    path.write_text(f"{head}end_header\n{rows}\n")


@needs_open3d
@pytest.mark.parametrize("kind", ["ply", "xyz"])
def test_a_scan_replaces_the_control_points_of_a_screen(tmp_path, kind):
    rng = np.random.default_rng(0)
    path = write_project(tmp_path / "p", points_each=10)
    screen = truth().screens["right"]
    flat = np.column_stack([rng.uniform(-1.2, 1.2, 4000), rng.uniform(-1, 1, 4000), 1e-3 * rng.normal(size=4000)])
    points = 1000 * screen.world_from_screen.apply(flat)
    if kind == "ply":
        write_ply(tmp_path / "p" / "scan.ply", points)
    else:
        np.savetxt(tmp_path / "p" / "scan.xyz", points, fmt="%.3f")
    changed(path, screens__right__cloud={"file": f"scan.{kind}", "unit": "mm"})
    outcome = calibrate_screen(path, tmp_path / "out")
    found = load_lab_file(tmp_path / "out" / "screens.yaml").rig.screens["right"].world_from_screen
    normal = screen.world_from_screen.rotation[:, 2]
    assert abs(found.rotation[:, 2] @ normal) == pytest.approx(1, abs=1e-6)
    assert abs((found.translation - screen.world_from_screen.translation) @ normal) < 1e-3
    assert "scan" in (tmp_path / "out" / "report.html").read_text()
    assert outcome.exit_status == 0


@needs_open3d
def test_two_scans_of_a_screen_are_aligned_and_points_off_it_left_out(tmp_path):
    rng = np.random.default_rng(0)
    path = write_project(tmp_path / "p", points_each=10)
    screen = truth().screens["right"].world_from_screen
    shift = Pose(np.eye(3), np.array([0.02, -0.01, 0.015]))
    for name, pose in (("a.xyz", Pose.identity()), ("b.xyz", shift)):
        z = 1e-3 * rng.normal(size=9000)
        u, v = rng.uniform(-1.2, 1.2, 9000), rng.uniform(-1, 1, 9000)
        # The screen, and two boards that stand at right angles to it and to each other.
        parts = (
            np.column_stack([u, v, z]),
            np.column_stack([z - 1.5, v, u / 4 + 0.4])[:3000],
            np.column_stack([u / 4, z - 1.3, v / 3 + 0.4])[:3000],
            rng.uniform([-1, -0.8, 0.3], [1, 0.8, 0.8], (40, 3)),
        )
        np.savetxt(tmp_path / "p" / name, pose.apply(screen.apply(np.concatenate(parts))), fmt="%.5f")
    changed(path, screens__right__cloud={"file": "a.xyz", "also": ["b.xyz"]})
    outcome = calibrate_screen(path, tmp_path / "out")
    found = load_lab_file(tmp_path / "out" / "screens.yaml").rig.screens["right"].world_from_screen
    normal = screen.rotation[:, 2]
    assert abs(found.rotation[:, 2] @ normal) == pytest.approx(1, abs=1e-6)
    assert abs((found.translation - screen.translation) @ normal) < 1e-3  # the shift of b is 15 mm along it
    page = (tmp_path / "out" / "report.html").read_text()
    assert "aligned with a.xyz with a scatter of" in page
    assert "points left out: far from all others" in page
    assert outcome.exit_status == 0
    (tmp_path / "p" / "b.xyz").write_text("\n".join(f"{50 + x} {y} 1" for x in range(20) for y in range(20)))
    with pytest.raises(InputError, match=r"b.xyz: 0 % of its points are near the first scan"):
        calibrate_screen(path, tmp_path / "out2")


@needs_open3d
def test_a_scan_in_another_unit_is_reported(tmp_path):
    rng = np.random.default_rng(0)
    path = write_project(tmp_path / "p", points_each=8)
    points = np.column_stack([rng.uniform(-1200, 1200, 3000), rng.uniform(-1000, 1000, 3000), rng.normal(size=3000)])
    np.savetxt(tmp_path / "p" / "scan.xyz", points, fmt="%.3f")
    changed(path, screens__right__cloud={"file": "scan.xyz"})
    with pytest.raises(InputError, match=r"scan.xyz: no plane of .*millimetres"):
        calibrate_screen(path, tmp_path / "out")


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("scan.ply", "", "got an empty file"),
        ("scan.docx", "x", "expected a point cloud"),
        ("scan.xyz", "nothing here\n", "expected lines `x y z`, found none"),
        ("scan.xyz", "1 2 3\n4 5\n", "expected lines `x y z`"),
        ("scan.xyz", "nan nan nan\n", "none with three finite numbers"),
    ],
)
def test_an_unreadable_cloud_is_refused_with_the_reason(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=words):
        read_point_cloud(tmp_path / name, 1.0)


def test_points_without_a_return_are_excluded_and_counted(tmp_path):
    (tmp_path / "scan.xyz").write_text("X Y Z\n1,2,3\nnan,nan,nan\n4,5,6\n")
    points, notes = read_point_cloud(tmp_path / "scan.xyz", 1e-3)
    np.testing.assert_allclose(points, [[0.001, 0.002, 0.003], [0.004, 0.005, 0.006]])
    assert notes == ("scan.xyz: 1 of 3 points left out: not finite",)


def test_without_open3d_the_error_for_a_ply_file_explains_the_installation(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    write_ply(tmp_path / "scan.ply", np.eye(3))
    with pytest.raises(InputError, match=r"scan.ply: this needs Open3D, which is not installed"):
        read_point_cloud(tmp_path / "scan.ply", 1.0)


# Real photographs ---------------------------------------------------------------------------------------------------

STEREO = DATA / "chessboard_stereo_opencv"


@pytest.mark.skipif(not STEREO.is_dir(), reason="the stereo photographs are not available")
def test_real_photographs_of_a_portable_board_connect_two_cameras(tmp_path):
    board = "chessboard:9x6:25mm"
    # The set has a lens file for the left camera only; the right camera's lens is calibrated here by OpenCV.
    seen = [find_board(cv2.imread(str(STEREO / f"right{n:02d}.jpg"), 0), parse(board)) for n in range(1, 8)]
    flat = [parse(board).points.astype(np.float32)] * 7
    _, K, lens, _, _ = cv2.calibrateCamera(flat, [v.pixels.astype(np.float32) for v in seen], (640, 480), None, None)
    save_camera(CameraFile("right", (640, 480), K, tuple(np.ravel(lens).tolist())), tmp_path / "right.yaml")
    photos = {side: [str(STEREO / f"{side}{n:02d}.jpg") for n in range(2, 8)] for side in ("left", "right")}
    on_screen = {"board": board, "photos": {side: str(STEREO / f"{side}01.jpg") for side in photos}}
    write_mapping(
        {
            "schema": "beampose/calibration/1",
            "name": "stereo",
            "cameras": {
                "left": {"intrinsics": str(STEREO / "left_intrinsics.yml"), "screen": "wall"},
                "right": {"intrinsics": "right.yaml", "screen": "wall"},
            },
            "screens": {"wall": {"boards": [on_screen]}},
            "boards": [{"board": board, "photos": photos}],
        },
        tmp_path / "calibration.yaml",
    )
    outcome = calibrate_screen(tmp_path, tmp_path / "out")
    left, right = (c.camera_from_world for c in outcome.result.fit.rig.cameras.values())
    # OpenCV's own stereoCalibrate of these photographs: 83.2 mm.
    assert np.linalg.norm((right @ left.inverse()).translation) == pytest.approx(0.0832, abs=0.001)
    assert len(outcome.result.network.placements) == 7
    assert (tmp_path / "out" / "residuals.csv").read_text().count("\n") > 600


def test_a_camera_far_from_its_near_m_is_reported_first_and_no_name_is_confirmed(tmp_path):
    path = write_project(tmp_path / "p", points_each=6)
    for name, camera in truth().cameras.items():
        place = camera.camera_from_world.inverse().translation
        changed(path, **{f"cameras__{name}__near_m": [float(v) for v in place * [-1, -1, 1]]})
    ended = calibrate_screen(path, tmp_path / "out")
    assert ended.exit_status == 3
    assert "from its `near_m`" in ended.line()
    assert not any("fit their names" in f.what for f in ended.findings)
