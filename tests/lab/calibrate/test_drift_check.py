"""The drift check distinguishes drift from noise and names its cause; bad input is refused with its reason."""

from __future__ import annotations

import datetime
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import binom

from calibration.changes import TURNED, WRONG_POINT, ZOOMED, find_changes
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from geometry.rotations import exp
from geometry.uncertainty.rig_uncertainty import CLOCK, RigCovariance, perturbed_rig, rig_names
from lab.calibrate.drift_check.drift_check import COLUMNS, DriftLimits, check_drift
from lab.calibrate.drift_check.drift_comparison import compare_points, read_history
from lab.calibrate.drift_check.drift_inputs import DriftInputs, read_points
from lab.errors import InputError
from lab.files.rig.camera_file import CalibrationState
from lab.files.rig.rig_file import joint_covariance
from lab.findings.finding import Level
from tests.lab.calibrate import drift_scenes as scenes
from tests.lab.tables import rows_of

RIG, COVARIANCE = scenes.rig_and_covariance()
TRUE = scenes.true_rig(RIG, COVARIANCE, np.random.default_rng(1))
AT_REST = Pose(exp(np.array([0.02, -0.03, 0.05])), np.array([0.05, 0.02, -0.03]))


def changed(**values) -> CalibrationState:
    """The state of the calibration with other values."""
    return scenes.STATE.model_copy(update=values)


def check(folder: Path, today, seed: int = 0, *, state=scenes.STATE, day=scenes.DAY, history=None, **points):
    """Result of a check with control points. today: the true rig."""
    rig = scenes.write_rig(folder, RIG, COVARIANCE, state)
    pixels, survey = scenes.write_points(folder, today, np.random.default_rng(seed), **points)
    return check_drift(rig, folder / "out", DriftInputs(pixels, survey=survey), today=day, history=history)


def of(outcome, camera: str):
    return next(c for c in outcome.result.cameras if c.camera == camera)


# Control points -----------------------------------------------------------------------------------------------------


def test_a_lab_that_has_not_changed_passes(tmp_path):
    outcome = check(tmp_path, TRUE)
    assert outcome.level == Level.PASS
    assert outcome.exit_status == 0
    assert outcome.line().startswith("drift check: PASS: left 0.")
    assert all(c.change is None for c in outcome.result.cameras)


@pytest.mark.parametrize("on_screens", [False, True], ids=["surveyed", "screen coordinates"])
def test_a_camera_turned_by_a_twentieth_of_a_degree_must_not_be_used(tmp_path, on_screens):
    outcome = check(tmp_path, scenes.turned(TRUE, "left", 0.05), on_screens=on_screens)
    left, right = of(outcome, "left"), of(outcome, "right")
    assert outcome.exit_status == 3
    assert left.change.kind == TURNED
    assert left.turn_deg[1] == pytest.approx(0.05, abs=4 * left.sigma_turn_deg[1])
    # 0.05 deg of a focal length of 1180 px is 1.03 px, and at 3.5 m 3.05 mm, by geometry alone
    assert left.drift_px == pytest.approx(1.03, abs=0.15)
    assert left.drift_mm == pytest.approx(3.05, abs=0.45)
    assert right.level == Level.PASS
    assert any("turned by" in f.what and "vertical axis" in f.what for f in outcome.findings)


def test_a_changed_focus_is_distinguished_from_a_rotation(tmp_path):
    outcome = check(tmp_path, perturbed_rig(TRUE, ["cameras.left.fx", "cameras.left.fy"], np.array([4.0, 4.0])))
    assert of(outcome, "left").change.kind == ZOOMED
    assert outcome.exit_status == 3
    assert any("focus or zoom changed" in f.what for f in outcome.findings)


