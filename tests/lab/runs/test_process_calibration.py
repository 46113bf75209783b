"""A rig's calibration in a run: its covariance appears in the tables and the report, its expiry in the exit status."""

from __future__ import annotations

import dataclasses
import datetime

import numpy as np
import pytest
import yaml

from geometry.uncertainty.rig_uncertainty import RigCovariance, rig_names
from lab.errors import CalibrationError
from lab.files.rig.camera_file import CalibrationState
from lab.files.rig.rig_file import RigFile, load_rig_file, save_rig
from lab.files.run.results import read_poses
from lab.findings.finding import Level
from lab.runs.batch.batch import process_batch
from lab.runs.process import process_run
from lab.simulate.write import simulate
from tests.lab.tables import rows_of

DAY = datetime.date(2026, 3, 14)


@pytest.fixture
def run_folder(tmp_path):
    return simulate("smooth", tmp_path / "run", seed=5, frames=10, points=True)


def change_rig(run_folder, **changes):
    path = run_folder / "rig.yaml"
    save_rig(dataclasses.replace(load_rig_file(path), **changes), path)


def covariance(rig, sigma=2e-4):
    names = rig_names(rig)
    return {
        "target": RigCovariance(names, np.diag([(1.0 if n.endswith((".cx", ".cy")) else sigma) ** 2 for n in names]))
    }


def test_the_calibrations_covariance_is_in_its_own_table_and_in_the_total(run_folder, tmp_path, with_page):
    process_run(run_folder, tmp_path / "without")
    assert not (tmp_path / "without" / "systematic.csv").exists()
    rig = load_rig_file(run_folder / "rig.yaml").rig
    change_rig(run_folder, covariances=covariance(rig))
    process_run(run_folder, tmp_path / "with")
    plain, poses = read_poses(tmp_path / "without"), read_poses(tmp_path / "with")
    noise = poses.covariance - poses.systematic
    assert np.linalg.eigvalsh(noise).min() > 0
    assert np.linalg.eigvalsh(poses.systematic).min() > -1e-12
    # A principal point with a sigma of 1 px outweighs spots with a sigma of 0.1 px.
    variances, alone = (np.diagonal(p.covariance, axis1=1, axis2=2) for p in (poses, plain))
    assert np.all(variances > 2 * alone)
    rows = rows_of(tmp_path / "with" / "systematic.csv")
    assert len(rows) == 10
    assert float(rows[0]["c00"]) == pytest.approx(poses.systematic[0, 0, 0])
    report = (tmp_path / "with" / "report.html").read_text()
    assert "calibration part" in report
    assert "averaging does not reduce them" in report
    assert "states no covariance of its calibration" in (tmp_path / "without" / "report.html").read_text()


def test_an_expired_calibration_stops_a_run_and_leaves_nothing(run_folder, tmp_path):
    change_rig(run_folder, calibration=CalibrationState(date=DAY, verdict="PASS", valid_until=DAY))
    with pytest.raises(CalibrationError, match="out of date"):
        process_run(run_folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_day_of_the_recording_counts_where_the_run_states_it(run_folder, tmp_path):
    change_rig(
        run_folder,
        calibration=CalibrationState(
            date=DAY, verdict="WARN", valid_until=DAY, reasons=("a corner of the picture was not covered",)
        ),
    )
    path = run_folder / "run.yaml"
    content = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump({**content, "recorded": "2026-03-14"}))
    assert process_run(run_folder, tmp_path / "out").exit_status == 0
    path.write_text(yaml.safe_dump({**content, "recorded": "2026-03-15"}))
    with pytest.raises(CalibrationError, match=r"1 day before 2026-03-15 \(the recording's day\)"):
        process_run(run_folder, tmp_path / "late")


def test_a_batch_with_an_expired_calibration_ends_with_status_3(run_folder, tmp_path):
    good = simulate("smooth", tmp_path / "good", seed=6, frames=8, points=True)
    change_rig(
        run_folder,
        calibration=CalibrationState(date=DAY, verdict="FAIL", valid_until=None, reasons=("the stand did not roll",)),
    )
    outcome = process_batch([good, run_folder], tmp_path / "out")
    assert outcome.exit_status == 3
    assert (tmp_path / "out" / "good" / "report.html").exists()
    assert "FAIL" in (tmp_path / "out" / "batch.csv").read_text()


def test_the_calibration_of_unused_cameras_is_ignored(run_folder, tmp_path):
    file = load_rig_file(run_folder / "rig.yaml")
    extra = dataclasses.replace(file.rig.cameras["left"], name="spare")
    rig = dataclasses.replace(file.rig, cameras={**file.rig.cameras, "spare": extra})
    save_rig(RigFile(rig, covariance(rig)), run_folder / "rig.yaml")
    assert process_run(run_folder, tmp_path / "out").exit_status == 0


def test_a_calibrated_run_whose_vehicle_is_never_found_fails_and_has_its_tables(run_folder, tmp_path):
    """A lens cap on one camera: no pose in any frame, and so none at which the calibration's errors are asked for."""
    change_rig(run_folder, covariances=covariance(load_rig_file(run_folder / "rig.yaml").rig))
    points = run_folder / "detections.csv"
    lines = points.read_text("utf-8").splitlines(keepends=True)
    points.write_text("".join(line for line in lines if ",left," not in line), "utf-8")
    outcome = process_run(run_folder, tmp_path / "out")
    assert (outcome.verdict.exit_status, outcome.result.measured) == (4, 0)
    assert np.isnan(read_poses(tmp_path / "out").systematic).all()


@pytest.mark.parametrize(
    ("scenario", "off_m", "within_m", "rank"), [("huo2015", 0.3, 0.05, 0), ("smooth", 1.0, 0.001, 1)]
)
def test_a_prior_that_the_first_pose_contradicts_is_a_reason_of_the_verdict(tmp_path, scenario, off_m, within_m, rank):
    """The vehicle is found later, among all poses, and the smoothing pass goes back to the first frame.

    rank: among the reasons. The prior, or the pose, is wrong: the second scenario's poses contradict the truth.
    """
    run_folder = simulate(scenario, tmp_path / "run", seed=5, frames=60, points=True)
    assert process_run(run_folder, tmp_path / "right").verdict.status == "pass"
    content = yaml.safe_load((run_folder / "run.yaml").read_text("utf-8"))
    at = content["prior"]["position_m"]
    content["prior"] |= {"position_m": [at[0] + off_m, at[1], at[2]], "within_m": within_m}
    (run_folder / "run.yaml").write_text(yaml.safe_dump(content), "utf-8")
    reason = process_run(run_folder, tmp_path / "wrong").verdict.findings[rank]
    assert (reason.code, reason.level) == ("BP-M08", Level.WARN)
    assert reason.what.startswith("the first frame's pose is outside the prior of run.yaml: a coordinate is ")
    assert f"(within_m: {within_m})" in reason.what
    assert "within_m" in reason.remedy
