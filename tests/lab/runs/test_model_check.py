"""The model check names what is wrong with a set-up, and nothing where all is right."""

from __future__ import annotations

import dataclasses
import json
import re

import numpy as np
import pytest

from calibration.findings import Level
from geometry.forward_model import SpotModel
from geometry.pose_prior import PosePrior
from geometry.pose_solver.gauss_newton import fit_pose
from geometry.uncertainty.rig_parameters import RigCovariance
from lab.number_format import plus_minus, short
from lab.runs.model_check import messages
from lab.runs.model_check.check import ModelCheck, check_kept, check_model
from lab.runs.model_check.effect import Effect
from lab.runs.model_check.fault_identification import P_FALSE_ALARM, FaultDiagnosis
from lab.runs.model_check.faults import FaultColumns, possible_faults
from lab.runs.model_check.frame_sampler import FrameSampler, claimed_covariances
from lab.runs.model_check.linear import linearise
from lab.runs.model_check.recording import evenly
from lab.runs.model_check.statistics import correlation_time, nis_band
from lab.runs.verdict import quality
from lab.simulate.points import simulate_points
from tests.lab.runs.model_scenes import NOISE_PX, SCENES, changed, one_camera, recorded, turned
from tracking.curve_switching.spot_tracker import SpotTracker
from tracking.detections import Detections
from tracking.parameters import TrackerParameters
from tracking.statuses import PoseStatus, SpotStatus
from tracking.tracked_frame import TrackedFrame


def named(check: ModelCheck) -> list[tuple[str, str]]:
    """The things accused first: thing and name, rivals of each included."""
    assert check.inquest is not None
    return [(e.fault.thing, e.fault.name) for c in check.inquest.culprits for e in (c.best, *c.rivals)]


@pytest.mark.parametrize("scene", SCENES)
def test_a_right_set_up_raises_no_alarm(scene):
    run, recording = recorded(scene, 5, frames=200)
    check = check_model(run.rig, recording)
    assert check.findings == ()
    assert check.inquest is not None
    assert check.inquest.misfit == pytest.approx(1.0, abs=0.1)
    assert check.inquest.p_before > 1e-4


@pytest.mark.slow
def test_of_two_hundred_right_recordings_none_raises_an_alarm_and_the_test_is_as_strict_as_it_says():
    """Alarms are rarer than a test can count (1e-6 each). That they are so the p-values tell: they must be uniform."""
    p = []
    for scene in SCENES:
        for seed in range(40):
            run, recording = recorded(scene, 1000 + seed, frames=250)
            check = check_model(run.rig, recording)
            assert check.findings == (), (scene, seed, check.findings)
            assert check.inquest is not None
            p.append(check.inquest.p_before)
    below = [np.mean(np.array(p) < limit) for limit in (0.05, 0.5)]
    assert below[0] < 0.05 + 3 * np.sqrt(0.05 * 0.95 / len(p))
    assert below[1] == pytest.approx(0.5, abs=0.12)


def faults_of(scene: str) -> dict[str, tuple[tuple[str, str], dict[str, object]]]:
    """By name: what is truly wrong, and the recording's arguments."""
    camera = one_camera(scene)
    return {
        "camera turned": (("camera", camera), {"really": turned(camera, 0.02, 2)}),
        "beam": (("beam", "B"), {"really": changed("beams.B.direction_z", np.deg2rad(0.05))}),
        "late": (("clock", camera), {"late": (camera, 3e-3)}),
        "screen": (("screen", "right"), {"really": changed("screens.right.x_m", 2e-3)}),
    }


@pytest.mark.parametrize("fault", ["camera turned", "beam", "late", "screen"])
@pytest.mark.parametrize("scene", ["smooth", "two-cameras-per-screen"])
def test_a_small_fault_is_found_and_the_right_thing_is_among_those_accused(scene, fault):
    truth, arguments = faults_of(scene)[fault]
    run, recording = recorded(scene, 5, frames=400, **arguments)
    check = check_model(run.rig, recording)
    assert truth in named(check)
    assert len(check.findings) == 1
    assert check.level >= Level.WARN