def test_a_camera_that_shifted_by_a_centimetre_must_not_be_used(tmp_path):
    outcome = check(tmp_path, perturbed_rig(TRUE, ["cameras.right.x_m"], np.array([0.01])))
    right = of(outcome, "right")
    assert outcome.exit_status == 3
    assert right.drift_mm == pytest.approx(10.0, abs=1.0)
    assert of(outcome, "left").level == Level.PASS


def test_one_wrong_point_is_a_warning_and_the_camera_is_judged_without_it(tmp_path):
    outcome = check(tmp_path, TRUE, wrong={"L2": (2.0, -1.0)})
    assert outcome.level == Level.WARN
    assert outcome.exit_status == 0
    assert of(outcome, "left").level == Level.PASS
    assert of(outcome, "left").drift_px < 0.4
    assert any("one point is wrong: L2" in f.what and f.remedy for f in outcome.findings)


@pytest.mark.parametrize(("p_false_alarm", "checks"), [(0.05, 200)])
def test_false_alarms_come_at_the_stated_rate_over_many_labs(tmp_path, p_false_alarm, checks):
    """Each check has another calibration error, survey and noise: the test must take all three into account."""
    covariance = joint_covariance(RIG, {"target": COVARIANCE}, "rig.yaml")
    rng = np.random.default_rng(2)
    alarms = 0
    for _ in range(checks):
        pixels, survey = scenes.write_points(tmp_path, scenes.true_rig(RIG, COVARIANCE, rng), rng)
        for one in compare_points(RIG, read_points(pixels, survey, RIG, 0.1), covariance, pixels):
            verdicts = find_changes(one.misfit, one.columns, one.others, p_false_alarm)
            alarms += bool(verdicts.changes) or verdicts.unexplained
    assert binom.ppf(0.001, 2 * checks, p_false_alarm) <= alarms <= binom.ppf(0.999, 2 * checks, p_false_alarm)


def test_the_calibrations_own_uncertainty_is_no_drift(tmp_path):
    """Without the covariance of the calibration, the same lab has a drift."""
    off = scenes.true_rig(RIG, replace(COVARIANCE, matrix=25 * COVARIANCE.matrix), np.random.default_rng(3))
    pixels, survey = scenes.write_points(tmp_path, off, np.random.default_rng(0))
    wide = replace(COVARIANCE, matrix=25 * COVARIANCE.matrix)
    inputs = DriftInputs(pixels, survey=survey)
    known = check_drift(scenes.write_rig(tmp_path, RIG, wide), tmp_path / "a", inputs, today=scenes.DAY)
    unknown = check_drift(scenes.write_rig(tmp_path, RIG, None), tmp_path / "b", inputs, today=scenes.DAY)
    assert all(c.change is None for c in known.result.cameras)
    assert any(c.change is not None for c in unknown.result.cameras)
    assert any("no covariance" in f.what for f in unknown.findings)


def test_a_poor_survey_is_no_drift_if_it_states_its_sigmas(tmp_path):
    rig = scenes.write_rig(tmp_path, RIG, COVARIANCE)
    pixels, survey = scenes.write_points(tmp_path, TRUE, np.random.default_rng(0))
    off = np.random.default_rng(1).normal(0, 3e-3, (99, 3))
    lines = survey.read_text().splitlines()
    for sigma, alarm in ((1e-4, True), (3e-3, False)):
        rows = [lines[0]]
        for i, line in enumerate(lines[1:]):
            name, x, y, z, *_ = line.split(",")
            xyz = np.array([float(x), float(y), float(z)]) + off[i]
            rows.append(f"{name},{xyz[0]},{xyz[1]},{xyz[2]},{sigma},{sigma},{sigma}")
        survey.write_text("\n".join(rows))
        outcome = check_drift(rig, tmp_path / "out", DriftInputs(pixels, survey=survey), today=scenes.DAY)
        assert any(", p " in f.what or f.level == Level.FAIL for f in outcome.findings) == alarm


