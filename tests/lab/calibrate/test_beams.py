"""`calibrate beams` from tables or runs to rig.yaml, tables and report, and its error messages."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
import yaml

from calibration.terms.rig_blocks import SpotPixels
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance, rig_names
from lab.calibrate.beams.beams import calibrate_beams
from lab.calibrate.beams.beams_page import bad_positions
from lab.calibrate.beams.recordings import (
    SpotRows,
    average,
    limit_frames,
    mean_of_frames,
    positions_at_rest,
    read_recordings,
)
from lab.errors import CalibrationError, InputError
from lab.files.project.project import load_project
from lab.files.rig.camera_file import CalibrationState, CameraFile, save_camera
from lab.files.rig.rig_file import (
    RigFile,
    as_mapping,
    covariance_blocks,
    joint_covariance,
    load_rig_file,
    save_rig,
    save_screens,
)
from lab.files.run.run_file import save_run
from lab.files.text.yaml_text import write_mapping
from lab.findings.finding import Level
from lab.simulate.scenarios import RIGS
from tests.calibration.beams.bench import ARCSEC, WORLD_FROM_STAND, drawn, errors, positions, recorded
from tests.lab.tables import rows_of

STAND = {
    "world_from_stand": {
        "quaternion_wxyz": WORLD_FROM_STAND.quaternion_wxyz.tolist(),
        "translation_m": WORLD_FROM_STAND.translation.tolist(),
    },
    "sigma_m": 1e-4,
    "sigma_deg": 0.002,
    "pose_sigma_m": 2e-5,
    "pose_sigma_deg": 0.001,
}


def lab_covariance(rig: Rig) -> RigCovariance:
    """Small errors of cameras and screens, as a covariance to be propagated."""
    names = [n for n in rig_names(rig) if n.startswith(("cameras.", "screens.")) and n.endswith(("_m", "_rad", "fx"))]
    sigma = [0.5 if n.endswith("fx") else 1e-4 if n.endswith("_m") else 3e-5 for n in names]
    return RigCovariance(tuple(names), np.diag(np.square(sigma)))


def write_poses(path: Path, poses: Pose) -> None:
    lines = ["frame,t_s,x_m,y_m,z_m,qw,qx,qy,qz"]
    for k in range(len(poses.translation)):
        numbers = [*poses.translation[k], *poses.quaternion_wxyz[k]]
        lines.append(f"{k},{k}," + ",".join(repr(float(v)) for v in numbers))
    path.write_text("\n".join(lines) + "\n")


def write_spots(path: Path, rig: Rig, spots: SpotPixels) -> None:
    views = rig.views()
    lines = ["position,camera,spot,u_px,v_px,sigma_px"]
    for k, v, uv, cov in zip(spots.position, spots.view, spots.pixels, spots.covariance, strict=True):
        lines.append(f"{k},{views[v][0]},{views[v][1]},{uv[0]},{uv[1]},{np.sqrt(cov[0, 0])}")
    path.write_text("\n".join(lines) + "\n")


def write_project(folder: Path, rig: Rig, nominal: Rig, stand: dict | None, recordings: list[dict]) -> Path:
    """A project with calibrated cameras and screens (rig.yaml) and the nominal beams as its target."""
    save_rig(
        RigFile(rig, {k: v for k, v in covariance_blocks(lab_covariance(rig)).items() if k != "target"}),
        folder / "rig.yaml",
    )
    cameras = {}
    for name, c in rig.cameras.items():
        save_camera(CameraFile(name, c.image_size_px, c.matrix, c.distortion), folder / f"{name}.camera.yaml")
        cameras[name] = {"intrinsics": f"{name}.camera.yaml", "screen": c.screen}
    content = {
        "schema": "beampose/calibration/1",
        "name": "beams in march",
        "valid_days": 90,
        "cameras": cameras,
        "screens": {n: {} for n in rig.screens},
        "target": as_mapping(RigFile(nominal))["target"],
        "recordings": recordings,
    }
    if stand is not None:
        content["stand"] = stand
    write_mapping(content, folder / "calibration.yaml")
    return folder / "calibration.yaml"


@pytest.fixture(scope="module")
def first_campaign(tmp_path_factory) -> Path:
    """A project with 40 recorded positions of a rig whose beams differ from the nominal ones."""
    folder = tmp_path_factory.mktemp("campaign")
    rng = np.random.default_rng(1)
    rig = RIGS["unequal-fan"]()
    poses = positions(rng)
    spots = recorded(rng, rig, poses)
    nominal = drawn(rig, rng, 0.005, 0.003)
    write_spots(folder / "spots.csv", rig, spots)
    write_poses(folder / "poses.csv", poses)
    write_project(
        folder, replace(rig, beams=nominal.beams), nominal, STAND, [{"spots": "spots.csv", "poses": "poses.csv"}]
    )
    return folder


@pytest.fixture
def campaign(first_campaign, tmp_path) -> tuple[Rig, Path]:
    """The true rig, and a copy of its project in tmp_path."""
    shutil.copytree(first_campaign, tmp_path, dirs_exist_ok=True)
    return RIGS["unequal-fan"](), tmp_path / "calibration.yaml"


def test_recorded_positions_give_a_rig_with_the_joint_covariance_of_its_beams(campaign, tmp_path):
    rig, project = campaign
    outcome = calibrate_beams(project, tmp_path / "out")
    assert outcome.level == Level.PASS
    assert outcome.exit_status == 0
    assert outcome.line().startswith("beams in march: PASS: 3 beams from 40 positions, directions to ")
    file = load_rig_file(tmp_path / "out" / "rig.yaml")
    assert np.abs(errors(rig, file.rig)[:, :2]).max() < 40 * ARCSEC  # 5 sigma of the stand's pose and the spots
    joint = joint_covariance(file.rig, file.covariances, "rig.yaml")
    kinds = {n.split(".")[0] for n in joint.names}
    assert kinds == {"beams", "cameras", "screens"}
    beams = np.array([n.startswith("beams.") for n in joint.names])
    assert np.linalg.matrix_rank(joint.matrix[np.ix_(beams, beams)], tol=1e-14, hermitian=True) == 12
    assert np.abs(joint.matrix[np.ix_(beams, ~beams)]).max() > 0  # correlations with cameras and screens are kept
    for name, beam in file.rig.beams.items():
        along = np.array([n.startswith(f"beams.{name}.direction") for n in joint.names])
        assert np.abs(joint.matrix[along][:, along] @ beam.direction).max() < 1e-12
    state = file.calibration
    assert (state.verdict, (state.valid_until - state.date).days) == ("PASS", 90)


def test_the_tables_hold_the_calibrated_beams_angles_and_residuals(campaign, tmp_path):
    _, project = campaign
    outcome = calibrate_beams(project, tmp_path / "out")
    beams = rows_of(tmp_path / "out" / "beams.csv")
    assert [b["beam"] for b in beams] == ["A", "B", "C"]
    direction = np.array([[float(b[k]) for k in ("dx", "dy", "dz")] for b in beams])
    np.testing.assert_allclose(direction, outcome.result.lines.directions, atol=1e-11)
    assert all(0 < float(b["sigma_direction_arcsec"]) < 20 for b in beams)
    angles = rows_of(tmp_path / "out" / "angles.csv")
    assert [(a["first"], a["second"]) for a in angles] == [("A", "B"), ("A", "C"), ("B", "C")]
    assert float(angles[1]["angle_deg"]) == pytest.approx(41.0, abs=0.01)
    residuals = rows_of(tmp_path / "out" / "residuals.csv")
    assert len(residuals) == len(rows_of(tmp_path / "spots.csv"))
    rms = np.sqrt(np.mean([float(r["residual_mm"]) ** 2 for r in residuals]) / 2)
    assert 0.15 < rms < 0.3  # mm: the simulated noise, larger where the camera sees the screen at an angle
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    for words in ("beams in march", "Angles between beams", "The stand", "Positions", "Residuals"):
        assert words in page


def test_without_poses_only_the_angles_are_found_and_the_result_says_so(campaign, tmp_path):
    _, project = campaign
    text = project.read_text()
    project.write_text(re.sub(r", poses: poses.csv|\n\s+poses: poses.csv", "", text))
    outcome = calibrate_beams(project, tmp_path / "out")
    assert outcome.level == Level.WARN
    assert "3 beams from 40 positions at unknown poses, angles between beams to" in outcome.line()
    words = " ".join(f.what for f in outcome.findings)
    assert "6 parameters remain undetermined, the position (3) and the attitude (3) of the body frame" in words
    angles = rows_of(tmp_path / "out" / "angles.csv")
    assert float(angles[0]["angle_deg"]) == pytest.approx(18.0, abs=0.01)
    assert "closest to the nominal ones" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_a_stand_that_only_yaws_fails_with_the_remedy_and_writes_no_rig(tmp_path):
    rng = np.random.default_rng(3)
    rig = RIGS["unequal-fan"]()
    yaw = np.deg2rad(np.linspace(-25, 25, 20))
    poses = Pose.from_ypr(np.stack([yaw, 0 * yaw, 0 * yaw], axis=1), np.zeros((20, 3)))
    write_spots(tmp_path / "spots.csv", rig, recorded(rng, rig, poses))
    write_poses(tmp_path / "poses.csv", poses)
    project = write_project(tmp_path, rig, rig, None, [{"spots": "spots.csv", "poses": "poses.csv"}])
    outcome = calibrate_beams(project, tmp_path / "out")
    assert (outcome.level, outcome.exit_status) == (Level.FAIL, 3)
    (bad,) = [f for f in outcome.findings if f.level == Level.FAIL]
    assert "all beams relative to the stand: a rotation about z" in bad.what
    assert bad.remedy.startswith("add positions turned by 10 deg or more about the stand's x and y")
    assert not (tmp_path / "out" / "rig.yaml").exists()
    assert {b["sigma_direction_arcsec"] for b in rows_of(tmp_path / "out" / "beams.csv")} == {""}
    assert "add positions turned" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8").lower()


def test_recordings_are_joined_position_by_position_each_with_its_own_sigma(campaign, tmp_path):
    rig, project = campaign
    lines = (tmp_path / "spots.csv").read_text().splitlines()
    second = [s for s in lines[1:] if int(s.split(",")[0]) >= 30]
    (tmp_path / "late.csv").write_text("\n".join([lines[0], *second]) + "\n")
    (tmp_path / "spots.csv").write_text("\n".join(s for s in lines if s not in second) + "\n")
    poses = (tmp_path / "poses.csv").read_text().splitlines()
    with_sigmas = [f"{poses[0]},sigma_x_m,sigma_rot_z_deg", *(f"{p},0.001,0.5" for p in poses[1:])]
    (tmp_path / "worse.csv").write_text("\n".join(with_sigmas) + "\n")
    head = project.read_text().split("recordings:")[0]
    both = "[{spots: spots.csv, poses: poses.csv}, {spots: late.csv, poses: worse.csv}]"
    stand = project.read_text()[project.read_text().index("stand:") :] if "stand:" not in head else ""
    project.write_text(f"{head}recordings: {both}\n{stand}")
    found = read_recordings(load_project(project), rig)
    assert found.names[29:31] == ("spots 29", "late 30")
    assert np.unique(found.spots.position).tolist() == list(range(40))
    general = [2e-5, 2e-5, 2e-5, *np.radians([0.001] * 3)]
    np.testing.assert_allclose(found.pose_sigmas[:30], np.tile(general, (30, 1)))
    np.testing.assert_allclose(found.pose_sigmas[30:], np.tile([1e-3, *general[1:5], np.radians(0.5)], (10, 1)))


def test_a_wrong_recorded_pose_is_reported_by_its_position(campaign, tmp_path):
    rig, project = campaign
    lines = (tmp_path / "poses.csv").read_text().splitlines()
    fields = lines[8].split(",")
    fields[3] = repr(float(fields[3]) + 0.02)  # position 7, off by 20 mm
    lines[8] = ",".join(fields)
    (tmp_path / "poses.csv").write_text("\n".join(lines) + "\n")
    outcome = calibrate_beams(project, tmp_path / "out")
    assert any(f.what == "most spots of position 7 were excluded" for f in outcome.findings)
    file = load_rig_file(tmp_path / "out" / "rig.yaml")
    assert np.abs(errors(rig, file.rig)[:, :2]).max() < 40 * ARCSEC


def test_beams_that_are_swapped_against_the_design_are_reported(campaign, tmp_path):
    _, project = campaign
    text = (tmp_path / "spots.csv").read_text()
    swapped = text.replace(",left,1,", ",left,@,").replace(",left,2,", ",left,1,").replace(",left,@,", ",left,2,")
    swapped = (
        swapped.replace(",right,4,", ",right,@,").replace(",right,5,", ",right,4,").replace(",right,@,", ",right,5,")
    )
    (tmp_path / "spots.csv").write_text(swapped)
    outcome = calibrate_beams(project, tmp_path / "out")
    assert any("check which laser is A and which is B" in f.remedy for f in outcome.findings)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda t: t.replace("0,left,1,", "0,lfet,1,", 1),
            "line 2: camera: expected a calibrated camera, got",
        ),
        (lambda t: t.replace("0,left,1,", "0,left,4,", 1), "observes screen 'left', but spot '4' is on 'right'"),
        (
            lambda t: t.replace("0,left,1,", "77,left,1,", 1),
            "expected a pose for each of 41 positions of spots.csv",
        ),
        (
            lambda t: "\n".join(t.splitlines()[:1]) + "\n",
            "expected rows position,camera,spot,u_px,v_px below",
        ),
        (lambda t: t.replace("position", "place"), "expected a column 'position' \\(or 'frame'\\)"),
        (lambda t: t.replace(t.splitlines()[1], "0,left,1,nan,3,0.05"), "line 2: u_px: expected a number, got 'nan'"),
        (lambda t: t.replace(t.splitlines()[1], "0,left,1,1.0,3,-1"), "line 2: sigma_px: expected a number above 0"),
        (lambda t: t.replace(t.splitlines()[1], "0.5,left,1,1.0,3,1"), "line 2: position: expected a whole number"),
        (lambda t: "", "got an empty file"),
    ],
)
def test_a_mistake_in_the_spots_is_reported_with_its_line(campaign, tmp_path, change, words):
    _, project = campaign
    path = tmp_path / "spots.csv"
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError, match=words):
        calibrate_beams(project, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_without_calibrated_cameras_the_next_command_is_named(campaign, tmp_path):
    _, project = campaign
    (tmp_path / "rig.yaml").unlink()
    with pytest.raises(InputError, match=r"run `beampose calibrate screen .*` first and give its rig.yaml with --rig"):
        calibrate_beams(project, tmp_path / "out")


def test_spots_without_a_common_solution_raise_an_error_and_leave_earlier_results_unchanged(campaign, tmp_path):
    _, project = campaign
    out = tmp_path / "out"
    out.mkdir()
    (out / "beams.csv").write_text("an earlier result")
    before = {p.name: p.read_bytes() for p in out.iterdir()}
    lines = (tmp_path / "spots.csv").read_text().splitlines()
    order = np.random.default_rng(0).permutation(len(lines) - 1)
    mixed = [f"{i % 40},{lines[1 + k].split(',', 1)[1]}" for i, k in enumerate(order)]
    (tmp_path / "spots.csv").write_text("\n".join([lines[0], *mixed]) + "\n")
    with pytest.raises(CalibrationError, match="cannot be calibrated: only"):
        calibrate_beams(project, out)
    assert {p.name: p.read_bytes() for p in out.iterdir()} == before


def test_a_project_without_recordings_is_refused(campaign, tmp_path):
    _, project = campaign
    project.write_text(project.read_text().split("recordings:")[0])
    with pytest.raises(InputError, match="recordings: expected spots at positions of the stand, got none; add"):
        calibrate_beams(project, tmp_path / "out")


def detections_run(folder: Path, rig: Rig, nominal: Rig, poses: Pose, rng: np.random.Generator, repeats: int) -> None:
    """A run folder of unlabelled points, `repeats` frames at each position, and the stand's poses."""
    model = SpotModel.of(rig)
    pixels, _ = model.project(WORLD_FROM_STAND @ poses)
    lines = ["frame,camera,u_px,v_px,sigma_u_px,sigma_v_px,flux,peak,major_px,minor_px,angle_deg,cov_uv_px2"]
    stands = ["frame,t_s,x_m,y_m,z_m,qw,qx,qy,qz"]
    speckle = rng.normal(0, 0.05, pixels.shape)  # px: constant while the vehicle is at rest
    for k in range(len(pixels) * repeats):
        p = k // repeats
        numbers = [*poses.translation[p], *poses.quaternion_wxyz[p]]
        stands.append(f"{k},{k / 50}," + ",".join(repr(float(v)) for v in numbers))
        for i in rng.permutation(len(model)):
            if model.in_picture(pixels[p])[i]:
                u, v = pixels[p, i] + speckle[p, i] + rng.normal(0, 0.03, 2)
                lines.append(f"{k},{model.views[i][0]},{u},{v},0.06,0.06,1000,100,2,2,0,0")
        lines.append(
            f"{k},left,{rng.uniform(0, 1200)},{rng.uniform(0, 1000)},0.06,0.06,1000,100,2,2,0,0"
        )  # a reflection
    folder.mkdir()
    (folder / "detections.csv").write_text("\n".join(lines) + "\n")
    (folder / "poses.csv").write_text("\n".join(stands) + "\n")
    save_rig(nominal, folder / "rig.yaml")
    cameras = {c: {"detections": "detections.csv"} for c in rig.cameras}
    save_run({"rig": "rig.yaml", "frame_rate_hz": 50.0, "cameras": cameras}, folder)