@pytest.mark.slow
def test_small_faults_are_found_in_nearly_all_recordings():
    for scene in SCENES:
        for fault, (truth, arguments) in faults_of(scene).items():
            found = 0
            for seed in range(10):
                run, recording = recorded(scene, 100 + seed, **arguments)
                accused = named(check_model(run.rig, recording))
                found += truth in accused
            assert found >= 9, (scene, fault, found)


def test_a_camera_that_films_late_is_named_with_its_delay():
    run, recording = recorded("smooth", 5, frames=400, late=("left", 3e-3))
    check = check_model(run.rig, recording)
    assert re.search(r"camera `left` is about (2\.9|3\.0)\d ± 0\.0\d ms late against", check.findings[0].what)
    assert "late against camera `right`" in check.findings[0].what
    assert check.level == Level.FAIL
    assert "trigger" in check.findings[0].remedy


def test_a_camera_one_frame_off_is_told_that_its_pictures_may_be_numbered_wrong():
    run, recording = recorded("smooth", 5, frames=400, late=("right", 10e-3))
    (finding,) = check_model(run.rig, recording).findings
    assert "that is 1 frame: its pictures may be numbered wrong" in finding.what


def test_of_three_or_more_cameras_the_one_out_of_step_is_named_early_or_late():
    run, recording = recorded("two-cameras-per-screen", 5, frames=300, late=("left-b", -2e-3))
    (finding,) = check_model(run.rig, recording).findings
    assert "camera `left-b` is about 1.996 ± 0.006 ms" in finding.what
    assert "early against the others" in finding.what


def test_a_finding_names_spot_size_effect_and_cure():
    run, recording = recorded("two-cameras-per-screen", 5, frames=300, really=turned("right-a", 0.05, 1))
    (finding,) = check_model(run.rig, recording).findings
    assert finding.what.startswith("spot ")
    assert "in camera `right-a` lies " in finding.what
    assert " px) off in u against the other spots: camera `right-a` may have turned, by 0.87" in finding.what
    assert "deg and " in finding.why
    assert "of its claimed sigmas; averaging over frames does not lessen it" in finding.why
    assert "mount" in finding.remedy


def test_what_a_recording_cannot_tell_apart_is_named_together():
    """One beam of a fan raised looks like one of the others turned twice as far: the pose makes up the difference."""
    run, recording = recorded("smooth", 5, frames=300, really=changed("beams.B.direction_z", np.deg2rad(0.05)))
    check = check_model(run.rig, recording)
    assert set(named(check)) == {("beam", "A"), ("beam", "B"), ("beam", "C")}
    assert "this recording cannot tell which" in check.findings[0].what
    run, recording = recorded("four-skew-beams", 5, frames=300, really=changed("beams.B.direction_z", 1e-3))
    assert named(check_model(run.rig, recording)) == [("beam", "B")]


def test_what_cannot_be_told_apart_fails_only_if_each_of_it_would_and_is_small_only_if_each_is():
    small, middle, large = (Effect(0, 0, 0.0, 0.0, 0.1, 0.1, sigmas) for sigmas in (0.1, 2.0, 9.0))
    inquest = FaultDiagnosis((), 0.0, 1.0, 30, 1.0, 1.0, 1.0, False, np.ones(6))
    assert messages.level_of(inquest, [small, small]) == Level.PASS
    assert messages.level_of(inquest, [small, middle]) == Level.WARN
    assert messages.level_of(inquest, [middle, large]) == Level.WARN
    assert messages.level_of(inquest, [large, large]) == Level.FAIL
    assert messages.level_of(dataclasses.replace(inquest, misfit=5.1), [small]) == Level.FAIL


def test_two_faults_are_both_named():
    def both(rig):
        return changed("beams.D.direction_z", 1e-3)(turned("left", 0.1, 2)(rig))

    run, recording = recorded("four-skew-beams", 5, frames=400, really=both)
    check = check_model(run.rig, recording)
    accused = named(check)
    assert ("beam", "D") in accused
    assert ("camera", "left") in accused
    assert len(check.findings) == 2


