"""The model check identifies what is wrong with a set-up, and reports nothing for a correct one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calibration.model_check.check import ModelCheckResult, NotTested, evaluate_model
from calibration.model_check.fault_identification import P_FALSE_ALARM, is_noisy
from calibration.model_check.linearised_frames import ModelCheckRecording
from geometry.forward_model import SpotModel
from geometry.pose_solver.gauss_newton import fit_pose
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance
from tests.calibration.model_check.model_scenes import NOISE_PX, SCENES, changed, one_camera, recorded, turned


def suspects(result: ModelCheckResult) -> list[tuple[str, str]]:
    """Component and name of every suspected fault, alternatives included."""
    assert result.diagnosis is not None
    return [(e.fault.component, e.fault.name) for s in result.diagnosis.suspected_faults for e in s.explanations]


def raises_alarm(result: ModelCheckResult) -> bool:
    """Whether anything would be reported."""
    assert result.diagnosis is not None
    noisy = is_noisy(max(result.noise_of_cameras.values()), result.stated_residual_scale)
    return bool(result.diagnosis.suspected_faults) or result.diagnosis.unexplained or noisy or bool(result.unseen)


def with_slow_errors(recording: ModelCheckRecording, sigma_px: float) -> ModelCheckRecording:
    """With errors that change over 50 frames, such as those of moving air or a bent screen; 600 frames."""
    rng = np.random.default_rng(8)
    noise = rng.standard_normal((700, *recording.uv_px.shape[1:]))
    slow = np.apply_along_axis(lambda x: np.convolve(x, np.ones(50) / np.sqrt(50), "valid")[:600], 0, noise)
    return dataclasses.replace(recording, uv_px=recording.uv_px + sigma_px * slow)


@pytest.mark.parametrize("scene", SCENES)
def test_a_correct_set_up_raises_no_alarm(scene):
    run, recording = recorded(scene, 5, frames=200)
    result = evaluate_model(run.rig, recording)
    assert not raises_alarm(result)
    assert result.diagnosis is not None
    assert result.diagnosis.residual_scale == pytest.approx(1.0, abs=0.1)
    assert result.diagnosis.p_before > 1e-4


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("moves", [False, True])
def test_a_camera_that_moves_during_a_recording_is_found_with_its_frame(scene, moves):
    """A constant fault of the same size is no movement."""
    run, before = recorded(scene, 5, frames=200)
    _, after = recorded(scene, 5, frames=200, really=turned(one_camera(scene), 0.3, 1))
    late = np.arange(200) >= (120 if moves else 0)
    both = dataclasses.replace(before, uv_px=np.where(late[:, None, None], after.uv_px, before.uv_px))
    found = evaluate_model(run.rig, both).moved_at_s
    if moves:
        assert found == pytest.approx(before.t_s[120], abs=2.5 * (before.t_s[1] - before.t_s[0]))
    else:
        assert found is None


@pytest.mark.parametrize("scene", SCENES)
def test_errors_of_places_within_the_sigmas_are_no_movement_of_a_camera(scene):
    """Two rests in speckle: errors of each, within the stated sigmas, differ between both."""
    run, recording = recorded(scene, 5, frames=120, claimed_px=16 * NOISE_PX)
    of_rest = 2 * NOISE_PX * np.random.default_rng(4).standard_normal((2, *recording.uv_px.shape[1:]))
    errors = recording.uv_px - run.uv_px[:120] + of_rest[(np.arange(120) >= 70).astype(int)]
    result = evaluate_model(run.rig, dataclasses.replace(recording, uv_px=run.uv_px[:120] + errors))
    assert result.moved_at_s is None


@pytest.mark.slow
def test_two_hundred_correct_recordings_raise_no_alarm_and_their_p_values_are_uniform():
    """Alarms are too rare to count (1e-6 each); uniform p-values show that the stated rate is correct."""
    p = []
    for scene in SCENES:
        for seed in range(40):
            run, recording = recorded(scene, 1000 + seed, frames=250)
            result = evaluate_model(run.rig, recording)
            assert not raises_alarm(result), (scene, seed)
            assert result.moved_at_s is None, (scene, seed)
            assert result.diagnosis is not None
            p.append(result.diagnosis.p_before)
    below = [np.mean(np.array(p) < limit) for limit in (0.05, 0.5)]
    assert below[0] < 0.05 + 3 * np.sqrt(0.05 * 0.95 / len(p))
    assert below[1] == pytest.approx(0.5, abs=0.12)


def faults_of(scene: str) -> dict[str, tuple[tuple[str, str], dict[str, object]]]:
    """By name: the true fault, and the recording's arguments."""
    camera = one_camera(scene)
    return {
        "camera turned": (("camera", camera), {"really": turned(camera, 0.02, 2)}),
        "beam": (("beam", "B"), {"really": changed("beams.B.direction_z", np.deg2rad(0.05))}),
        "late": (("clock", camera), {"late": (camera, 3e-3)}),
        "screen": (("screen", "right"), {"really": changed("screens.right.x_m", 2e-3)}),
    }