def test_an_unlabelled_run_is_labelled_by_the_nominal_beams_and_its_frames_at_rest_are_averaged(tmp_path):
    rng = np.random.default_rng(5)
    rig = RIGS["unequal-fan"]()
    nominal = drawn(rig, rng, 0.003, 0.003)
    detections_run(tmp_path / "recorded", rig, nominal, positions(rng, 20), rng, 5)
    recording = {"run": "recorded", "poses": "recorded/poses.csv"}
    project = write_project(tmp_path, rig, nominal, STAND, [recording])
    outcome = calibrate_beams(project, tmp_path / "out")
    c = outcome.result
    assert len(c.world_from_body.translation) == 20
    assert c.fit.kept.mean() > 0.97
    assert c.fit.scale < 1.3  # the sigmas include the speckle, which is common to the frames
    assert np.abs(errors(rig, c.rig)[:, :2]).max() < 60 * ARCSEC


def test_a_run_whose_clocks_are_to_be_estimated_is_refused_in_a_line(tmp_path):
    rng, rig = np.random.default_rng(5), RIGS["unequal-fan"]()
    detections_run(tmp_path / "recorded", rig, rig, positions(rng, 3), rng, 1)
    run = tmp_path / "recorded" / "run.yaml"
    content = yaml.safe_load(run.read_text())
    content["cameras"]["right"]["time_offset_s"] = "estimate"
    run.write_text(yaml.safe_dump(content))
    project = write_project(tmp_path, rig, rig, STAND, [{"run": "recorded", "poses": "recorded/poses.csv"}])
    with pytest.raises(InputError, match="remove `estimate`, and record while the stand is at rest"):
        calibrate_beams(project, tmp_path / "out")