def test_a_misfit_within_what_the_calibration_claims_is_no_fault():
    name = "screens.right.x_m"
    run, recording = recorded("smooth", 5, frames=300, really=changed(name, 2e-3))
    assert check_model(run.rig, recording, RigCovariance((name,), np.array([[1e-8]]))).level > Level.PASS
    check = check_model(run.rig, recording, RigCovariance((name,), np.array([[4e-6]])))
    assert check.findings == ()
    assert check.statistics is not None
    allowed = {g.name: g.calibration_px.max() for g in check.statistics.views}
    assert allowed["right/6"] > 0.05


def test_the_claimed_sigma_of_a_mean_residual_is_what_calibrations_scatter_it_by():
    """The same recording with the screen off by its 2 mm sigma: each mean moves by what is foretold for 1 sigma."""
    name = "screens.right.x_m"
    claim = RigCovariance((name,), np.array([[4e-6]]))
    run, right = recorded("smooth", 5, frames=300)
    _, wrong = recorded("smooth", 5, frames=300, really=changed(name, 2e-3))
    views = [check_model(run.rig, r, claim).statistics.views for r in (right, wrong)]
    for a, b in zip(*views, strict=True):
        np.testing.assert_allclose(np.abs(b.mean_px - a.mean_px), a.calibration_px, rtol=0.05, atol=2e-3)


def test_a_residual_against_the_other_spots_is_that_of_a_fit_without_the_spot():
    run, recording = recorded("smooth", 5, frames=40)
    frames = evenly(np.flatnonzero(recording.usable.sum(axis=1) == 6), 5)
    lin = linearise(run.model, recording, frames)
    residual, covariance = lin.against_others()
    grouped, of_group = lin.against_the_rest(np.array([0, 3]), lin.residual)  # beam A, both its spots
    for left_out in ([2], [0, 3]):
        for i, k in enumerate(frames):
            rows = np.setdiff1d(np.arange(6), left_out)
            fit = fit_pose(
                run.model, rows, recording.uv_px[k, rows], recording.cov_px2[k, rows], recording.poses[int(k)]
            )
            assert fit is not None
            expected = recording.uv_px[k, left_out] - fit.projected_px[left_out]
            spread = fit.jacobian[left_out] @ fit.covariance @ np.swapaxes(fit.jacobian[left_out], -1, -2)
            got = residual[i, left_out] if len(left_out) == 1 else grouped[i]
            claimed = covariance[i, left_out] if len(left_out) == 1 else of_group[i]
            np.testing.assert_allclose(got, expected, atol=1e-3)
            np.testing.assert_allclose(claimed, spread + recording.cov_px2[k, left_out], rtol=1e-2, atol=1e-5)


@pytest.mark.parametrize("scene", ["smooth", "four-skew-beams"])
def test_the_columns_of_a_fault_are_what_it_does_to_the_pixels(scene):
    run, recording = recorded(scene, 5, frames=60)
    columns = FaultColumns.of(run.rig, run.model, None)
    lin = linearise(run.model, recording, np.arange(10, 50, 10))
    moves = columns.at(recording, lin)
    camera = one_camera(scene)
    angle = np.deg2rad(0.01)
    for fault in possible_faults(run.rig, columns):
        if (fault.thing, fault.name, fault.kind) != ("camera", camera, "turned"):
            continue
        for axis in range(3):
            other = SpotModel.of(turned(camera, 0.01, axis)(run.rig))
            shift = other.project(lin.poses)[0] - run.model.project(lin.poses)[0]
            whitened = np.where(lin.used[..., None], (lin.W @ shift[..., None])[..., 0], 0.0)
            np.testing.assert_allclose(moves @ fault.numbers[:, axis] * angle, whitened, atol=2e-3)
            assert np.abs(whitened).max() > 0.5