def test_a_camera_without_points_is_reported_as_not_checked(tmp_path):
    rig = scenes.write_rig(tmp_path, RIG, COVARIANCE)
    pixels, survey = scenes.write_points(tmp_path, TRUE, np.random.default_rng(0))
    pixels.write_text("\n".join(line for line in pixels.read_text().splitlines() if not line.startswith("right")))
    outcome = check_drift(rig, tmp_path / "out", DriftInputs(pixels, survey=survey), today=scenes.DAY)
    assert outcome.level == Level.WARN
    words = "camera right not checked: nothing was measured in it"
    assert any(words in f.what for f in outcome.findings)
    assert words in outcome.line()
    knocked = scenes.turned(TRUE, "left", 0.05)
    pixels, survey = scenes.write_points(tmp_path, knocked, np.random.default_rng(0))
    pixels.write_text("\n".join(line for line in pixels.read_text().splitlines() if not line.startswith("right")))
    outcome = check_drift(rig, tmp_path / "out", DriftInputs(pixels, survey=survey), today=scenes.DAY)
    assert outcome.level == Level.FAIL  # the failure does not hide that the other camera was not checked
    assert "; not checked: right" in outcome.line()


# Expiry ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("state", "level", "words"),
    [
        (
            changed(valid_until=scenes.DAY - datetime.timedelta(1)),
            Level.FAIL,
            "expired on 2026-04-30, 1 day",
        ),
        (changed(valid_until=scenes.DAY), Level.WARN, "expires on 2026-05-01, in 0 days"),
        (changed(valid_until=None), Level.PASS, "without an expiry date"),
        (changed(verdict="FAIL", reasons=("lens loose",)), Level.FAIL, "failed: lens loose"),
        (changed(date=datetime.date(2027, 1, 1)), Level.WARN, "after today"),
        (None, Level.WARN, "does not state when"),
    ],
    ids=["expired", "last day", "no expiry", "failed", "from the future", "unknown"],
)
def test_the_dates_and_the_verdict_of_the_calibration_are_checked(
    tmp_path, state: CalibrationState | None, level, words
):
    outcome = check(tmp_path, TRUE, state=state)
    assert outcome.level == level
    assert outcome.exit_status == (3 if level == Level.FAIL else 0)
    assert any(words in f.what for f in outcome.findings)


# A vehicle at rest ----------------------------------------------------------------------------------------------------


def still(folder: Path, today, with_pose: bool = True, **kind):
    rig = scenes.write_rig(folder, RIG, COVARIANCE)
    run = scenes.write_still(folder / "run", today, AT_REST, np.random.default_rng(5), **kind)
    pose = run / "pose.csv" if with_pose else None
    return check_drift(rig, folder / "out", DriftInputs(run=run, pose=pose), today=scenes.DAY)


def test_a_vehicle_at_a_known_pose_finds_a_turned_camera(tmp_path):
    outcome = still(tmp_path, scenes.turned(TRUE, "left", 0.05))
    assert of(outcome, "left").change.kind == TURNED
    assert of(outcome, "right").change is None
    assert outcome.exit_status == 3


def test_a_vehicle_at_rest_finds_a_laser_that_moved(tmp_path):
    names = ["beams.A.direction_y", "beams.A.direction_z"]
    for with_pose in (True, False):
        outcome = still(tmp_path, perturbed_rig(TRUE, names, np.array([1e-3, 1e-3])), with_pose)
        assert any("laser A has moved" in f.what for f in outcome.findings)
        assert all(c.change is None for c in outcome.result.cameras)


def test_an_unchanged_lab_passes_and_an_unknown_pose_makes_a_weak_check(tmp_path):
    assert still(tmp_path, TRUE).level == Level.PASS
    weak = still(tmp_path, TRUE, with_pose=False)
    assert weak.level == Level.WARN
    assert {c.level for c in weak.result.cameras} == {Level.WARN}
    assert any("this check is weak" in f.what and "--pose" in f.remedy for f in weak.findings)


