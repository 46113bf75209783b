"""The score reports the errors that a run has by construction."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geometry.pose import Pose
from lab.errors import InputError
from lab.files.run.results import ABSENT, SPOT_STATUSES, ResultFolder, SpotGrid, read_poses, read_spots
from lab.runs.verdict.score import (
    TruthArrays,
    _returns,
    against_truth,
    differenced,
    measured_errors,
    normalised_squares,
    read_tables,
    read_truth,
    right_spot,
    score_against,
)
from tests.lab.fake_results import MOTION_SIGMA, NOISE_PX, Fake, make
from tracking.statuses import PoseStatus, SpotStatus


@pytest.fixture(scope="module")
def quiet(tmp_path_factory: pytest.TempPathFactory) -> Fake:
    """600 frames in which every spot in the picture has the correct label."""
    return make(tmp_path_factory.mktemp("quiet"), 600, eventful=False)


@pytest.fixture(scope="module")
def eventful(tmp_path_factory: pytest.TempPathFactory) -> Fake:
    return make(tmp_path_factory.mktemp("eventful"), 600)


def score(results: Path, run_folder: Path) -> dict[str, Any] | None:
    return against_truth(read_tables(ResultFolder(results)), run_folder).errors


def rewritten(source: Fake, folder: Path, change: Callable[[dict[str, str]], dict[str, str] | None]) -> Path:
    """A copy of the results with every row of spots.csv passed through `change`; None removes the row."""
    folder.mkdir(exist_ok=True)
    for path in source.results.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    with (source.results / "spots.csv").open(newline="") as file:
        reader = csv.DictReader(file)
        rows = [row for old in reader if (row := change(old)) is not None]
    with (folder / "spots.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, reader.fieldnames or [])
        writer.writeheader()
        writer.writerows(rows)
    return folder


def test_a_run_with_correct_labels_scores_one_and_its_errors_are_the_added_noise(quiet):
    s = score(quiet.results, quiet.run_folder)["spots"]
    assert s["in_view_identity"] == 1.0
    assert s["wrong_labels"] == 0
    assert s["visible_but_not_found_rows"] == 0
    n = s["measured_px"]["rows"]
    tolerance = 4 / np.sqrt(2 * n)  # four sigmas of an RMS of n numbers
    for axis in ("rms_u", "rms_v"):
        assert s["measured_px"][axis] == pytest.approx(NOISE_PX, rel=tolerance)
        assert s["prediction_px"]["all_measured"][axis] == pytest.approx(0.2, rel=tolerance)


def test_poses_with_correct_covariances_have_a_mean_nees_of_six(quiet):
    block = score(quiet.results, quiet.run_folder)["pose"]["measured"]
    low, high = block["nees_mean_95"]
    assert low < block["nees_mean"] < high
    assert low < 6 < high


def test_the_errors_of_measured_poses_are_those_that_the_score_counts(eventful):
    delta, covariance = measured_errors(eventful.results, eventful.run_folder)
    measured = score(eventful.results, eventful.run_folder)["pose"]["measured"]
    assert len(delta) == len(covariance) == measured["rows"]
    assert np.mean(normalised_squares(delta, covariance)) == pytest.approx(measured["nees_mean"])


def test_half_the_stated_covariance_doubles_the_nees(quiet):
    spots, poses = read_spots(quiet.results), read_poses(quiet.results)
    truth = read_truth(quiet.run_folder, spots, poses)
    once = score_against(spots, poses, truth)["pose"]["measured"]["nees_mean"]
    twice = score_against(spots, replace(poses, covariance=poses.covariance / 2), truth)["pose"]["measured"][
        "nees_mean"
    ]
    assert twice == pytest.approx(2 * once, rel=1e-9)


def test_nees_includes_the_correlations_of_the_covariance():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(50, 6, 6)) * np.array([1e-3, 1e-3, 1e-3, 1e-5, 1e-5, 1e-5])[:, None]  # metres and radians
    C, delta = A @ np.swapaxes(A, 1, 2), rng.normal(size=(50, 6)) * 1e-4
    plain = np.einsum("ni,nij,nj->n", delta, np.linalg.inv(C), delta)
    np.testing.assert_allclose(normalised_squares(delta, C), plain, rtol=1e-6)


def test_a_singular_covariance_has_no_nees():
    C = np.stack([np.zeros((6, 6)), np.ones((6, 6)), np.full((6, 6), np.nan)])
    assert np.isnan(normalised_squares(np.ones((3, 6)), C)).all()


def test_a_known_pose_error_is_reported_in_body_and_world_axes(quiet):
    spots, poses = read_spots(quiet.results), read_poses(quiet.results)
    delta = np.array([1e-3, -2e-3, 3e-3, *np.radians([0.1, 0.2, -0.3])])
    truth = TruthArrays(None, None, poses.world_from_body.plus(np.broadcast_to(delta, (len(poses.frames), 6))))
    out = score_against(spots, poses, truth)
    assert out["spots"] is None
    assert list(out["pose"]["measured"]["position_rms_m"].values()) == pytest.approx([1e-3, 2e-3, 3e-3])
    assert list(out["pose"]["measured"]["rotation_rms_deg"].values()) == pytest.approx([0.1, 0.2, 0.3])


def test_two_swapped_labels_are_wrong_in_exactly_those_frames(quiet, tmp_path):
    swap = {"1": "2", "2": "1"}

    def change(row: dict[str, str]) -> dict[str, str]:
        if 100 <= int(row["frame"]) < 110:
            row["spot"] = swap.get(row["spot"], row["spot"])
        return row

    s = score(rewritten(quiet, tmp_path / "results", change), quiet.run_folder)["spots"]
    assert s["wrong_labels"] == 20
    assert s["in_view_identity"] == pytest.approx(1 - 20 / s["in_view_rows"], abs=1e-12)
    assert [r["wrong_labels"] for r in s["per_spot"]] == [10, 10, 0, 0, 0, 0]


def test_clutter_that_is_labelled_as_a_spot_is_a_wrong_label(quiet, tmp_path):
    def change(row: dict[str, str]) -> dict[str, str]:
        if row["frame"] == "50" and row["spot"] == "5":
            row["u_px"] = str(float(row["u_px"]) + 5.0)
        return row

    assert score(rewritten(quiet, tmp_path / "results", change), quiet.run_folder)["spots"]["wrong_labels"] == 1


def test_spots_that_cross_closer_than_the_noise_do_not_count_as_swapped():
    true_uv = np.array([[[100.0, 100.0], [100.3, 100.0]]])
    measured = SpotGrid(
        frames=np.array([0]), t_s=np.zeros(1), views=(("a", "1"), ("a", "2")), uv_px=true_uv[:, ::-1].copy(),
        sigma_px=np.full((1, 2, 2), 0.1), predicted_px=true_uv, status=np.zeros((1, 2), np.int64),
        label_probability=np.ones((1, 2)), cov_uv_px2=np.zeros((1, 2)),
    )  # fmt: skip
    assert right_spot(measured, true_uv).all()
    apart = true_uv + np.array([[[0.0, 0.0], [2.0, 0.0]]])  # 2.3 px: above the noise, below the tolerance
    assert not right_spot(replace(measured, uv_px=apart[:, ::-1]), apart).any()
    damaged = replace(measured, sigma_px=np.full((1, 2, 2), 1.7e308))
    with np.errstate(all="raise"):
        assert right_spot(damaged, true_uv).all()


def test_a_visible_spot_that_is_not_found_lowers_the_identity_but_is_no_wrong_label(quiet, tmp_path):
    def change(row: dict[str, str]) -> dict[str, str]:
        if row["frame"] == "7" and row["spot"] == "6":
            row["status"] = "occluded"
        return row

    s = score(rewritten(quiet, tmp_path / "results", change), quiet.run_folder)["spots"]
    assert s["visible_but_not_found_rows"] == 1
    assert s["wrong_labels"] == 0
    assert s["in_view_identity"] == pytest.approx(1 - 1 / s["in_view_rows"], abs=1e-12)


def test_a_missing_row_counts_as_a_spot_that_is_not_found(quiet, tmp_path):
    results = rewritten(quiet, tmp_path / "results", lambda r: None if (r["frame"], r["spot"]) == ("7", "6") else r)
    assert (read_spots(results).status == ABSENT).sum() == 1
    assert score(results, quiet.run_folder)["spots"]["visible_but_not_found_rows"] == 1


def test_a_frame_without_a_picture_is_not_counted(quiet, tmp_path):
    def change(row: dict[str, str]) -> dict[str, str]:
        if row["frame"] in ("7", "8") and row["camera"] == "right":
            row["status"] = "no_image"
        return row

    before = score(quiet.results, quiet.run_folder)["spots"]
    after = score(rewritten(quiet, tmp_path / "results", change), quiet.run_folder)["spots"]
    assert after["in_view_identity"] == 1.0
    assert after["in_view_rows"] == before["in_view_rows"] - 6


def test_the_papers_recognition_rate_counts_spots_out_of_view_as_wrong(quiet):
    s = score(quiet.results, quiet.run_folder)["spots"]
    inside = quiet.model.in_picture(quiet.true_uv)
    assert 0.5 < inside.mean() < 1
    assert s["recognition_rate_eq15"]["paper"] == pytest.approx(inside.mean())
    assert s["recognition_rate_eq15"]["in_view"] == 1.0
    assert s["recognition_rate_eq15"]["all_within_tolerance"] == 1.0  # out of view the error is 0.4 px, 1 sigma


def test_turned_frames_are_excluded_from_the_straight_prediction_error_only(eventful):
    s = score(eventful.results, eventful.run_folder)["spots"]["prediction_px"]
    assert s["straight"]["max"] < 2
    assert s["turned"]["rms"] == pytest.approx(8 * np.sqrt(2), rel=0.05)  # the error in fake_results
    assert s["all_measured"]["max"] == s["turned"]["max"]


def test_sharp_turns_of_the_true_path_are_separate_whatever_their_status(eventful, tmp_path):
    def change(row: dict[str, str]) -> dict[str, str]:
        row["status"] = "matched" if row["status"] == "turned" else row["status"]
        return row

    s = score(rewritten(eventful, tmp_path / "results", change), eventful.run_folder)["spots"]["prediction_px"]
    assert s["turned"] is None
    assert s["straight"]["max"] > 8
    assert s["smooth"]["max"] < 2
    assert s["bends"]["rms"] == pytest.approx(8 * np.sqrt(2), rel=0.05)


def test_the_first_two_frames_of_a_track_are_reported_separately(quiet, tmp_path):
    def change(row: dict[str, str]) -> dict[str, str]:
        if row["frame"] in ("0", "1"):  # the velocity is unknown, so the prediction has a large error
            row["predicted_u_px"] = str(float(row["predicted_u_px"]) + 50.0)
        return row

    s = score(rewritten(quiet, tmp_path / "results", change), quiet.run_folder)["spots"]["prediction_px"]
    assert s["start"]["rows"] == 12
    assert s["start"]["rms_u"] == pytest.approx(50, abs=1)
    assert s["smooth"]["max"] < 2
    assert s["straight"]["max"] < 2
    assert s["all_measured"]["max"] > 49


def test_the_out_of_view_error_includes_only_spots_that_are_truly_outside(eventful):
    s = score(eventful.results, eventful.run_folder)["spots"]
    block = s["out_of_view_px"]
    assert block["rows"] > 50
    assert block["rms_u"] == pytest.approx(0.4, rel=4 / np.sqrt(2 * block["rows"]))
    assert s["out_of_view_but_visible_rows"] == 0


class TestReturns:
    """One view, one number per frame: truth 0 outside, 1 in view."""

    in_view = np.array([[1, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1, 1]]).T
    yes = np.ones((12, 1), dtype=bool)

    def test_a_spot_found_immediately_is_kept_without_delay(self):
        out = _returns(self.in_view, 0, self.yes, self.yes, self.yes)
        assert (out["total"], out["kept"], out["max_delay_frames"]) == (1, 1, 0)

    def test_a_spot_found_two_pictures_late_is_kept_with_that_delay(self):
        measured = self.yes.copy()
        measured[3:5] = False
        assert _returns(self.in_view, 0, measured, self.yes, self.yes)["max_delay_frames"] == 2

    def test_a_dropped_picture_is_no_delay(self):
        pictured, measured = self.yes.copy(), self.yes.copy()
        pictured[3] = measured[3] = False
        assert _returns(self.in_view, 0, measured, self.yes, pictured)["max_delay_frames"] == 0

    def test_a_wrong_spot_first_is_not_kept(self):
        right = self.yes.copy()
        right[3] = False
        out = _returns(self.in_view, 0, self.yes, right, self.yes)
        assert (out["total"], out["kept"]) == (1, 0)

    def test_a_spot_found_too_late_is_not_kept(self):
        measured = self.yes.copy()
        measured[3:9] = False
        assert _returns(self.in_view, 0, measured, self.yes, self.yes)["kept"] == 0


def test_a_run_without_truth_has_no_score(tmp_path):
    fake = make(tmp_path, 5, truth=False)
    assert score(fake.results, fake.run_folder) is None


def test_a_run_without_any_pose_has_a_score_without_errors(tmp_path):
    fake = make(tmp_path, 20, all_lost=True)
    out = score(fake.results, fake.run_folder)
    assert out["spots"]["in_view_identity"] == 0
    assert out["pose"]["measured"] is None
    json.dumps(out, allow_nan=False)


def test_a_score_is_plain_json_without_nan(eventful):
    json.dumps(score(eventful.results, eventful.run_folder), allow_nan=False)


def test_tables_are_read_according_to_the_contract(eventful):
    spots, poses = read_spots(eventful.results), read_poses(eventful.results)
    assert spots.views == eventful.model.views
    lost = spots.has(SpotStatus.LOST)
    assert lost.any()
    assert np.isnan(spots.uv_px[lost]).all()
    assert np.isnan(poses.world_from_body.translation[poses.has(PoseStatus.LOST)]).all()
    known = poses.known
    np.testing.assert_allclose(poses.covariance[known], np.swapaxes(poses.covariance[known], 1, 2))
    sigma = np.sqrt(np.diagonal(poses.covariance[known], axis1=1, axis2=2)[:, :3])
    np.testing.assert_allclose(sigma, poses.sigma_position_m[known], atol=1e-8)
    from_angles = Pose.from_ypr(np.radians(poses.yaw_pitch_roll_deg[known]), np.zeros((int(known.sum()), 3))).rotation
    np.testing.assert_allclose(from_angles, poses.world_from_body.rotation[known], atol=1e-8)
    assert SPOT_STATUSES[spots.status[0, 0]] in SpotStatus


def test_a_missing_column_is_an_error_that_names_file_and_column(quiet, tmp_path):
    fake = make(tmp_path, 3)
    path = fake.results / "spots.csv"
    path.write_text(path.read_text().replace("predicted_u_px", "predicted_x"))
    with pytest.raises(InputError, match=r"spots\.csv: expected a column 'predicted_u_px', got frame,t_s"):
        read_spots(fake.results)


def test_a_text_in_place_of_a_number_is_an_error_that_names_the_file(tmp_path):
    fake = make(tmp_path, 3)
    path = fake.results / "attitude.csv"
    path.write_text(path.read_text().replace("0.01", "oh", 1))
    with pytest.raises(InputError, match=r"attitude\.csv: line \d+: expected \d+ fields as in the header, and numbers"):
        read_poses(fake.results)


# -- velocity, rate, and the causal pass ------------------------------------------------------------------------------


def test_errors_of_velocities_and_rates_are_the_added_noise_and_exclude_sharp_turns(quiet):
    s = score(quiet.results, quiet.run_folder)["motion_vs_differences"]
    for name, sigma in (("velocity_m_s", MOTION_SIGMA[:3]), ("rate_rad_s", MOTION_SIGMA[3:])):
        rms = np.array(list(s[name]["rms_axes"].values()))
        np.testing.assert_allclose(rms, sigma, rtol=0.12)  # 600 rows: 3 % per sigma
        assert s[name]["square_over_claimed_mean"] == pytest.approx(1.0, abs=0.12)
    # The triangular yaw motion has four corners in 6 s; the frame of each and two on either side are excluded.
    assert s["rows_at_bends_left_out"] == 4 * 5
    assert s["rows"] == 600 - 4 - 4 * 5


def test_a_five_point_difference_has_an_error_of_a_millionth_for_a_smooth_motion():
    t = np.arange(200) / 100
    a, b = 0.3 * np.sin(6 * t), 0.4 * np.cos(5 * t)
    poses = Pose.from_ypr(np.stack([a, 0 * t, 0 * t], -1), np.stack([b, a, 0 * t], -1))
    motion, bent = differenced(poses, t)
    assert not bent.any()
    assert np.isnan(motion[[0, 1, -2, -1]]).all()
    true_a, true_b = 1.8 * np.cos(6 * t), -2.0 * np.sin(5 * t)
    true = np.stack([true_b, true_a, 0 * t, 0 * t, 0 * t, true_a], -1)
    np.testing.assert_allclose(motion[2:-2], true[2:-2], atol=1e-5)


def test_a_rate_is_about_the_bodys_own_axes():
    """A vehicle with a pitch of 90 degrees that rotates about the world's z rotates about its own -x."""
    t = np.arange(20) / 100
    turn = Rotation.from_rotvec(0.7 * t[:, None] * [0, 0, 1])
    pitched = turn * Rotation.from_rotvec([0, np.pi / 2, 0])
    motion, _ = differenced(Pose(pitched.as_matrix(), np.zeros((20, 3))), t)
    np.testing.assert_allclose(motion[5], [0, 0, 0, -0.7, 0, 0], atol=1e-9)