def test_a_screen_that_slides_in_its_own_plane_changes_nothing_and_no_fault_says_so():
    run, recording = recorded("smooth", 5, frames=200, really=changed("screens.right.y_m", 0.01))
    assert check_model(run.rig, recording).findings == ()


def test_wrong_labels_in_a_few_frames_are_outliers_and_no_fault():
    run, recording = recorded("smooth", 5, frames=300)
    uv = recording.uv_px.copy()
    uv[50:60, 1] += [12.0, -7.0]
    uv[200:203, 4] += [0.0, 30.0]
    check = check_model(run.rig, dataclasses.replace(recording, uv_px=uv))
    assert check.findings == ()
    assert check.statistics is not None
    shares = {g.name: g.outliers for g in check.statistics.views}
    assert shares["left/2"] == pytest.approx(10 / 300, abs=1e-9)
    assert shares["right/5"] == pytest.approx(3 / 300, abs=1e-9)
    assert shares["left/1"] == 0


def test_wrong_labels_are_seen_as_such_in_a_set_up_that_is_wrong_too():
    """The camera's turn sets its spots 60 sigma off; a wrong label differs from them, not from 0."""
    run, recording = recorded("two-cameras-per-screen", 5, frames=300, really=turned("right-a", 0.3, 1))
    uv = recording.uv_px.copy()
    uv[100:105, 6] += [0.0, 12.0]
    check = check_model(run.rig, dataclasses.replace(recording, uv_px=uv))
    assert named(check) == [("camera", "right-a")]
    assert check.statistics is not None
    assert check.statistics.views[6].outliers >= 5 / 300
    assert max(g.outliers for g in check.statistics.views) < 10 / 300


def test_what_a_large_fault_leaves_by_not_being_linear_is_no_second_fault():
    """46 sigma, in a motion with bends: 10 ms at the speed of one instant leave a little for others to explain."""
    run, recording = recorded("two-cameras-per-screen", 5, late=("right-a", 10e-3))
    (finding,) = check_model(run.rig, recording).findings
    assert "camera `right-a` is about 9.92" in finding.what


def test_a_spot_that_is_hardly_ever_measured_where_it_should_be_is_told():
    run, recording = recorded("four-skew-beams", 5, frames=300)
    seen = recording.seen.copy()
    seen[40:, 6] = False
    (finding,) = check_model(run.rig, dataclasses.replace(recording, seen=seen)).findings
    assert finding.level == Level.WARN
    assert finding.what.startswith("spot 7 in camera `right` was measured in 40 of 300 frames")
    assert "points so far elsewhere" in finding.why
    seen[40:200, 6] = recording.seen[40:200, 6]  # behind a post for the last 100 frames
    assert check_model(run.rig, dataclasses.replace(recording, seen=seen)).findings == ()


@pytest.mark.parametrize("factor", [3.0, 20.0])
def test_sigmas_claimed_too_small_are_a_warning_with_the_factor_and_accuse_nobody(factor):
    run, recording = recorded("smooth", 5, frames=300, claimed_px=NOISE_PX / factor)
    check = check_model(run.rig, recording)
    (finding,) = check.findings
    assert finding.level == Level.WARN
    assert f"{short(factor, 2)} times as large as the sigmas of the detections; they are random" in finding.what
    assert check.inquest is not None
    assert check.inquest.culprits == ()
    assert check.inquest.noise == pytest.approx(factor, rel=0.1)


def test_the_camera_with_the_wrong_sigmas_is_named():
    run, recording = recorded("smooth", 5, frames=300)
    claims = recording.cov_px2.copy()
    claims[:, run.model.camera_of == 1] /= 4.0**2
    (finding,) = check_model(run.rig, dataclasses.replace(recording, cov_px2=claims)).findings
    assert finding.level == Level.WARN
    factors = dict(re.findall(r"camera `(\w+)` ([\d.]+)", finding.what))
    assert float(factors["left"]) == pytest.approx(1.0, abs=0.15)
    assert float(factors["right"]) == pytest.approx(4.0, rel=0.1)