@pytest.mark.parametrize("fault", ["camera turned", "beam", "late", "screen"])
@pytest.mark.parametrize("scene", ["smooth", "two-cameras-per-screen"])
def test_a_small_fault_is_found_and_is_among_the_suspected_ones(scene, fault):
    truth, arguments = faults_of(scene)[fault]
    run, recording = recorded(scene, 5, frames=400, **arguments)
    result = evaluate_model(run.rig, recording)
    assert truth in suspects(result)
    assert result.diagnosis is not None
    assert len(result.diagnosis.suspected_faults) == 1
    assert not result.diagnosis.unexplained


@pytest.mark.slow
def test_small_faults_are_found_in_nearly_all_recordings():
    for scene in SCENES:
        for fault, (truth, arguments) in faults_of(scene).items():
            found = 0
            for seed in range(10):
                run, recording = recorded(scene, 100 + seed, **arguments)
                found += truth in suspects(evaluate_model(run.rig, recording))
            assert found >= 9, (scene, fault, found)


def test_faults_that_a_recording_does_not_distinguish_are_reported_together():
    """One raised beam of a fan looks like another one turned twice as far: the pose absorbs the difference."""
    run, recording = recorded("smooth", 5, frames=300, really=changed("beams.B.direction_z", np.deg2rad(0.05)))
    assert set(suspects(evaluate_model(run.rig, recording))) == {("beam", "A"), ("beam", "B"), ("beam", "C")}
    run, recording = recorded("four-skew-beams", 5, frames=300, really=changed("beams.B.direction_z", 1e-3))
    assert suspects(evaluate_model(run.rig, recording)) == [("beam", "B")]


def test_two_faults_are_both_reported():
    def both(rig):
        return changed("beams.D.direction_z", 1e-3)(turned("left", 0.1, 2)(rig))

    run, recording = recorded("four-skew-beams", 5, frames=400, really=both)
    result = evaluate_model(run.rig, recording)
    assert {("beam", "D"), ("camera", "left")} <= set(suspects(result))
    assert result.diagnosis is not None
    assert len(result.diagnosis.suspected_faults) == 2


def test_a_deviation_within_the_calibrations_covariance_is_no_fault():
    name = "screens.right.x_m"
    run, recording = recorded("smooth", 5, frames=300, really=changed(name, 2e-3))
    assert raises_alarm(evaluate_model(run.rig, recording, RigCovariance((name,), np.array([[1e-8]]))))
    result = evaluate_model(run.rig, recording, RigCovariance((name,), np.array([[4e-6]])))
    assert not raises_alarm(result)
    assert result.statistics is not None
    allowed = {g.name: g.calibration_px.max() for g in result.statistics.views}
    assert allowed["right/6"] > 0.05


def test_the_calibrations_sigma_of_a_mean_residual_is_the_shift_that_a_calibration_error_causes():
    """The same recording with the screen displaced by its sigma of 2 mm: each mean shifts by the stated sigma."""
    name = "screens.right.x_m"
    stated = RigCovariance((name,), np.array([[4e-6]]))
    run, right = recorded("smooth", 5, frames=300)
    _, wrong = recorded("smooth", 5, frames=300, really=changed(name, 2e-3))
    views = [evaluate_model(run.rig, r, stated).statistics.views for r in (right, wrong)]
    for a, b in zip(*views, strict=True):
        np.testing.assert_allclose(np.abs(b.mean_px - a.mean_px), a.calibration_px, rtol=0.05, atol=2e-3)


def test_a_beam_and_a_camera_without_spots_do_not_change_the_result():
    run, recording = recorded("smooth", 5, frames=100)
    rig = run.rig
    screens = {**rig.screens, "spare": rig.screens["right"]}
    cameras = {**rig.cameras, "spare": dataclasses.replace(rig.cameras["right"], name="spare", screen="spare")}
    more = Rig(screens, cameras, {**rig.beams, "spare": rig.beams["A"]}, rig.spots)
    stated = RigCovariance(("screens.right.x_m",), np.array([[4e-6]]))
    usual, result = (evaluate_model(r, recording, stated) for r in (rig, more))
    assert usual.diagnosis is not None
    assert result.diagnosis is not None
    assert result.diagnosis.p_before == pytest.approx(usual.diagnosis.p_before)
    assert result.statistics is not None
    assert {g.name: g.frames for g in result.statistics.beams}["spare"] == 0
    assert {g.name: g.frames for g in result.statistics.cameras}["spare"] == 0