def test_the_pose_of_the_stand_is_weighted_by_its_sigma(tmp_path):
    """Half a millimetre from its stated position: ten sigma of a good seat, half a sigma of a poor one."""
    rig = scenes.write_rig(tmp_path, RIG, COVARIANCE)
    beside = Pose(AT_REST.rotation, AT_REST.translation + np.array([0, 5e-4, 0]))
    run = scenes.write_still(tmp_path / "run", TRUE, beside, np.random.default_rng(5))
    stated = scenes.write_still(tmp_path / "stated", TRUE, AT_REST, np.random.default_rng(5)) / "pose.csv"
    for sigma_m, alarm in ((5e-5, True), (1e-3, False)):
        limits = DriftLimits(pose_sigma_m=sigma_m)
        outcome = check_drift(rig, tmp_path / "out", DriftInputs(run=run, pose=stated), today=scenes.DAY, limits=limits)
        assert any(f.level == Level.FAIL or ", p " in f.what for f in outcome.findings) == alarm


def test_a_vehicle_that_moves_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"at rest, got spot .* drifted by .* px during the run"):
        still(tmp_path, TRUE, wander_px=3.0)


# Output ---------------------------------------------------------------------------------------------------------------


def test_the_table_has_a_row_per_camera_and_the_history_grows(tmp_path):
    history = tmp_path / "drift_history.csv"
    for n in range(3):
        day = scenes.DAY + datetime.timedelta(days=n)
        outcome = check(tmp_path, TRUE, n, day=day, history=history)
    rows = rows_of(tmp_path / "out" / "drift.csv")
    assert tuple(rows[0]) == COLUMNS
    assert [r["camera"] for r in rows] == ["left", "right"]
    assert float(rows[0]["drift_px"]) == pytest.approx(of(outcome, "left").drift_px, rel=1e-5)
    assert [(r.date.day, r.camera) for r in read_history(history)] == [
        (d, c) for d in (1, 2, 3) for c in ("left", "right")
    ]
    report = (tmp_path / "out" / "report.html").read_text()
    assert "Drift over time" in report
    assert "http" not in report.replace("http-equiv", "")


def test_a_check_with_bad_input_leaves_earlier_results_unchanged(tmp_path):
    history = tmp_path / "h.csv"
    check(tmp_path, TRUE, history=history)
    before = {p: p.read_bytes() for p in [history, *(tmp_path / "out").iterdir()]}
    (tmp_path / "points.csv").write_text("camera,point,u_px,v_px\nleft,L1,nan,3\n")
    with pytest.raises(InputError):
        check_drift(
            tmp_path / "rig.yaml",
            tmp_path / "out",
            DriftInputs(tmp_path / "points.csv", survey=tmp_path / "survey.csv"),
            history=history,
        )
    assert {p: p.read_bytes() for p in [history, *(tmp_path / "out").iterdir()]} == before


def test_a_folder_with_something_else_in_it_is_not_replaced(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match="something other than earlier results"):
        check(tmp_path, TRUE)
    assert (tmp_path / "out" / "thesis.txt").is_file()


# Bad inputs -----------------------------------------------------------------------------------------------------------

POINTS = "camera,point,u_px,v_px\nleft,L1,300,250\n"
SURVEY = "point,x_m,y_m,z_m\nL1,-2.5,-1.0,-0.8\n"