def test_uneven_claims_do_not_make_a_right_rig_look_wrong():
    """All tests weigh by the claims: with those of one camera of four too small, p was 2e-9 for a right rig."""
    run, recording = recorded("two-cameras-per-screen", 5, frames=300)
    claims = recording.cov_px2.copy()
    claims[:, run.model.camera_of == 1] /= 4.0**2
    check = check_model(run.rig, dataclasses.replace(recording, cov_px2=claims))
    assert check.inquest is not None
    assert check.inquest.p_before > 1e-4
    assert len(check.findings) == 1
    expected = {"left-a": 1.0, "left-b": 4.0, "right-a": 1.0, "right-b": 1.0}
    assert check.noise_of_cameras == pytest.approx(expected, rel=0.1)


def test_noise_alone_does_not_make_a_small_fault_a_failure():
    small = [Effect(0, 0, 0.0, 0.2, 0.1, 0.1, 0.1)]
    for noise, level in ((1.0, Level.FAIL), (8.0, Level.PASS)):
        inquest = FaultDiagnosis((), 0.0, 1.0, 30, 8.0, noise, 1.0, False, np.ones(6))
        assert messages.level_of(inquest, small) == level


def test_large_errors_that_last_are_no_noise_and_fail():
    """Drifting air or a bent screen: 0.8 px that change over 50 frames, at claimed sigmas of 0.1 px."""
    run, recording = recorded("smooth", 5, frames=600)
    rng = np.random.default_rng(8)
    noise = rng.standard_normal((700, *recording.uv_px.shape[1:]))
    slow = np.apply_along_axis(lambda x: np.convolve(x, np.ones(50) / np.sqrt(50), "valid")[:600], 0, noise)
    check = check_model(run.rig, dataclasses.replace(recording, uv_px=recording.uv_px + 8 * NOISE_PX * slow))
    assert check.inquest is not None
    assert check.inquest.lasts
    (finding,) = check.findings
    assert finding.level == Level.FAIL
    assert "do not average out" in finding.why


def test_a_fault_is_measured_against_the_noise_that_the_recording_shows():
    """A camera turned by 0.05 deg is the same fault whether or not the detections claim sigmas that are too small."""
    sigmas = []
    for factor in (1.0, 3.0):
        run, recording = recorded(
            "smooth", 5, frames=300, really=turned("right", 0.05, 1), claimed_px=NOISE_PX / factor
        )
        check = check_model(run.rig, recording)
        assert ("camera", "right") in named(check)
        sigmas.append(check.effects[0][0].off_sigmas)
    assert sigmas[1] == pytest.approx(sigmas[0], rel=0.1)


@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_what_a_tracker_has_widened_is_tested_as_the_detections_claimed_it(factor):
    """A camera turned by 0.3 deg, 0.86 px: 8.6 sigma of the claims, whatever scale the tracker has learnt from it."""
    run, recording = recorded("smooth", 5, frames=200, really=turned("right", 0.3, 1))
    kept, n = FrameSampler(), len(run.model)
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
        claimed = claimed_covariances(tracked, found, run.model.camera_of, TrackerParameters())
        kept.add_tracked(0.01 * k, tracked, None, claimed)
    check = check_kept(run.rig, kept)
    assert check.effects[0][0].off_sigmas == pytest.approx(8.6, rel=0.1)
    assert check.level == Level.FAIL
    assert check.inquest is not None
    assert check.inquest.noise == pytest.approx(1.0, abs=0.1)