def test_no_difference_spans_a_gap_or_a_change_of_the_frame_rate():
    t = np.concatenate([np.arange(20), np.arange(20, 40) * 2.0 - 20]) / 100
    poses = Pose.from_ypr(np.zeros((40, 3)), np.stack([0.5 * t, 0 * t, 0 * t], -1))
    gone = poses.translation.copy()
    gone[10] = np.nan
    motion, bent = differenced(Pose(poses.rotation, gone), t)
    known = np.isfinite(motion[:, 0])
    assert np.flatnonzero(~known).tolist() == [0, 1, 8, 9, 10, 11, 12, 19, 20, 21, 38, 39]
    np.testing.assert_allclose(motion[known, 0], 0.5, atol=1e-9)
    assert not bent.any()


def test_causal_poses_are_scored_separately_from_smoothed_ones(tmp_path):
    fake = make(tmp_path, 300, causal=True)
    s = score(fake.results, fake.run_folder)
    later, then = (s[name]["measured"] for name in ("pose", "pose_causal"))
    assert then["position_m"]["rms"] == pytest.approx(2 * later["position_m"]["rms"], rel=1e-3)
    assert then["nees_mean"] == pytest.approx(later["nees_mean"], rel=1e-2)
    assert s["motion_causal_vs_differences"]["rows"] == s["motion_vs_differences"]["rows"]


def test_every_column_is_required(quiet, tmp_path):
    results = tmp_path / "results"
    results.mkdir()
    text = (quiet.results / "attitude.csv").read_text()
    (results / "attitude.csv").write_text(text.replace("qw", "qq", 1))
    with pytest.raises(InputError, match="expected a column 'qw'"):
        read_poses(results)
