"""The findings of the model check, its part of summary.json, and the frames that it samples from a run."""

from __future__ import annotations

import dataclasses
import json
import re

import numpy as np
import pytest

from calibration.model_check.fault_identification import NOISY, Effect, FaultDiagnosis
from geometry.pose_prior import PosePrior
from lab.findings.finding import Level, first_sentence
from lab.number_format import format_number, format_with_sigma
from lab.runs.model_check import check
from lab.runs.model_check.check import check_model, check_sampled_frames
from lab.runs.model_check.frame_sampler import FrameSampler, SampledFrame, stated_covariances
from lab.runs.verdict import quality
from lab.simulate.points import simulate_points
from tests.calibration.model_check.model_scenes import NOISE_PX, changed, recorded, turned
from tests.calibration.model_check.test_check import suspects, with_slow_errors
from tracking.curve_switching.spot_tracker import SpotTracker
from tracking.detections import Detections
from tracking.parameters import TrackerParameters
from tracking.statuses import PoseStatus, SpotStatus, TrackedFrame


def test_a_correct_set_up_has_no_findings():
    run, recording = recorded("smooth", 5, frames=200)
    check = check_model(run.rig, recording)
    assert check.findings == ()
    assert check.level == Level.PASS


def test_a_late_camera_is_reported_with_its_delay():
    run, recording = recorded("smooth", 5, frames=400, late=("left", 3e-3))
    check = check_model(run.rig, recording)
    assert re.search(r"camera `left` is about (2\.9|3\.0)\d ± 0\.0\d ms late against", check.findings[0].what)
    assert "late against camera `right`" in check.findings[0].what
    assert check.level == Level.FAIL
    assert "trigger" in check.findings[0].remedy


def test_a_delay_of_one_frame_suggests_wrong_frame_numbers():
    run, recording = recorded("smooth", 5, frames=400, late=("right", 10e-3))
    (finding,) = check_model(run.rig, recording).findings
    assert "that is 1 frame: its pictures may be numbered wrongly" in finding.what


def test_of_three_or_more_cameras_the_one_out_of_step_is_reported_early_or_late():
    run, recording = recorded("two-cameras-per-screen", 5, frames=300, late=("left-b", -2e-3))
    (finding,) = check_model(run.rig, recording).findings
    assert "camera `left-b` is about 1.996 ± 0.006 ms" in finding.what
    assert "early against the others" in finding.what


def test_a_finding_states_spot_size_effect_and_remedy():
    run, recording = recorded("two-cameras-per-screen", 5, frames=300, really=turned("right-a", 0.05, 1))
    (finding,) = check_model(run.rig, recording).findings
    assert first_sentence(finding.what).startswith("camera `right-a` may have turned, by 0.87")
    assert len(first_sentence(finding.what)) < 80
    assert ". Spot " in finding.what
    assert "in camera `right-a` lies " in finding.what
    assert " px) off in u against the other spots, p below 1e-12" in finding.what
    assert "deg and " in finding.why
    assert "of its stated sigmas; averaging over frames does not reduce it" in finding.why
    assert "mount" in finding.remedy


def test_a_finding_states_that_a_recording_does_not_distinguish_faults():
    run, recording = recorded("smooth", 5, frames=300, really=changed("beams.B.direction_z", np.deg2rad(0.05)))
    assert "this recording does not distinguish them" in check_model(run.rig, recording).findings[0].what


def test_indistinguishable_faults_fail_only_if_each_would_and_pass_only_if_each_would():
    small, middle, large = (Effect(0, 0, 0.0, 0.0, 0.1, 0.1, sigmas) for sigmas in (0.1, 2.0, 9.0))
    diagnosis = FaultDiagnosis((), 0.0, 1.0, 1.0, 1.0, 1.0, False, np.ones(6))
    assert check.level_of(diagnosis, [small, small]) == Level.PASS
    assert check.level_of(diagnosis, [small, middle]) == Level.WARN
    assert check.level_of(diagnosis, [middle, large]) == Level.WARN
    assert check.level_of(diagnosis, [large, large]) == Level.FAIL
    assert check.level_of(dataclasses.replace(diagnosis, residual_scale=5.1), [small]) == Level.FAIL