def test_a_detection_that_a_neighbour_has_pulled_has_little_say():
    _, recording = recorded("smooth", 5, frames=40)
    n, p = 6, TrackerParameters()
    found = [Detections.at(recording.uv_px[0, :3], recording.cov_px2[0, :3]), None]
    used_in_pose = np.array([True, False, True, True, True, True])
    tracked = TrackedFrame(
        recording.uv_px[0], recording.cov_px2[0] * 9, (SpotStatus.MATCHED,) * n, np.full((n, 2), np.nan),
        np.full(n, np.nan), np.array([0, 1, -1, 0, 1, 2]), PoseStatus.MEASURED, recording.poses[0], None, 3, 0.1, (),
        used_in_pose=used_in_pose,
    )  # fmt: skip
    claimed = claimed_covariances(tracked, found, np.array([0, 0, 0, 1, 1, 1]), p)
    model = p.sigma_model_px**2
    np.testing.assert_allclose(claimed[0], recording.cov_px2[0, 0] + model * np.eye(2))
    np.testing.assert_allclose(claimed[1], recording.cov_px2[0, 1] + (model + (p.blend_px / 2) ** 2) * np.eye(2))
    np.testing.assert_allclose(claimed[2:], tracked.cov_px2[2:])  # not detected, or no picture: the tracker's


def test_errors_that_last_for_a_second_accuse_nobody():
    """Drifting air, say: 0.1 px that change over 50 frames. Taken for independent they would be proof of some fault."""
    run, recording = recorded("smooth", 5, frames=600)
    rng = np.random.default_rng(8)
    noise = rng.standard_normal((700, *recording.uv_px.shape[1:]))
    slow = np.apply_along_axis(lambda x: np.convolve(x, np.ones(50) / np.sqrt(50), "valid")[:600], 0, noise)
    check = check_model(run.rig, dataclasses.replace(recording, uv_px=recording.uv_px + NOISE_PX * slow))
    assert check.inquest is not None
    assert check.inquest.correlation_frames > 5
    assert check.findings == ()


def test_predictions_that_keep_their_word_have_a_nis_of_one():
    run, recording = recorded("smooth", 5, frames=300, predicted=True)
    statistics = check_model(run.rig, recording).statistics
    assert statistics is not None
    groups = [*statistics.views, *statistics.cameras, *statistics.beams]
    assert all(g.nis is not None and 0.8 < g.nis.mean < 1.2 and g.nis.low < 1 < g.nis.high for g in groups)
    boasting = dataclasses.replace(recording, predicted_cov_px2=recording.predicted_cov_px2 * 0.0)
    statistics = check_model(run.rig, boasting).statistics
    assert statistics is not None
    assert all(g.nis is not None and g.nis.mean == pytest.approx(2.0, abs=0.3) for g in statistics.views)
    assert all(g.nis is not None and g.nis.mean > g.nis.high for g in statistics.views)


def test_the_band_of_a_mean_nis_is_that_of_a_chi_square():
    """Bar-Shalom, Li & Kirubarajan (2001), sec. 5.4: chi-square tables, 100 degrees of freedom: 74.222 and 129.561."""
    assert nis_band(50) == pytest.approx((0.74222, 1.29561), rel=1e-4)


@pytest.mark.parametrize(("rho", "expected"), [(0.0, 1.0), (0.6, 4.0), (0.9, 19.0)])
def test_the_correlation_time_of_a_first_order_process_is_the_known_one(rho, expected):
    """(1 + rho) / (1 - rho)."""
    noise = np.random.default_rng(5).standard_normal((20_000, 2))
    series = np.empty_like(noise)
    series[0] = 0
    for k in range(1, len(noise)):
        series[k] = rho * series[k - 1] + noise[k]
    series[::7] = np.nan
    assert correlation_time(series - np.nanmean(series, axis=0)) == pytest.approx(expected, rel=0.2)


def test_the_pose_bias_that_is_told_is_the_one_that_the_fault_makes():
    run, recording = recorded("four-skew-beams", 5, frames=300, really=changed("beams.B.direction_z", 2e-3))
    check = check_model(run.rig, recording)
    ((effect,),) = check.effects
    other, bias = SpotModel.of(changed("beams.B.direction_z", 2e-3)(run.rig)), []
    for k in range(0, 300, 5):
        rows = np.flatnonzero(recording.usable[k])
        fit = fit_pose(run.model, rows, other.project(run.poses[k])[0][rows], recording.cov_px2[k, rows], run.poses[k])
        assert fit is not None
        bias.append(fit.world_from_body.minus(run.poses[k]))
    turn, move = (np.sqrt(np.mean(np.sum(np.array(bias)[:, s] ** 2, axis=1))) for s in (slice(3, 6), slice(3)))
    assert effect.attitude_deg == pytest.approx(np.rad2deg(turn), rel=0.1)
    assert effect.position_mm == pytest.approx(1e3 * move, rel=0.1)


