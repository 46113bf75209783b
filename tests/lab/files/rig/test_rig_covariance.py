"""The covariance blocks of a rig file as one covariance, and the validity of a calibration."""

from __future__ import annotations

import datetime

import numpy as np
import pytest

from geometry.uncertainty.rig_uncertainty import RigCovariance, rig_names
from lab.errors import CalibrationError, InputError
from lab.files.rig.camera_file import CalibrationState, require_valid_calibration
from lab.files.rig.rig_file import RigFile, joint_covariance, load_rig_file, save_rig
from lab.simulate.scenarios import RIGS

RIG = RIGS["fan"]()


def test_separate_blocks_are_uncorrelated():
    blocks = {
        "cameras.left": RigCovariance(("fx", "cx"), np.array([[4.0, 1.0], [1.0, 9.0]])),
        "screens.right": RigCovariance(("x_m",), np.array([[1e-6]])),
        "target": RigCovariance(("beams.A.direction_x",), np.array([[1e-8]])),
    }
    joint = joint_covariance(RIG, blocks, "rig.yaml")
    assert joint.names == ("cameras.left.fx", "cameras.left.cx", "screens.right.x_m", "beams.A.direction_x")
    expected = np.diag([4.0, 9.0, 1e-6, 1e-8])
    expected[0, 1] = expected[1, 0] = 1.0
    np.testing.assert_array_equal(joint.matrix, expected)


def test_a_joint_block_of_the_target_is_complete():
    blocks = {
        "cameras.left": RigCovariance(("fx",), np.array([[4.0]])),
        "target": RigCovariance(("cameras.left.fx", "beams.A.direction_x"), np.array([[4.0, 1e-5], [1e-5, 1e-8]])),
    }
    joint = joint_covariance(RIG, blocks, "rig.yaml")
    assert joint.names == ("cameras.left.fx", "beams.A.direction_x")
    assert joint.matrix[0, 1] == 1e-5


def test_unknown_names_are_ignored():
    blocks = {"target": RigCovariance(("A.x", "beams.A.point_x_m", "B.y"), np.diag([-1.0, 4e-8, np.pi]))}
    joint = joint_covariance(RIG, blocks, "rig.yaml")
    assert joint.names == ("beams.A.point_x_m",)
    assert joint_covariance(RIG, {"target": RigCovariance(("A.x",), np.eye(1))}, "rig.yaml") is None
    assert joint_covariance(RIG, {}, "rig.yaml") is None


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        ([[1.0, 0.5], [0.1, 1.0]], "expected a symmetric matrix"),
        ([[1.0, 2.0], [2.0, 1.0]], "negative eigenvalue"),
        ([[-1.0, 0.0], [0.0, 1.0]], "expected variances of 0 or more"),
    ],
)
def test_a_matrix_that_is_not_a_covariance_is_refused_with_its_field(matrix, words):
    blocks = {"cameras.left": RigCovariance(("fx", "fy"), np.array(matrix))}
    with pytest.raises(InputError, match=f"rig.yaml: cameras.left.covariance.matrix: .*{words}"):
        joint_covariance(RIG, blocks, "rig.yaml")


def test_state_bow_and_joint_covariance_are_saved_and_loaded(tmp_path):
    import dataclasses

    names = rig_names(RIG)
    rng = np.random.default_rng(0)
    A = rng.normal(size=(len(names), len(names)))
    bent = dataclasses.replace(RIG.screens["left"], bow=(0.001, -0.0002, 0.0005))
    rig = dataclasses.replace(RIG, screens={**RIG.screens, "left": bent})
    state = CalibrationState(
        date=datetime.date(2026, 3, 14),
        verdict="WARN",
        valid_until=datetime.date(2026, 9, 14),
        reasons=("the left screen is bent",),
        notes="by night",
    )
    save_rig(RigFile(rig, {"target": RigCovariance(names, A @ A.T)}, state), tmp_path / "rig.yaml")
    again = load_rig_file(tmp_path / "rig.yaml")
    assert again.calibration == state
    assert again.rig.screens["left"].bow == bent.bow
    np.testing.assert_array_equal(joint_covariance(again.rig, again.covariances, "").matrix, A @ A.T)


DAY = datetime.date(2026, 3, 14)


def test_a_calibration_may_be_used_up_to_its_last_day_and_not_after(tmp_path):
    state = CalibrationState(date=DAY, verdict="PASS", valid_until=DAY + datetime.timedelta(90))
    require_valid_calibration(state, tmp_path / "rig.yaml", DAY + datetime.timedelta(90))
    words = r"valid_until: 2026-06-12 was 1 day before 2026-06-13 \(the recording's day\)"
    with pytest.raises(CalibrationError, match=words) as caught:
        require_valid_calibration(state, tmp_path / "rig.yaml", DAY + datetime.timedelta(91))
    assert caught.value.exit_status == 3
    assert "calibrate check" in str(caught.value)


def test_a_failed_calibration_is_refused_with_the_reason(tmp_path):
    state = CalibrationState(date=DAY, verdict="FAIL", valid_until=None, reasons=("the stand did not roll",))
    with pytest.raises(CalibrationError, match=r"FAIL \(the stand did not roll\)"):
        require_valid_calibration(state, tmp_path / "rig.yaml", DAY)


def test_a_rig_without_a_calibration_state_may_be_used(tmp_path):
    require_valid_calibration(None, tmp_path / "rig.yaml", DAY)
    require_valid_calibration(CalibrationState(date=DAY, verdict="WARN"), tmp_path / "rig.yaml", DAY)


@pytest.mark.parametrize("date", ["yesterday", "14.3.2026", "2026-13-01", "7"])
def test_an_invalid_date_is_refused(tmp_path, date):
    save_rig(RigFile(RIG, {}, CalibrationState(date=DAY, verdict="PASS")), tmp_path / "rig.yaml")
    text = (tmp_path / "rig.yaml").read_text().replace("2026-03-14", date)
    (tmp_path / "rig.yaml").write_text(text)
    with pytest.raises(InputError, match=r"calibration.date: expected a date such as 2026-03-14"):
        load_rig_file(tmp_path / "rig.yaml")