def test_a_run_without_known_poses_is_labelled_by_the_tracker_and_gives_the_angles(tmp_path):
    rng = np.random.default_rng(8)
    rig = RIGS["unequal-fan"]()
    t = np.arange(30) / 50.0
    turns = np.deg2rad(np.stack([15 * np.sin(5 * t), 9 * np.sin(7 * t), 12 * np.sin(3 * t)], axis=1))
    shifts = 0.1 * np.stack([np.sin(4 * t), np.sin(2 * t), np.cos(5 * t)], axis=1)
    nominal = drawn(rig, rng, 2e-4, 2e-4)  # the tracker needs nominal beams that fit the spots
    detections_run(tmp_path / "recorded", rig, nominal, Pose.from_ypr(turns, shifts), rng, 1)
    at_start = {"position_m": [0, 0, 0], "yaw_pitch_roll_deg": [0, 0, 0], "within_m": 0.3, "within_deg": 10.0}
    cameras = {c: {"detections": "detections.csv"} for c in rig.cameras}
    save_run({"rig": "rig.yaml", "frame_rate_hz": 50.0, "cameras": cameras, "prior": at_start}, tmp_path / "recorded")
    project = write_project(tmp_path, rig, nominal, None, [{"run": "recorded"}])
    outcome = calibrate_beams(project, tmp_path / "out")
    c = outcome.result
    assert len(c.world_from_body.translation) >= 29  # the tracker may be uncertain in one of its first frames
    off = np.array([a.angle for a in c.angles]) - np.deg2rad([18.0, 41.0, 23.0])
    assert np.all(np.abs(off) < 5 * np.array([a.sigma for a in c.angles]))