def test_a_displacement_of_a_screen_in_its_own_plane_raises_no_alarm():
    run, recording = recorded("smooth", 5, frames=200, really=changed("screens.right.y_m", 0.01))
    assert not raises_alarm(evaluate_model(run.rig, recording))


def test_wrong_labels_in_a_few_frames_are_outliers_and_no_fault():
    run, recording = recorded("smooth", 5, frames=300)
    uv = recording.uv_px.copy()
    uv[50:60, 1] += [12.0, -7.0]
    uv[200:203, 4] += [0.0, 30.0]
    result = evaluate_model(run.rig, dataclasses.replace(recording, uv_px=uv))
    assert not raises_alarm(result)
    assert result.statistics is not None
    shares = {g.name: g.outliers for g in result.statistics.views}
    assert shares["left/2"] == pytest.approx(10 / 300, abs=1e-9)
    assert shares["right/5"] == pytest.approx(3 / 300, abs=1e-9)
    assert shares["left/1"] == 0


@pytest.mark.parametrize("scene", SCENES)
def test_a_person_who_hides_parts_of_a_spot_is_no_fault_of_the_rig(scene):
    """With four spots no single one of them can be named as the outlier of a frame."""
    run, recording = recorded(scene, 5, frames=80)
    rng = np.random.default_rng(5)
    four = np.flatnonzero(recording.seen.sum(axis=0) > 60)[[0, 1, -2, -1]]
    seen, uv = np.zeros_like(recording.seen), recording.uv_px.copy()
    seen[:, four] = recording.seen[:, four]
    partly = rng.choice(80, 9, replace=False)
    uv[partly, four[-1], 0] += rng.uniform(4, 14, 9) * NOISE_PX
    result = evaluate_model(run.rig, dataclasses.replace(recording, seen=seen, uv_px=uv))
    assert result.diagnosis is not None
    assert suspects(result) == []
    assert not result.diagnosis.unexplained


def test_wrong_labels_are_outliers_in_a_wrong_set_up_too():
    """The camera's rotation shifts its spots by 60 sigma; a wrong label differs from them, not from 0."""
    run, recording = recorded("two-cameras-per-screen", 5, frames=300, really=turned("right-a", 0.3, 1))
    uv = recording.uv_px.copy()
    uv[100:105, 6] += [0.0, 12.0]
    result = evaluate_model(run.rig, dataclasses.replace(recording, uv_px=uv))
    assert suspects(result) == [("camera", "right-a")]
    assert result.statistics is not None
    assert result.statistics.views[6].outliers >= 5 / 300
    assert max(g.outliers for g in result.statistics.views) < 10 / 300


def test_the_linearisation_error_of_a_large_fault_is_no_second_fault():
    """46 sigma in a motion with sharp turns: a delay of 10 ms times the instantaneous velocity leaves a residual."""
    run, recording = recorded("two-cameras-per-screen", 5, late=("right-a", 10e-3))
    result = evaluate_model(run.rig, recording)
    assert suspects(result) == [("clock", "right-a")]
    assert result.diagnosis is not None
    assert not result.diagnosis.unexplained


@pytest.mark.parametrize("factor", [3.0, 20.0])
def test_sigmas_that_are_stated_too_small_give_the_noise_scale_and_no_suspected_fault(factor):
    run, recording = recorded("smooth", 5, frames=300, claimed_px=NOISE_PX / factor)
    result = evaluate_model(run.rig, recording)
    assert suspects(result) == []
    assert result.diagnosis is not None
    assert result.diagnosis.noise_scale == pytest.approx(factor, rel=0.1)


def test_sigmas_that_are_wrong_in_one_camera_do_not_make_a_correct_rig_look_wrong():
    """All tests weight by the stated sigmas: with those of one camera of four too small, p was 2e-9."""
    run, recording = recorded("two-cameras-per-screen", 5, frames=300)
    stated = recording.cov_px2.copy()
    stated[:, run.model.camera_of == 1] /= 4.0**2
    result = evaluate_model(run.rig, dataclasses.replace(recording, cov_px2=stated))
    assert result.diagnosis is not None
    assert result.diagnosis.p_before > 1e-4
    assert suspects(result) == []
    expected = {"left-a": 1.0, "left-b": 4.0, "right-a": 1.0, "right-b": 1.0}
    assert result.noise_of_cameras == pytest.approx(expected, rel=0.1)