def test_a_run_that_claims_better_poses_is_judged_by_what_it_claims():
    run, recording = recorded("smooth", 5, frames=300, really=changed("screens.right.x_m", 2e-3))
    plain = check_model(run.rig, recording)
    claims = np.broadcast_to(np.diag([3e-5**2] * 3 + [3e-6**2] * 3), (300, 6, 6))
    bold = check_model(run.rig, dataclasses.replace(recording, pose_covariance=claims.copy()))
    assert plain.level == Level.WARN
    assert bold.level == Level.FAIL


def test_too_few_frames_are_not_tested_and_the_reason_is_given():
    run, recording = recorded("smooth", 5, frames=20)
    check = check_model(run.rig, recording)
    assert check.inquest is None
    assert check.why_not == "20 frames have 3 and more spots measured; the test needs 30"
    assert check.as_mapping()["tested"] is False


def test_frames_without_pose_or_with_broken_covariances_are_passed_over():
    run, recording = recorded("smooth", 5, frames=200)
    recording.poses.translation[10:20] = np.nan
    recording.cov_px2[30:40, 2] = 0.0
    recording.cov_px2[40:50, 2] = np.nan
    recording.uv_px[50:60, 3] = np.nan
    check = check_model(run.rig, recording)
    assert check.findings == ()
    assert check.frames_used == 190


def test_a_recording_of_other_views_is_refused():
    _, recording = recorded("smooth", 5, frames=40)
    other, _ = recorded("four-skew-beams", 5, frames=40)
    with pytest.raises(ValueError, match="expected 7 views as the rig has, got 6"):
        check_model(other.rig, recording)
    with pytest.raises(ValueError, match=r"uv_px: expected shape \(40, 6, 2\)"):
        dataclasses.replace(recording, uv_px=recording.uv_px[:, :5])


def test_the_result_is_plain_json_and_complete():
    run, recording = recorded("smooth", 5, frames=200, late=("right", 3e-3), predicted=True)
    check = check_model(run.rig, recording)
    mapping = json.loads(json.dumps(check.as_mapping()))
    assert mapping["findings"][0]["level"] == "FAIL"
    assert mapping["culprits"][0]["thing"] == "clock"
    assert mapping["culprits"][0]["delta"][0] == pytest.approx(3e-3, rel=0.1)
    assert [v["name"] for v in mapping["views"]] == [f"{c}/{s}" for c, s in run.model.views]
    assert [v["name"] for v in mapping["beams"]] == list(run.rig.beams)


def test_each_rival_is_told_with_its_own_size_and_effect():
    run, recording = recorded("smooth", 5, frames=300, really=changed("screens.right.x_m", 2e-3))
    check = check_model(run.rig, recording)
    (best,) = check.as_mapping()["culprits"]
    (rival,) = best["rivals"]
    assert (best["thing"], best["name"], rival["thing"], rival["name"]) == ("screen", "right", "camera", "left")
    assert rival["kind"] == "focal length changed"
    assert rival["attitude_deg"] < 0.5 * best["attitude_deg"]
    assert re.search(r"by about 0\.00\d+ to 0\.00\d+ deg and", check.findings[0].why)