def test_noise_alone_does_not_make_a_small_fault_a_failure():
    small = [Effect(0, 0, 0.0, 0.2, 0.1, 0.1, 0.1)]
    for noise, level in ((1.0, Level.FAIL), (8.0, Level.PASS)):
        diagnosis = FaultDiagnosis((), 0.0, 1.0, 8.0, noise, 1.0, False, np.ones(6))
        assert check.level_of(diagnosis, small) == level


def test_a_significant_but_small_fault_is_no_alarm():
    run, recording = recorded("two-cameras-per-screen", 5, frames=400, really=turned("right-a", 0.002, 1))
    check = check_model(run.rig, recording)
    assert [f.level for f in check.findings] == [Level.PASS]
    assert check.findings[0].why.startswith("it is significant but small")
    assert check.findings[0].remedy == ""


def test_a_run_that_states_smaller_pose_sigmas_fails_for_a_fault_that_is_a_warning_otherwise():
    run, recording = recorded("smooth", 5, frames=300, really=changed("screens.right.x_m", 2e-3))
    plain = check_model(run.rig, recording)
    stated = np.broadcast_to(np.diag([3e-5**2] * 3 + [3e-6**2] * 3), (300, 6, 6))
    overconfident = check_model(run.rig, dataclasses.replace(recording, pose_covariance=stated.copy()))
    assert plain.level == Level.WARN
    assert overconfident.level == Level.FAIL


def test_a_spot_that_is_hardly_ever_measured_where_it_should_be_is_reported():
    run, recording = recorded("four-skew-beams", 5, frames=300)
    seen = recording.seen.copy()
    seen[40:, 6] = False
    (finding,) = check_model(run.rig, dataclasses.replace(recording, seen=seen)).findings
    assert finding.level == Level.WARN
    assert finding.what.startswith("spot 7 in camera `right` was measured in 40 of 300 frames")
    assert "far from where the rig file puts it" in finding.why
    seen[40:200, 6] = recording.seen[40:200, 6]  # occluded for the last 100 frames
    assert check_model(run.rig, dataclasses.replace(recording, seen=seen)).findings == ()


def test_poses_of_three_spots_while_four_others_are_never_found_fail():
    run, recording = recorded("four-skew-beams", 5, frames=300)
    seen = recording.seen.copy()
    seen[:, 3:] = False
    findings = check_model(run.rig, dataclasses.replace(recording, seen=seen)).findings
    assert findings[0].level == Level.FAIL
    assert "4 others that the pose puts well inside the pictures are never found" in findings[0].what
    seen[:, 3] = recording.seen[:, 3]  # a fourth spot confirms the poses
    findings = check_model(run.rig, dataclasses.replace(recording, seen=seen)).findings
    assert len(findings) == 3
    assert {f.level for f in findings} == {Level.WARN}


def test_sigmas_that_are_stated_too_small_are_a_warning_with_the_factor():
    run, recording = recorded("smooth", 5, frames=300, claimed_px=NOISE_PX / 3)
    (finding,) = check_model(run.rig, recording).findings
    assert finding.level == Level.WARN
    assert f"{format_number(3.0, 2)} times as large as the sigmas of the detections; they are random" in finding.what


def test_the_camera_with_the_wrong_sigmas_is_reported():
    run, recording = recorded("smooth", 5, frames=300)
    stated = recording.cov_px2.copy()
    stated[:, run.model.camera_of == 1] /= 4.0**2
    (finding,) = check_model(run.rig, dataclasses.replace(recording, cov_px2=stated)).findings
    assert finding.level == Level.WARN
    factors = dict(re.findall(r"camera `(\w+)` ([\d.]+)", finding.what))
    assert float(factors["left"]) == pytest.approx(1.0, abs=0.15)
    assert float(factors["right"]) == pytest.approx(4.0, rel=0.1)


def test_large_correlated_errors_are_not_noise_and_fail():
    run, recording = recorded("smooth", 5, frames=600)
    (finding,) = check_model(run.rig, with_slow_errors(recording, 8 * NOISE_PX)).findings
    assert finding.level == Level.FAIL
    assert "do not average out" in finding.why