def test_the_effect_of_a_fault_is_relative_to_the_noise_of_the_recording():
    """A camera turned by 0.05 deg is the same fault whether or not the detections state sigmas that are too small."""
    sigmas = []
    for factor in (1.0, 3.0):
        run, recording = recorded(
            "smooth", 5, frames=300, really=turned("right", 0.05, 1), claimed_px=NOISE_PX / factor
        )
        result = evaluate_model(run.rig, recording)
        assert ("camera", "right") in suspects(result)
        sigmas.append(result.effects[0][0].off_sigmas)
    assert sigmas[1] == pytest.approx(sigmas[0], rel=0.1)


def test_small_correlated_errors_are_no_fault():
    """0.1 px that change over 50 frames. Independent errors of that size would be significant."""
    run, recording = recorded("smooth", 5, frames=600)
    result = evaluate_model(run.rig, with_slow_errors(recording, NOISE_PX))
    assert result.diagnosis is not None
    assert result.diagnosis.correlation_frames > 5
    assert not raises_alarm(result)


def test_predictions_with_correct_covariances_have_a_nis_of_one():
    run, recording = recorded("smooth", 5, frames=300, predicted=True)
    statistics = evaluate_model(run.rig, recording).statistics
    assert statistics is not None
    groups = [*statistics.views, *statistics.cameras, *statistics.beams]
    assert all(g.nis is not None and 0.8 < g.nis.mean < 1.2 and g.nis.low < 1 < g.nis.high for g in groups)
    overconfident = dataclasses.replace(recording, predicted_cov_px2=recording.predicted_cov_px2 * 0.0)
    statistics = evaluate_model(run.rig, overconfident).statistics
    assert statistics is not None
    assert all(g.nis is not None and g.nis.mean == pytest.approx(2.0, abs=0.3) for g in statistics.views)
    assert all(g.nis is not None and g.nis.mean > g.nis.high for g in statistics.views)


def test_the_reported_pose_bias_is_the_one_that_the_fault_causes():
    run, recording = recorded("four-skew-beams", 5, frames=300, really=changed("beams.B.direction_z", 2e-3))
    ((effect,),) = evaluate_model(run.rig, recording).effects
    other, bias = SpotModel.of(changed("beams.B.direction_z", 2e-3)(run.rig)), []
    for k in range(0, 300, 5):
        rows = np.flatnonzero(recording.usable[k])
        fit = fit_pose(run.model, rows, other.project(run.poses[k])[0][rows], recording.cov_px2[k, rows], run.poses[k])
        assert fit is not None
        bias.append(fit.world_from_body.minus(run.poses[k]))
    turn, move = (np.sqrt(np.mean(np.sum(np.array(bias)[:, s] ** 2, axis=1))) for s in (slice(3, 6), slice(3)))
    assert effect.attitude_deg == pytest.approx(np.rad2deg(turn), rel=0.1)
    assert effect.position_mm == pytest.approx(1e3 * move, rel=0.1)


def test_too_few_frames_are_not_tested():
    run, recording = recorded("smooth", 5, frames=20)
    result = evaluate_model(run.rig, recording)
    assert (result.not_tested, result.frames_used, result.diagnosis) == (NotTested.FEW_FRAMES, 20, None)


def test_frames_without_pose_or_with_invalid_covariances_are_ignored():
    run, recording = recorded("smooth", 5, frames=200)
    recording.poses.translation[10:20] = np.nan
    recording.cov_px2[30:40, 2] = 0.0
    recording.cov_px2[40:50, 2] = np.nan
    recording.uv_px[50:60, 3] = np.nan
    result = evaluate_model(run.rig, recording)
    assert not raises_alarm(result)
    assert result.frames_used == 190


def test_a_recording_of_other_views_raises_an_error():
    _, recording = recorded("smooth", 5, frames=40)
    other, _ = recorded("four-skew-beams", 5, frames=40)
    with pytest.raises(ValueError, match="expected 7 views as the rig has, got 6"):
        evaluate_model(other.rig, recording)
    with pytest.raises(ValueError, match=r"uv_px: expected shape \(40, 6, 2\)"):
        dataclasses.replace(recording, uv_px=recording.uv_px[:, :5])


def test_the_false_alarm_rate_is_at_most_one_in_a_million():
    assert P_FALSE_ALARM <= 1e-6