def test_frames_kept_one_by_one_tell_the_same_as_all_of_them_and_stay_few():
    run, recording = recorded("smooth", 5, frames=600, late=("right", 3e-3))
    keeper, kept = FrameSampler(most=200), None
    for k in range(600):
        keeper.add(
            float(recording.t_s[k]), recording.seen[k], recording.uv_px[k], recording.cov_px2[k], recording.poses[k]
        )
        kept = keeper.recording() if k % 50 == 49 else kept
        assert k < 200 or (kept is not None and 95 <= len(kept.t_s) <= 200)
    assert kept is not None
    check = check_model(run.rig, kept)
    assert check.inquest is not None
    (culprit,) = check.inquest.culprits
    assert culprit.best.fault.thing == "clock"
    assert culprit.best.change.delta[0] == pytest.approx(3e-3, rel=0.1)


def test_a_run_without_frames_is_not_tested_and_says_so():
    run, _ = recorded("smooth", 5, frames=40)
    assert FrameSampler().recording() is None
    assert check_kept(run.rig, FrameSampler()).why_not == "there is no frame"


def test_of_a_trackers_frames_only_what_it_measured_counts():
    _, recording = recorded("smooth", 5, frames=40)
    status = [SpotStatus.MATCHED, SpotStatus.TURNED, SpotStatus.OCCLUDED, SpotStatus.OUT_OF_VIEW, SpotStatus.LOST]
    keeper, nowhere = FrameSampler(), np.full((6, 2), np.nan)
    for k, pose in enumerate((recording.poses[0], None)):
        nothing = np.full(6, np.nan), np.full(6, -1)
        words_of = (*status, SpotStatus.NO_IMAGE)
        uv, cov = recording.uv_px[k], recording.cov_px2[k]
        tracked = TrackedFrame(uv, cov, words_of, nowhere, *nothing, PoseStatus.MEASURED, pose, None, 2, 0.1, ())
        keeper.add_tracked(0.01 * k, tracked)
    kept = keeper.recording()
    assert kept is not None
    assert kept.seen.tolist() == [[True, True, False, False, False, False]] * 2
    assert kept.usable.sum(axis=1).tolist() == [2, 0]
    assert kept.pose_covariance is None


@pytest.mark.slow
def test_frames_of_a_tracker_are_checked_and_a_wrong_rig_is_told():
    """By a real tracker on simulated detections; the second rig has the right screen 10 mm nearer than it is."""
    run = simulate_points("four-skew-beams", 5, frames=45)
    levels = []
    for rig in (run.rig, changed("screens.right.x_m", -0.01)(run.rig)):
        tracker = SpotTracker(rig, TrackerParameters(), PosePrior(run.poses[0], 0.3, 0.1))
        keeper = FrameSampler()
        for t_s, found in zip(run.t_s, run.detections, strict=True):
            keeper.add_tracked(float(t_s), tracker.step(0.01, found))
        levels.append(check_kept(rig, keeper).level)
    assert levels == [Level.PASS, Level.FAIL]


def test_a_fault_that_is_sure_but_small_is_no_alarm():
    run, recording = recorded("two-cameras-per-screen", 5, frames=400, really=turned("right-a", 0.002, 1))
    check = check_model(run.rig, recording)
    assert [f.level for f in check.findings] == [Level.PASS]
    assert check.findings[0].why.startswith("it is sure but small")
    assert check.findings[0].remedy == ""


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [(0.3501, 0.0123, "0.350 ± 0.012"), (2.93, 0.05, "2.93 ± 0.05"), (12.0, 3.0, "12 ± 3"), (0.5, 0.0, "0.50")],
)
def test_a_size_has_the_digits_that_its_sigma_allows(value, sigma, text):
    assert plus_minus(value, sigma) == text


def test_the_threshold_is_kept():
    assert P_FALSE_ALARM <= 1e-6
    assert messages.MATTERS_SIGMAS < messages.WRONG_SIGMAS == quality.MOST_MISFIT
    assert messages.NOISY == quality.GOOD_MISFIT


def test_thinning_keeps_both_ends_and_never_more_than_asked():
    frames = np.arange(1000)
    chosen = evenly(frames, 400)
    assert (chosen[0], chosen[-1], len(chosen)) == (0, 999, 400)
    assert len(evenly(frames[:7], 400)) == 7