def test_the_limits_of_the_findings_are_those_of_the_verdict():
    assert check.MATTERS_SIGMAS < check.WRONG_SIGMAS == quality.LARGEST_NOISE_SCALE
    assert NOISY == quality.GOOD_NOISE_SCALE


def test_too_few_frames_are_not_tested_and_the_reason_is_given():
    run, recording = recorded("smooth", 5, frames=20)
    check = check_model(run.rig, recording)
    assert check.why_not == "20 frames have 3 and more spots measured; the test needs 30"
    assert check.as_mapping()["tested"] is False


def test_the_result_is_plain_json_and_complete():
    run, recording = recorded("smooth", 5, frames=200, late=("right", 3e-3), predicted=True)
    check = check_model(run.rig, recording)
    mapping = json.loads(json.dumps(check.as_mapping()))
    assert mapping["findings"][0]["level"] == "FAIL"
    assert mapping["suspected_faults"][0]["component"] == "clock"
    assert mapping["suspected_faults"][0]["delta"][0] == pytest.approx(3e-3, rel=0.1)
    assert [v["name"] for v in mapping["views"]] == [f"{c}/{s}" for c, s in run.model.views]
    assert [v["name"] for v in mapping["beams"]] == list(run.rig.beams)


def test_each_alternative_is_reported_with_its_own_size_and_effect():
    run, recording = recorded("smooth", 5, frames=300, really=changed("screens.right.x_m", 2e-3))
    check = check_model(run.rig, recording)
    (best,) = check.as_mapping()["suspected_faults"]
    (other,) = best["alternatives"]
    assert (best["component"], best["name"]) == ("screen", "right")
    assert (other["component"], other["name"], other["kind"]) == ("camera", "left", "focal length changed")
    assert other["attitude_deg"] < 0.5 * best["attitude_deg"]
    assert re.search(r"by about 0\.00\d+ to 0\.00\d+ deg and", check.findings[0].why)


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [(0.3501, 0.0123, "0.350 ± 0.012"), (2.93, 0.05, "2.93 ± 0.05"), (12.0, 3.0, "12 ± 3"), (0.5, 0.0, "0.50")],
)
def test_a_size_has_the_digits_that_its_sigma_allows(value, sigma, text):
    assert format_with_sigma(value, sigma) == text


# Sampling -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_a_trackers_frames_are_tested_with_the_covariances_that_the_detections_state(factor):
    """A camera turned by 0.3 deg, 0.86 px: 8.6 stated sigmas, whatever noise scale the tracker has estimated."""
    run, recording = recorded("smooth", 5, frames=200, really=turned("right", 0.3, 1))
    sampler, n = FrameSampler(), len(run.model)
    nothing = np.full((n, 2), np.nan)
    for k in range(200):
        point, rows, found = np.full(n, -1), recording.seen[k], []
        for c in range(len(run.model.camera_names)):
            own = np.flatnonzero(rows & (run.model.camera_of == c))
            point[own] = np.arange(len(own))
            found.append(Detections.at(recording.uv_px[k, own], recording.cov_px2[k, own]))
        status = tuple(SpotStatus.MATCHED if s else SpotStatus.OCCLUDED for s in rows)
        tracked = TrackedFrame(
            recording.uv_px[k], recording.cov_px2[k] * factor**2, status, nothing, np.full(n, np.nan), point,
            PoseStatus.MEASURED, recording.poses[k], None, int(rows.sum()), 0.1, (),
        )  # fmt: skip
        stated = stated_covariances(tracked, found, run.model.camera_of, TrackerParameters())
        sampler.add_tracked(0.01 * k, tracked, None, stated)
    check = check_sampled_frames(run.rig, sampler)
    assert check.result.effects[0][0].off_sigmas == pytest.approx(8.6, rel=0.1)
    assert check.level == Level.FAIL
    assert check.result.diagnosis is not None
    assert check.result.diagnosis.noise_scale == pytest.approx(1.0, abs=0.1)