def test_the_number_of_frames_without_a_pose_is_limited_with_a_note():
    frames = np.repeat(np.arange(500), 6)
    rows = SpotRows(frames, np.tile(np.arange(6), 500), np.zeros((3000, 2)), np.zeros((3000, 2, 2)))
    notes: list[str] = []
    used = np.unique(limit_frames(rows, notes).frame)
    assert (len(used), used[0], used[-1]) == (200, 0, 499)
    assert notes == ["200 of 500 frames without a pose were used, evenly spaced"]


def test_frames_with_the_same_recorded_pose_are_one_position():
    poses = Pose.from_ypr(np.deg2rad([[0, 0, 0], [0, 0, 0], [5, 0, 0], [5, 0, 0], [0, 0, 0]]), np.zeros((5, 3)))
    assert positions_at_rest(poses, np.zeros((5, 6))).tolist() == [0, 0, 1, 1, 2]


def test_an_error_common_to_all_frames_does_not_average_out():
    rng = np.random.default_rng(6)
    stated = np.broadcast_to(np.eye(2) * 0.05**2, (400, 2, 2))
    constant = rng.normal(0, 0.05, 2) + rng.normal(0, 1e-4, (400, 2))
    white = rng.normal(0, 0.05, (400, 2))
    assert np.sqrt(np.trace(mean_of_frames(constant, stated)[1]) / 2) == pytest.approx(0.05, rel=0.01)
    assert np.sqrt(np.trace(mean_of_frames(white, stated)[1]) / 2) < 0.02
    slow = np.repeat(rng.normal(0, 0.05, (20, 2)), 20, axis=0) + rng.normal(0, 0.01, (400, 2))
    assert np.sqrt(np.trace(mean_of_frames(slow, stated)[1]) / 2) > 0.008  # 20 independent values, not 400


