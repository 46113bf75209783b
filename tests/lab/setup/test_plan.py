"""Plan of a rig: tables that agree with the geometry, findings that follow from them, and refused input."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from calibration.budget import AXES, NOISE, STATUS, ExpectedErrors, plan_grid, poses_of
from geometry.forward_model import SpotModel
from geometry.pose import Pose, ypr_sigmas
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.errors import InputError
from lab.files.rig.rig_file import RigFile, load_rig_file, save_rig
from lab.findings.finding import Level
from lab.setup.plan import cell_map, effect_columns, fine_map, plan_columns, plan_of, plan_rig, share_bars
from lab.setup.plan_findings import (
    CORRELATION,
    TOTAL_CALIBRATION,
    PlanOptions,
    Range,
    advice,
    axis_words,
    budget_lines,
    findings,
    worst_first,
)
from tests.geometry.scenes import LENSES, paper_rig
from tests.lab.tables import rows_of

SMALL = PlanOptions(
    {
        "x_m": Range(-0.1, 0.1, 3), "y_m": Range(-0.1, 0.1, 3), "z_m": Range(0.1, 0.1, 1),
        "yaw_deg": Range(-4, 4, 3), "pitch_deg": Range(-6, 6, 3), "roll_deg": Range(-5, 5, 2),
    }
)  # fmt: skip
NO_ERRORS = ExpectedErrors(
    focal_relative=0, centre_px=0, distortion_px=0, dot_px=1e-9, dot_survey_m=0, screen_position_m=0,
    screen_rotation_deg=0, beam_direction_arcsec=0, beam_point_m=0,
)  # fmt: skip


def over(**ranges):
    return replace(SMALL, stated={**SMALL.stated, **ranges})


@pytest.fixture
def rig_path(tmp_path):
    save_rig(paper_rig(LENSES[5], size_m=(4.0, 3.0)), tmp_path / "rig.yaml")
    return tmp_path / "rig.yaml"


def test_a_plan_is_two_tables_and_a_page(rig_path, tmp_path):
    outcome = plan_rig(rig_path, tmp_path / "plan", SMALL)
    assert {p.name for p in (tmp_path / "plan").iterdir()} == {"plan.csv", "effects.csv", "report.html", "summary.json"}
    plan = plan_of(rig_path, SMALL)
    rows = rows_of(tmp_path / "plan" / "plan.csv")
    assert tuple(rows[0]) == plan_columns(plan)
    assert len(rows) == len(outcome.result.status) == SMALL.count == 162
    assert tuple(rows_of(tmp_path / "plan" / "effects.csv")[0]) == effect_columns()
    assert outcome.line().startswith("plan: PASS: 100 % of 162 poses can be measured, sigma ")
    assert (outcome.level, outcome.exit_status) == (Level.PASS, 0)
    page = (tmp_path / "plan" / "report.html").read_text()
    assert "z 0.1 m; yaw -4 to 4 deg (3); pitch -6 to 6 deg (3); roll -5 to 5 deg (2)." in page
    for title in ("What to improve first", "Error budget", "Over yaw and pitch", "Over x and y", "Visibility",
                  "Worst poses", "Effects of the calibration errors", "Assumptions"):  # fmt: skip
        assert f"<h2>{title}</h2>" in page
    assert "http" not in page.replace("http://www.w3.org", "").replace("http-equiv", "")


def test_a_row_agrees_with_the_geometry_of_its_pose(rig_path, tmp_path):
    plan_rig(rig_path, tmp_path / "plan", SMALL)
    rig = load_rig_file(rig_path).rig
    model = SpotModel.of(rig)
    for row in rows_of(tmp_path / "plan" / "plan.csv")[::23]:
        pose = Pose.from_ypr(
            np.deg2rad([float(row[f"{a}_deg"]) for a in ("yaw", "pitch", "roll")]),
            np.array([float(row[f"{a}_m"]) for a in "xyz"]),
        )
        pixels, _ = model.project(pose)
        for (camera, spot), (u, v) in zip(model.views, pixels, strict=True):
            margin = min(u + 0.5, v + 0.5, 1279.5 - u, 1023.5 - v)
            assert float(row[f"margin_{camera}_{spot}_px"]) == pytest.approx(margin, rel=1e-5, abs=1e-3)
        assert int(row["spots_in_view"]) == np.sum(
            [float(row[f"margin_{c}_{s}_px"]) >= SMALL.edge_px for c, s in model.views]
        )
        gaps = [np.linalg.norm(pixels[i] - pixels[j]) for i, j in ((0, 1), (0, 2), (1, 2), (3, 4), (3, 5), (4, 5))]
        assert float(row["closest_spots_px"]) == pytest.approx(min(gaps), rel=1e-5)


def test_without_calibration_errors_the_sigmas_are_those_of_the_pose_solver(rig_path):
    plan = plan_of(rig_path, replace(SMALL, expected=NO_ERRORS))
    model = SpotModel.of(plan.rig)
    for i in range(0, len(plan.status), 31):
        pose = poses_of(plan.coordinates[i : i + 1])[0]
        _, J = model.project(pose)
        J = J[plan.seen[i]].reshape(-1, 6) / SMALL.sigma_px
        C = np.linalg.inv(J.T @ J)
        np.testing.assert_allclose(plan.sigma[i, :3], np.sqrt(np.diagonal(C)[:3]), rtol=1e-6)
        np.testing.assert_allclose(plan.sigma[i, 3:], np.rad2deg(ypr_sigmas(pose, C)), rtol=1e-6)
        assert plan.worst[i, 1] == pytest.approx(np.rad2deg(np.sqrt(np.linalg.eigvalsh(C[3:, 3:])[-1])), rel=1e-6)


def test_the_variances_of_contributions_and_of_parts_of_the_rig_add_up(rig_path):
    plan = plan_of(rig_path, over(x_m=Range(0, 0, 1), y_m=Range(0, 0, 1), yaw_deg=Range(7, 7, 1),
                                     pitch_deg=Range(3, 3, 1), roll_deg=Range(0, 0, 1)))  # fmt: skip
    np.testing.assert_allclose((plan.parts**2).sum(axis=1), plan.sigma**2, rtol=1e-6)
    for k, group in enumerate(plan.contributors):
        if group != NOISE:
            own = [i for i, (_, g, _) in enumerate(plan.errors.things) if g == group]
            total = np.sqrt((plan.thing_median[own] ** 2).sum(axis=0))
            np.testing.assert_allclose(total, plan.parts[0, k], rtol=1e-5)  # things are kept in single precision
    assert sum(line.share_deg for line in budget_lines(plan)) == pytest.approx(1)
    assert sum(line.share_m for line in budget_lines(plan)) == pytest.approx(1)


def test_the_advice_names_the_largest_contribution(rig_path):
    noisy = plan_of(rig_path, replace(SMALL, sigma_px=1.0))
    assert advice(noisy)[0].startswith("Attitude: noise contributes 9")
    poor_beams = plan_of(rig_path, replace(SMALL, expected=ExpectedErrors(beam_direction_arcsec=300)))
    assert advice(poor_beams)[0].startswith("Attitude: beam directions contributes 9")
    assert "Calibrate the beams at more stand attitudes" in advice(poor_beams)[0]


def test_halving_the_largest_contribution_has_the_effect_stated_in_the_budget(rig_path):
    """Within 3 %: the weights of the spots change, and the median moves to another pose."""
    expected = ExpectedErrors(beam_direction_arcsec=60)
    before = budget_lines(plan_of(rig_path, replace(SMALL, expected=expected)))[0]
    assert before.name == "beam directions"
    after = plan_of(rig_path, replace(SMALL, expected=replace(expected, beam_direction_arcsec=30)))
    assert np.median(after.worst[:, 1]) == pytest.approx(before.halved_deg, rel=0.03)


def test_the_covariance_of_the_rig_file_is_used(rig_path):
    file = load_rig_file(rig_path)
    names = tuple(f"beams.{b}.direction_{a}" for b in "ABC" for a in "xyz")
    joint = (*names, "cameras.left.cx", "cameras.left.rot_y_rad")
    C = np.diag([1e-8] * 9 + [0.09, 6.25e-8])
    C[9, 10] = C[10, 9] = -0.1 * 0.3 * 2.5e-4
    save_rig(RigFile(file.rig, {"target": RigCovariance(joint, C)}), rig_path)
    plan = plan_of(rig_path, SMALL)
    assert set(plan.sources.values()) == {"rig file"}
    lines = {line.name: line for line in budget_lines(plan)}
    assert set(lines) == {NOISE, "beam directions", "camera intrinsics", "camera poses", CORRELATION}
    assert sum(line.share_m for line in lines.values()) == pytest.approx(1)
    save_rig(RigFile(file.rig, {"target": RigCovariance(names, C[:9, :9])}), rig_path)
    assert plan_of(rig_path, SMALL).sources["beam directions"] == "rig file"
    assert plan_of(rig_path, SMALL).sources["camera poses"] == "assumed"


def test_strongly_correlated_groups_are_combined_into_one_line(rig_path):
    file = load_rig_file(rig_path)
    joint = tuple(f"cameras.{c}.{p}" for c in ("left", "right") for p in ("cx", "rot_y_rad"))
    one = np.array([[9.0, 0.999 * 3.0 * 2.5e-3], [0.999 * 3.0 * 2.5e-3, 6.25e-6]])  # px and rad that cancel
    save_rig(RigFile(file.rig, {"target": RigCovariance(joint, np.kron(np.eye(2), one))}), rig_path)
    lines = {line.name: line for line in budget_lines(plan_of(rig_path, SMALL))}
    assert set(lines) == {NOISE, TOTAL_CALIBRATION}
    assert sum(line.share_deg for line in lines.values()) == pytest.approx(1)
    assert lines[TOTAL_CALIBRATION].share_deg > 0.05


def test_unobservable_poses_are_reported(rig_path, tmp_path):
    wide = over(yaw_deg=Range(-80, 80, 9))
    found = findings(plan_of(rig_path, wide))
    assert found[0].level in (Level.WARN, Level.FAIL)
    assert "are not observable" in found[0].what
    assert "the share is largest at yaw −80° (100 %)" in found[0].what
    assert advice(plan_of(rig_path, wide))[0].startswith("Visibility: ")
    plan = plan_of(rig_path, wide)
    assert np.isnan(plan.worst[~plan.observable]).all()
    first, *_ = worst_first(plan, 9)
    assert STATUS[plan.status[first]] == "not observable"
    outcome = plan_rig(rig_path, tmp_path / "plan", wide)
    assert f"{100 * outcome.result.measured.mean():.1f} %" in outcome.line()


def test_a_rig_that_sees_nothing_of_the_range_fails(rig_path, tmp_path):
    away = over(z_m=Range(40, 41, 2))
    outcome = plan_rig(rig_path, tmp_path / "plan", away)
    assert (outcome.level, outcome.result.measured.mean(), outcome.exit_status) == (Level.FAIL, 0.0, 4)
    page = (tmp_path / "plan" / "report.html").read_text()
    assert "At no pose of the grid are enough spots in the pictures." in page
    assert "No pose is observable" in page
    assert rows_of(tmp_path / "plan" / "plan.csv")[0]["sigma_x_m"] == ""


@pytest.mark.parametrize(
    ("goal", "level"), [(1.0, Level.PASS), (1e-6, Level.FAIL)]
)  # deg: reached by all, and by no pose
def test_a_goal_is_tested(goal, level, rig_path):
    last = findings(plan_of(rig_path, replace(SMALL, goal_deg=goal)))[-1]
    assert last.what.startswith("The attitude sigma is within ")
    assert last.level is level


def test_close_spots_have_a_warning(rig_path):
    file = load_rig_file(rig_path)
    beams = {**file.rig.beams, "B": replace(file.rig.beams["A"], name="B", point=np.array([0, 0.002, 0]))}
    save_rig(replace(file.rig, beams=beams), rig_path)
    assert any("are within 10 px of each other in 100 %" in f.what for f in findings(plan_of(rig_path, SMALL)))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"stated": {"yaw_deg": Range(10, -10, 3)}}, "yaw_deg: expected the first end below the last, got 10 and -10"),
        ({"stated": {"x_m": Range(0, np.nan, 3)}}, "x_m: expected finite ends"),
        ({"stated": {"x_m": Range(0, 1, 0)}}, "x_m: expected a count of 1 or more, got 0"),
        ({"sigma_px": 0.0}, "sigma_px: expected a number above 0, got 0"),
        ({"goal_m": -1.0}, "goal_m: expected a number of 0 or more, got -1"),
        ({"expected": ExpectedErrors(centre_px=-1)}, "expected.centre_px: expected a number of 0 or more, got -1"),
        ({"stated": {"x_m": Range(0, 1, 1000), "y_m": Range(0, 1, 1000)}}, "expected at most 100000 poses"),
    ],
)
def test_invalid_options_are_refused(options, words):
    with pytest.raises(InputError) as caught:
        PlanOptions(**options)
    assert words in str(caught.value)


def test_nothing_is_written_for_an_invalid_rig_or_into_another_folder(rig_path, tmp_path):
    (tmp_path / "bad.yaml").write_text("schema: beampose/rig/1\n")
    with pytest.raises(InputError, match="screens: expected a value"):
        plan_rig(tmp_path / "bad.yaml", tmp_path / "plan", SMALL)
    assert not (tmp_path / "plan").exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("x")
    with pytest.raises(InputError, match="the folder holds something other than earlier results"):
        plan_rig(rig_path, tmp_path / "mine", SMALL)
    plan_rig(rig_path, tmp_path / "plan", SMALL)
    plan_rig(rig_path, tmp_path / "plan", over(roll_deg=Range(0, 0, 1)))  # an earlier plan is replaced
    assert len(rows_of(tmp_path / "plan" / "plan.csv")) == 81


def test_the_plan_does_not_depend_on_the_number_of_poses_computed_at_once(rig_path, monkeypatch):
    whole = plan_of(rig_path, SMALL)
    monkeypatch.setattr("calibration.budget._POSES_AT_ONCE", 7)
    pieces = plan_grid(whole.rig, whole.errors, whole.sources, SMALL)
    for name in ("sigma", "parts", "worst_parts", "effect_median", "thing_largest", "margin_px"):
        np.testing.assert_allclose(getattr(pieces, name), getattr(whole, name), rtol=1e-5, atol=1e-12)
    assert len(AXES) == whole.sigma.shape[1]


@pytest.mark.parametrize(("across", "up"), [(3, 4), (4, 3), (0, 3)])
def test_the_axes_of_a_smooth_map_are_its_coordinates(across, up, rig_path):
    plan = plan_of(rig_path, SMALL)
    values = fine_map(plan, across, up)
    ranges = list(SMALL.ranges.items())
    for row, column in ((0, -1), (-1, 0)):
        place = {name: Range(r.middle, r.middle, 1) for name, r in ranges}
        for i, end in ((across, column), (up, row)):
            name, r = ranges[i]
            place[name] = Range(*2 * (r.values()[end],), 1)
        alone = plan_of(rig_path, over(**place))
        np.testing.assert_allclose(values[row, column], alone.worst[0], rtol=1e-9)
    assert abs(values[0, -1, 1] / values[-1, 0, 1] - 1) > 1e-4  # otherwise swapped axes would pass


def test_a_pose_too_uncertain_for_a_run_does_not_count_as_measured(rig_path):
    plan = plan_of(rig_path, replace(SMALL, sigma_px=200.0))
    assert {STATUS[i] for i in plan.status} == {"vague"}
    assert plan.observable.all()
    first = findings(plan)[0]
    assert "0 are not observable, 162 are too uncertain to count as measured" in first.what
    assert first.level is Level.FAIL


def test_directions_in_words():
    assert axis_words(np.array([0.02, 0.99, 0.0])) == "y"
    assert axis_words(np.array([0.8, 0.0, -0.6])) == "0.8 x − 0.6 z"
    assert axis_words(np.full(3, np.nan)) == "–"


def test_drawings_show_every_number_and_cross_out_missing_ones():
    grid = np.array([[1.0, 2.0], [np.nan, 3000.0]])
    text = cell_map(grid, np.array([0.0, 1.0]), np.array([5.0, 6.0]), "a < b", x_name="x (m)", y_name="y (m)")
    assert all(f">{word}</text>" in text for word in ("1", "2", "3000", "×", "5", "6", "a &lt; b"))
    assert ">66.3 %</text>" in share_bars([("noise", 0.663), ("rest", -0.1)], "shares")


@pytest.mark.slow
def test_ten_thousand_poses_take_seconds(rig_path, tmp_path):
    """2.6 s on two idle cores; the limit allows for a busy machine."""
    start = time.perf_counter()
    assert len(plan_rig(rig_path, tmp_path / "plan").result.status) == 11025
    assert time.perf_counter() - start < 40