def test_a_detection_that_is_shifted_by_its_neighbour_has_a_larger_covariance():
    _, recording = recorded("smooth", 5, frames=40)
    n, p = 6, TrackerParameters()
    found = [Detections.at(recording.uv_px[0, :3], recording.cov_px2[0, :3]), None]
    used_in_pose = np.array([True, False, True, True, True, True])
    tracked = TrackedFrame(
        recording.uv_px[0], recording.cov_px2[0] * 9, (SpotStatus.MATCHED,) * n, np.full((n, 2), np.nan),
        np.full(n, np.nan), np.array([0, 1, -1, 0, 1, 2]), PoseStatus.MEASURED, recording.poses[0], None, 3, 0.1, (),
        used_in_pose=used_in_pose,
    )  # fmt: skip
    stated = stated_covariances(tracked, found, np.array([0, 0, 0, 1, 1, 1]), p)
    model = p.sigma_model_px**2
    np.testing.assert_allclose(stated[0], recording.cov_px2[0, 0] + model * np.eye(2))
    np.testing.assert_allclose(stated[1], recording.cov_px2[0, 1] + (model + (p.blend_px / 2) ** 2) * np.eye(2))
    np.testing.assert_allclose(stated[2:], tracked.cov_px2[2:])  # not detected, or no picture: the tracker's


def test_sampled_frames_give_the_same_result_as_all_frames_and_stay_few():
    run, recording = recorded("smooth", 5, frames=600, late=("right", 3e-3))
    sampler, kept = FrameSampler(most=200), None
    for k in range(600):
        t_s, pose = float(recording.t_s[k]), recording.poses[k]
        sampler.add(SampledFrame(t_s, recording.seen[k], recording.uv_px[k], recording.cov_px2[k], pose))
        kept = sampler.recording() if k % 50 == 49 else kept
        assert k < 200 or (kept is not None and 95 <= len(kept.t_s) <= 200)
    assert kept is not None
    check = check_model(run.rig, kept)
    assert suspects(check.result)[0][0] == "clock"
    assert check.result.diagnosis is not None
    (suspected,) = check.result.diagnosis.suspected_faults
    assert suspected.best.change.delta[0] == pytest.approx(3e-3, rel=0.1)


def test_a_run_without_frames_is_not_tested_and_the_reason_is_given():
    run, _ = recorded("smooth", 5, frames=40)
    assert FrameSampler().recording() is None
    assert check_sampled_frames(run.rig, FrameSampler()).why_not == "there is no frame"


def test_of_a_trackers_frame_only_measured_spots_count():
    _, recording = recorded("smooth", 5, frames=40)
    status = [SpotStatus.MATCHED, SpotStatus.TURNED, SpotStatus.OCCLUDED, SpotStatus.OUT_OF_VIEW, SpotStatus.LOST]
    sampler, no_prediction = FrameSampler(), np.full((6, 2), np.nan)
    for k, pose in enumerate((recording.poses[0], None)):
        nothing = np.full(6, np.nan), np.full(6, -1)
        statuses = (*status, SpotStatus.NO_IMAGE)
        uv, cov = recording.uv_px[k], recording.cov_px2[k]
        tracked = TrackedFrame(uv, cov, statuses, no_prediction, *nothing, PoseStatus.MEASURED, pose, None, 2, 0.1, ())
        sampler.add_tracked(0.01 * k, tracked)
    kept = sampler.recording()
    assert kept is not None
    assert kept.seen.tolist() == [[True, True, False, False, False, False]] * 2
    assert kept.usable.sum(axis=1).tolist() == [2, 0]
    assert kept.pose_covariance is None


@pytest.mark.slow
def test_a_wrong_rig_is_found_from_the_frames_of_a_tracker():
    """By a real tracker on simulated detections; the second rig has the right screen 10 mm nearer than it is."""
    run = simulate_points("four-skew-beams", 5, frames=45)
    levels = []
    for rig in (run.rig, changed("screens.right.x_m", -0.01)(run.rig)):
        tracker = SpotTracker(rig, TrackerParameters(), PosePrior(run.poses[0], 0.3, 0.1))
        sampler = FrameSampler()
        for t_s, found in zip(run.t_s, run.detections, strict=True):
            sampler.add_tracked(float(t_s), tracker.step(0.01, found))
        levels.append(check_sampled_frames(rig, sampler).level)
    assert levels == [Level.PASS, Level.FAIL]