def test_an_outlier_does_not_move_the_mean():
    rng = np.random.default_rng(7)
    pixels = rng.normal(0, 0.05, (30, 2))
    pixels[11] += 200.0
    mean, _ = mean_of_frames(pixels, np.broadcast_to(np.eye(2) * 0.05**2, (30, 2, 2)))
    assert np.linalg.norm(mean) < 0.05


def test_positions_and_views_are_averaged_separately():
    rows = SpotRows(
        np.array([0, 0, 1, 1, 2]),
        np.array([0, 3, 0, 3, 0]),
        np.array([[1.0, 0], [5, 0], [3, 0], [7, 0], [9, 0]]),
        np.broadcast_to(np.eye(2), (5, 2, 2)),
    )
    spots = average(rows, np.array([0, 0, 0, 0, 1]))
    assert spots.position.tolist() == [0, 0, 1]
    assert spots.view.tolist() == [0, 3, 0]
    np.testing.assert_allclose(spots.pixels[:, 0], [2, 6, 9])


def test_warnings_and_expiry_of_screens_yaml_go_into_the_rig(campaign, tmp_path):
    rig, project = campaign
    lab = replace(rig, beams={}, spots={})
    state = CalibrationState(
        date=date(2026, 3, 1),
        verdict="WARN",
        valid_until=date(2026, 4, 1),
        reasons=("the left screen is bent by 2 mm",),
    )
    save_screens("the lab", RigFile(lab, {"target": lab_covariance(rig)}, state), tmp_path / "screens.yaml")
    outcome = calibrate_beams(project, tmp_path / "out", tmp_path / "screens.yaml", date(2026, 3, 14))
    assert outcome.level == Level.WARN
    written = load_rig_file(tmp_path / "out" / "rig.yaml").calibration
    assert (written.verdict, written.valid_until) == ("WARN", date(2026, 4, 1))  # before the 90 days of the beams
    assert "the left screen is bent by 2 mm" in written.reasons[0]