@pytest.mark.parametrize(
    ("points", "survey", "words"),
    [
        (None, SURVEY, r"points.csv: expected a table with columns .*, found no file"),
        ("", SURVEY, r"points.csv: expected columns camera,point,u_px,v_px, got an empty file"),
        ("camera,point,u_px,v_px\n", SURVEY, "expected rows camera,point,u_px,v_px below the header, got none"),
        ("camera,point,u,v_px\nleft,L1,1,2\n", SURVEY, "expected a column 'u_px', got camera,point,u,v_px"),
        (POINTS.replace("300", "nan"), SURVEY, "line 2: u_px: expected a number, got 'nan'"),
        (POINTS.replace("300", ""), SURVEY, "line 2: u_px: expected a number, got nothing"),
        (POINTS.replace("300", "-1e300"), SURVEY, "line 2: u_px: expected a pixel in or near the picture"),
        (POINTS.replace(",", ";"), SURVEY, "points.csv: .* got semicolons; separate columns with commas"),
        (POINTS.replace("v_px", "u_px,v_px"), SURVEY, "points.csv: expected each column once, got 'u_px' twice"),
        (POINTS.encode("utf-16").decode("latin-1"), SURVEY, "points.csv: .* not text in UTF-8; save it as CSV"),
        (POINTS.replace("250", "250,9"), SURVEY, "line 2: expected 4 fields as in the header, got more"),
        (POINTS.replace("left", "lef"), SURVEY, "expected a camera of the rig, got 'lef'; did you mean 'left'?"),
        (POINTS.replace("L1", "L11"), SURVEY, "expected the coordinates of point 'L11' .* got none; did you mean 'L1'"),
        (
            POINTS + "left,L1,301,251\n",
            SURVEY,
            "each point once per camera, got 'L1' of 'left' again .first in points.csv, line 2",
        ),
        (POINTS.replace("v_px", "v_px,sigma_px").replace("250", "250,0"), SURVEY, "sigma_px: expected a number above"),
        (POINTS, None, "survey.csv: expected a table with columns .*, found no file"),
        (POINTS, SURVEY.replace("-2.5,-1.0,-0.8", "-2500,-1000,-800"), "x_m: expected metres, .* got -2500; are these"),
        (POINTS, SURVEY.replace("-0.8", "inf"), "survey.csv: line 2: z_m: expected a number, got inf"),
        (POINTS, SURVEY.replace("z_m", "depth"), "expected a column 'z_m' .world. or 'screen'"),
        (POINTS, "point,screen,x_m,y_m\nL1,lefft,1,1\n", "screen: expected a screen of the rig, got 'lefft'; did you"),
        (POINTS, SURVEY.replace("-2.5,-1.0,-0.8", "-1.0,-2.5,-0.8"), "check the survey's unit, axes and frame"),
        (POINTS, SURVEY.replace("-2.5,-1.0", "-8.5,-1.0"), "this camera cannot see the point"),
        (POINTS, SURVEY + "L1,0,0,0\n", "'L1' has two different positions"),
    ],
)  # fmt: skip
def test_a_bad_table_is_refused_with_its_line_and_the_remedy(tmp_path, points, survey, words):
    rig = scenes.write_rig(tmp_path, RIG, COVARIANCE)
    for name, text in (("points.csv", points), ("survey.csv", survey)):
        if text is not None:
            (tmp_path / name).write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=words) as caught:
        check_drift(rig, tmp_path / "out", DriftInputs(tmp_path / "points.csv", survey=tmp_path / "survey.csv"))
    assert len(str(caught.value).splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_points_need_coordinates(tmp_path):
    rig = scenes.write_rig(tmp_path, RIG, COVARIANCE)
    (tmp_path / "p.csv").write_text(POINTS)
    with pytest.raises(InputError, match=r"expected the coordinates of its points.*--survey"):
        check_drift(rig, tmp_path / "out", DriftInputs(tmp_path / "p.csv"))


def test_a_check_needs_either_points_or_a_run(tmp_path):
    rig = scenes.write_rig(tmp_path, RIG, COVARIANCE)
    for kind, words in (
        ({}, "got neither"),
        ({"points": tmp_path, "run": tmp_path}, "got both"),
        ({"run": tmp_path, "survey": tmp_path}, "--survey only together with --points"),
        ({"points": tmp_path, "pose": tmp_path}, "--pose only together with --run"),
    ):
        with pytest.raises(InputError, match=words):
            check_drift(rig, tmp_path / "out", DriftInputs(**kind))


def test_bad_runs_poses_and_histories_are_refused(tmp_path):
    rig = scenes.write_rig(tmp_path, RIG, COVARIANCE)
    with pytest.raises(InputError, match="found nothing"):
        check_drift(rig, tmp_path / "out", DriftInputs(run=tmp_path / "no"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"expected a run.yaml or a spots.csv in this folder"):
        check_drift(rig, tmp_path / "out", DriftInputs(run=tmp_path / "empty"))
    run = scenes.write_still(tmp_path / "run", TRUE, AT_REST, np.random.default_rng(0))
    text = (run / "spots.csv").read_text()
    (run / "spots.csv").write_text(text.replace(",left,", ",lfet,"))
    with pytest.raises(InputError, match=r"got 'lfet'; did you mean 'left'\?"):
        check_drift(rig, tmp_path / "out", DriftInputs(run=run))
    (run / "spots.csv").write_text(text)
    (run / "attitude.csv").unlink()
    with pytest.raises(InputError, match=r"expected an attitude.csv beside spots.csv, or the pose"):
        check_drift(rig, tmp_path / "out", DriftInputs(run=run))
    rows = (run / "pose.csv").read_text() + "1,0.01,0.5,0.02,-0.03,1,0,0,0\n"
    (run / "pose.csv").write_text(rows)
    with pytest.raises(InputError, match="expected one constant pose"):
        check_drift(rig, tmp_path / "out", DriftInputs(run=run, pose=run / "pose.csv"))
    history = tmp_path / "h.csv"
    history.write_text("a,b\n")
    with pytest.raises(InputError, match="name another --history"):
        check(tmp_path, TRUE, history=history)
    history.write_text("date,camera,drift_px,noise_px,drift_mm,verdict\nyesterday,left,1,1,1,PASS\n")
    with pytest.raises(InputError, match="line 2: expected a date and a verdict"):
        check(tmp_path, TRUE, history=history)
    assert history.read_text().endswith("yesterday,left,1,1,1,PASS\n")


def test_the_wrong_point_among_five_is_identified(tmp_path):
    pixels, survey = scenes.write_points(tmp_path, TRUE, np.random.default_rng(0), wrong={"R3": (-3.0, 0.0)})
    covariance = joint_covariance(RIG, {"target": COVARIANCE}, "rig.yaml")
    one = compare_points(RIG, read_points(pixels, survey, RIG, 0.1), covariance, pixels)[1]
    changes = find_changes(one.misfit, one.columns, one.others, 0.002).changes
    assert [(c.kind, c.subject) for c in changes] == [(WRONG_POINT, "R3")]


def test_clocks_in_the_covariance_do_not_matter_to_points_at_rest(tmp_path):
    """`beampose refine` states them; an earlier check took each for a number of the lens that it did not know."""
    pixels, survey = scenes.write_points(tmp_path, TRUE, np.random.default_rng(0))
    known = read_points(pixels, survey, RIG, 0.1)
    stated = joint_covariance(RIG, {"target": COVARIANCE}, "rig.yaml")
    clocks = tuple(f"cameras.{name}.{number}" for name in RIG.cameras for number in CLOCK)
    with_clocks = RigCovariance((*stated.names, *clocks), block_diag(stated.matrix, 1e-6 * np.eye(len(clocks))))
    pairs = zip(*(compare_points(RIG, known, C, pixels) for C in (stated, with_clocks)), strict=True)
    for one, other in pairs:
        np.testing.assert_allclose(other.calibration_sigma_px, one.calibration_sigma_px, rtol=1e-12)


def test_a_run_folder_is_processed_first(tmp_path):
    """The detections of a vehicle at rest are labelled and tracked before the check."""
    rig = scenes.write_rig(tmp_path, RIG, COVARIANCE, changed(valid_until=None))
    rng = np.random.default_rng(8)
    run = tmp_path / "run"
    run.mkdir()
    (run / "rig.yaml").write_text(rig.read_text())
    model = SpotModel.of(scenes.turned(TRUE, "left", 0.05))
    uv = model.derivatives(AT_REST).pixels
    rows = ["frame,camera,u_px,v_px,sigma_u_px,sigma_v_px,flux,peak,major_px,minor_px,angle_deg,cov_uv_px2"]
    for frame in range(12):
        for (camera, _), (u, v) in zip(model.views, (uv + rng.normal(0, 0.05, uv.shape)).tolist(), strict=True):
            rows.append(f"{frame},{camera},{u:.4f},{v:.4f},0.05,0.05,1000,100,2,2,0,0")
    (run / "detections.csv").write_text("\n".join(rows) + "\n")
    yaw, pitch, roll = np.rad2deg(AT_REST.ypr).tolist()
    (run / "run.yaml").write_text(
        "schema: beampose/run/1\nname: at rest\nrig: rig.yaml\nframe_rate_hz: 100.0\n"
        "cameras:\n  left: {detections: detections.csv}\n  right: {detections: detections.csv}\n"
        f"prior:\n  position_m: [0.05, 0.02, -0.03]\n  yaw_pitch_roll_deg: [{yaw:.3f}, {pitch:.3f}, {roll:.3f}]\n"
        "  within_m: 0.2\n  within_deg: 10.0\n"
    )
    pose = scenes.write_still(tmp_path / "stated", TRUE, AT_REST, rng) / "pose.csv"
    outcome = check_drift(rig, tmp_path / "out", DriftInputs(run=run, pose=pose), today=scenes.DAY)
    assert of(outcome, "left").change.kind == TURNED
    assert of(outcome, "right").level == Level.PASS


@pytest.mark.parametrize("on_screens", [False, True], ids=["surveyed", "screen coordinates"])
def test_the_sigma_of_the_prediction_agrees_with_numeric_derivatives(tmp_path, on_screens):
    """Every parameter of a camera and a curved screen is varied; points given on the screen move with it."""
    bent = replace(RIG.screens["left"], bow=(2e-3, -1e-3, 1e-3))
    rig = Rig({**RIG.screens, "left": bent}, RIG.cameras, RIG.beams, RIG.spots)
    names = tuple(n for n in rig_names(rig, bow=True) if n.startswith(("cameras.left.", "screens.left.")))
    sigma = np.array([0.5 if n.endswith((".fx", ".fy", ".cx", ".cy")) else 3e-4 for n in names])
    pixels, survey = scenes.write_points(tmp_path, rig, np.random.default_rng(0), on_screens=on_screens)
    known = read_points(pixels, survey, rig, 0.1)
    one = compare_points(rig, known, RigCovariance(names, np.diag(sigma**2)), pixels)[0]
    mine = [i for i, c in enumerate(known.camera) if c == "left"]

    def predicted(delta: np.ndarray) -> np.ndarray:
        lab = perturbed_rig(rig, names, delta)
        screen, out = lab.screens["left"], []
        for i in mine:
            x, y, z = known.xyz[i]
            a, b, c = screen.bow
            local = np.array([x, y, a * x * x + b * x * y + c * y * y])
            world = screen.world_from_screen.apply(local) if on_screens else np.array([x, y, z])
            out.append(lab.cameras["left"].project(world))
        return np.array(out)

    J = np.stack(
        [(predicted(e) - predicted(-e)) / 2e-3 for e in 1e-3 * np.diag(sigma)], axis=-1
    )  # per sigma of each parameter
    expected = np.sqrt(np.sum(J**2, axis=-1).mean(axis=1))
    np.testing.assert_allclose(one.calibration_sigma_px, expected, rtol=1e-5)
    np.testing.assert_allclose(one.predicted, predicted(np.zeros(len(names))), atol=1e-9)