def test_a_lab_and_a_project_without_beams_are_refused(campaign, tmp_path):
    rig, project = campaign
    save_screens("the lab", RigFile(replace(rig, beams={}, spots={})), tmp_path / "screens.yaml")
    text = project.read_text()
    project.write_text(text[: text.index("target:")] + text[text.index("recordings:") :])
    with pytest.raises(InputError, match="target: expected the nominal beams and spots, got none; add them"):
        calibrate_beams(project, tmp_path / "out", tmp_path / "screens.yaml")


def test_the_project_need_not_repeat_cameras_screens_and_target_of_the_rig(campaign, tmp_path):
    _, project = campaign
    content = yaml.safe_load(project.read_text())
    whole = calibrate_beams(project, tmp_path / "whole")
    lean = tmp_path / "lean"
    lean.mkdir()
    for name in ("spots.csv", "poses.csv"):
        shutil.copy(tmp_path / name, lean / name)
    without_lab = {k: content[k] for k in ("schema", "name", "valid_days", "target", "recordings", "stand")}
    write_mapping(without_lab, lean / "calibration.yaml")
    found = calibrate_beams(lean / "calibration.yaml", tmp_path / "out", tmp_path / "rig.yaml")
    np.testing.assert_array_equal(found.result.lines.directions, whole.result.lines.directions)
    # With the target in the rig, the project need not state it either.
    both = replace(load_rig_file(tmp_path / "rig.yaml"))
    target = load_project(project)
    save_rig(replace(both, rig=replace(both.rig, beams=target.beams, spots=target.spots)), tmp_path / "known.yaml")
    write_mapping({k: v for k, v in without_lab.items() if k != "target"}, lean / "calibration.yaml")
    found = calibrate_beams(lean / "calibration.yaml", tmp_path / "again", tmp_path / "known.yaml")
    np.testing.assert_allclose(found.result.lines.directions, whole.result.lines.directions, atol=1e-9)


def test_a_spot_on_an_unknown_screen_is_reported_by_name(campaign, tmp_path):
    _, project = campaign
    content = yaml.safe_load(project.read_text())
    del content["cameras"], content["screens"]
    spot = next(iter(content["target"]["spots"]))
    content["target"]["spots"][spot]["screen"] = "cellar"
    write_mapping(content, project)
    with pytest.raises(InputError, match=rf"target.spots.{re.escape(spot)}.screen: expected a screen of .*'cellar'"):
        calibrate_beams(project, tmp_path / "out")


def test_a_project_without_cameras_names_the_command_that_needs_none(campaign, tmp_path):
    _, project = campaign
    content = yaml.safe_load(project.read_text())
    del content["cameras"]
    write_mapping(content, project)
    with pytest.raises(InputError, match="cameras: expected one or more, got none; only `calibrate beams`"):
        load_project(project)


def test_a_position_is_named_where_two_spots_and_more_than_half_of_them_are_excluded():
    """One spot may be wrong by itself, and some of many; most of a position's mean that its pose is wrong."""
    position = np.repeat([0, 1, 2, 3], [1, 10, 4, 3])
    wrong = [0, *range(1, 6), 11, 12, 15, 16]  # one of one, five of ten, two of four, two of three
    assert bad_positions(position, wrong, ("one", "half of ten", "half of four", "most")) == ["most"]
