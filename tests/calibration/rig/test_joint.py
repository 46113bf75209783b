"""Joint adjustment of a whole rig, against simulated campaigns with known truth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from bench.rig_calibration import as_measured, bench_figures, calibrated, measured_with, parameter_errors
from calibration.least_squares.adjustment import AdjustmentError
from calibration.rig.joint import CORNERS, DOTS, RECORDS, SPOTS, calibrate_jointly
from calibration.rig.rig_figures import calibrate_in_steps, central_pose, expected_pose, hold_out, spot_sigma
from calibration.screens.network import FRAMES, LENSES
from calibration.screens.screens import calibrate
from calibration.terms.corners import CornerTerm
from geometry.pose import Pose
from lab.calibrate.rig.rig_page import joint_findings
from lab.findings.finding import Level
from lab.simulate.campaign import Campaign, CampaignQuality, draw_campaign, spots_at

SMALL = CampaignQuality(positions=15, dots=(5, 4))


@cache
def campaign(seed=1):
    return draw_campaign(seed, "fan", SMALL)


@cache
def steps():
    return calibrated(campaign())


def calibrated_from(c: Campaign, **changed):
    network, setups, stand = as_measured(c)
    return calibrate_in_steps(calibrate(network, setups), c.spots, replace(stand, **changed))


def findings_of(of):
    positions = [str(k) for k in range(len(of.measured.stand.stand_from_body.translation))]
    return joint_findings(of, positions, expected_pose(of.joint, central_pose(of.joint), 0.05), None)


def test_noise_free_measurements_give_the_true_rig():
    exact = CampaignQuality(
        positions=12, dots=(4, 3), survey_m=3e-8, dot_px=1e-5, stand_m=1e-9, stand_deg=1e-7, spot_px=1e-5,
        lens_corner_px=1e-5,
    )  # fmt: skip
    c = draw_campaign(3, "four-skew-beams", exact)
    joint = calibrated(c).joint
    rng = np.random.default_rng(0)
    poses = Pose.from_ypr(rng.uniform(-0.2, 0.2, (4, 3)), rng.uniform(-0.1, 0.1, (4, 3)))
    errors, _, _ = measured_with(joint.rig, joint.covariance, c.truth, poses, 1e-5, rng)
    # 1e-5 px is 2e-9 rad; the rig differs by 0.3 deg and millimetres from its drawing.
    assert np.abs(errors[:, 3:]).max() < np.deg2rad(1e-5)
    assert np.abs(errors[:, :3]).max() < 1e-6


def test_parameter_errors_agree_with_the_joint_covariance():
    _, nees = parameter_errors(steps().joint, campaign().truth)
    # 36 or so numbers: sigma of a mean of squares is sqrt(2 / 36) = 0.24.
    assert 0.3 < nees < 1.8


def test_the_joint_adjustment_is_at_least_as_accurate_as_the_single_steps():
    joint, alone = steps().joint, steps().beams
    at = joint.unknowns.of_several([("beams", i) for i in range(3)])
    now, before = joint.all_covariance[np.ix_(at, at)], alone.lines_covariance
    assert np.trace(now[:2, :2]) <= 1.05 * np.trace(before[:2, :2])


def test_outliers_of_spots_and_dots_are_excluded_and_do_not_change_the_result():
    c = campaign()
    rng = np.random.default_rng(5)
    spots, dots = c.spots.pixels.copy(), c.seen_pixels.copy()
    some, others = rng.choice(len(spots), 4, replace=False), rng.choice(len(dots), 2, replace=False)
    spots[some] += rng.choice([-8.0, 8.0], (4, 2))
    dots[others] += rng.choice([-8.0, 8.0], (2, 2))
    found = calibrated(replace(c, spots=replace(c.spots, pixels=spots), seen_pixels=dots)).joint
    assert not found.kept[SPOTS][some].any()
    assert not found.kept[DOTS][others].any()
    good = steps().joint
    moved = np.concatenate([found.values[s].minus(good.values[s])[i] for s, i in good.rig_at])
    rows = good.unknowns.of_several(good.rig_at)
    sigma = np.sqrt(np.diagonal(good.all_covariance)[rows])
    real = sigma > 3e-6
    # Four of some eighty spots and two of forty dots are excluded.
    assert np.sqrt(np.mean((moved[real] / sigma[real]) ** 2)) < 0.5


def test_a_stand_ten_times_less_accurate_than_stated_is_detected():
    q = replace(SMALL, positions=12, dots=(4, 3), stand_m=3e-4, stand_deg=0.03)
    c = draw_campaign(2, "fan", q)
    network, setups, stand = as_measured(c)
    found = calibrate_in_steps(calibrate(network, setups), c.spots, replace(stand, pose_sigmas=stand.pose_sigmas / 10))
    assert 4 < found.joint.scales[RECORDS] < 20
    assert SPOTS not in found.joint.scales
    (finding,) = [f for f in findings_of(found) if f.what.startswith(RECORDS) and "sigmas" in f.what]
    assert finding.level >= Level.WARN
    assert "stand" in finding.remedy
    # With the increased sigmas the covariance is correct.
    _, nees = parameter_errors(found.joint, c.truth)
    assert nees < 2


def test_a_lens_refocused_since_its_calibration_is_detected():
    c = campaign()
    left = c.lenses["left"]
    matrix = left.camera_matrix + np.diag([9.0, 9.0, 0.0])  # 20 sigmas and more
    found = calibrated(replace(c, lenses={**c.lenses, "left": replace(left, camera_matrix=matrix)}))
    (finding,) = [f for f in findings_of(found) if f.what.startswith(LENSES)]
    assert finding.level >= Level.WARN
    assert "refocused" in finding.why


def test_correct_measurements_pass():
    assert steps().joint.scales == {}
    assert all(f.level == Level.PASS for f in findings_of(steps()) if "held out" not in f.what)


def test_the_expected_covariance_is_the_sum_of_noise_and_the_shares_of_each_kind():
    joint = steps().joint
    e = expected_pose(joint, central_pose(joint), spot_sigma(joint))
    np.testing.assert_allclose(e.noise + e.systematic, e.total, rtol=1e-6, atol=1e-14)
    np.testing.assert_allclose(sum(e.shares.values()), e.systematic, rtol=1e-6, atol=1e-14)
    assert np.trace(e.shares[FRAMES]) < 1e-9 * np.trace(e.systematic)


def test_errors_of_held_out_positions_agree_with_the_covariance():
    h = hold_out(steps().measured, steps().joint)
    assert sorted(h.positions) == list(range(15))
    assert 0.8 < h.ratio < 1.2
    assert h.p > 1e-3


@pytest.mark.slow
def test_a_hold_out_detects_spots_that_move_between_positions_beyond_their_sigmas():
    c = campaign()
    rng = np.random.default_rng(8)
    # All spots of a position move together by 0.5 px, as if the vehicle rocked on its carriage.
    rock = rng.normal(0, 0.5, (15, 2))[c.spots.position]
    rocking = calibrated(replace(c, spots=replace(c.spots, pixels=c.spots.pixels + rock)))
    # In the joint adjustment the sigmas of the spots or of the stand are increased strongly.
    assert max(rocking.joint.scales.values()) > 3
    held_out = hold_out(rocking.measured, rocking.joint)
    assert held_out.attitude_rms > 3 * hold_out(steps().measured, steps().joint).attitude_rms


def test_a_stand_that_rotates_about_one_axis_only_raises_with_the_remedy():
    c = campaign()
    about_z = np.zeros((15, 3))
    about_z[:, 0] = np.linspace(-0.4, 0.4, 15)
    flat = Pose.from_ypr(about_z, np.zeros((15, 3)))
    spots = spots_at(c.truth, c.world_from_stand @ flat, 0.05, np.random.default_rng(0))
    with pytest.raises(AdjustmentError, match="add positions turned by 10 deg or more about the stand's"):
        calibrated(replace(c, spots=spots, stand_recorded=flat))


def test_a_calibration_without_some_positions_keeps_outliers_and_sigmas():
    measured, joint = steps().measured, steps().joint
    without = measured.spots.position < 3
    part = calibrate_jointly(measured, without=without, start=joint)
    assert not part.kept[SPOTS][without].any()
    at = joint.unknowns.of_several([("beams", 0)])
    assert np.trace(part.all_covariance[np.ix_(at, at)]) > np.trace(joint.all_covariance[np.ix_(at, at)])


def boards_before(c: Campaign, sigma_px=0.08):
    """Corners of a board before the left camera at four positions."""
    camera = c.truth.cameras["left"]
    x, y = np.meshgrid(np.arange(7) * 0.1, np.arange(5) * 0.1)
    board = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    middle = board.mean(axis=0)
    turns = np.deg2rad([[0, 25, 0], [10, -25, 5], [0, 5, 30], [-10, 10, -30]])
    at = Pose.from_ypr(turns, np.array([[-0.5, -0.3, 2.2], [0.3, -0.4, 2.4], [-0.4, 0.1, 2.3], [0.2, 0.2, 2.5]]))
    placement = np.repeat(np.arange(4), len(board))
    world = (camera.camera_from_world.inverse() @ at)[placement].apply(np.tile(board - middle, (4, 1)))
    pixels = camera.project(world) + np.random.default_rng(3).normal(0, sigma_px, (len(world), 2))
    n = len(pixels)
    none = np.zeros(n, dtype=np.int64)
    return CornerTerm(
        pixels, np.tile(board, (4, 1)), np.tile((board - middle)[:, :2], (4, 1)), none, placement, none,
        np.full(n, 0.2), np.array([False, False]),
    )  # fmt: skip


def test_photographed_boards_improve_the_lens():
    c = campaign()
    network, setups, stand = as_measured(c)
    with_boards = replace(network, corners=boards_before(c), placements=("1", "2", "3", "4"))
    found = calibrate_in_steps(calibrate(with_boards, setups), c.spots, stand).joint
    assert found.groups[CORNERS].p > 1e-3
    assert found.kept[CORNERS].mean() > 0.98
    alone = steps().joint
    at = [("intrinsics", 0)]
    lens, before = (np.diagonal(j.all_covariance)[j.unknowns.of_several(at)][:4] for j in (found, alone))
    assert np.all(lens < before)
    _, nees = parameter_errors(found, c.truth)
    assert 0.3 < nees < 1.8


@pytest.mark.slow
def test_forty_campaigns_have_attitudes_within_a_hundredth_of_a_degree_and_correct_covariances():
    figures = bench_figures(range(40))
    assert figures["attitude_worst_axis_rms_deg"] <= 0.01
    assert figures["position_worst_axis_rms_mm"] <= 0.5
    # 40 campaigns of 6 numbers, with correlated poses in each campaign: sigma of the mean is sqrt(2 / 6 / 40) = 0.09.
    assert 0.85 <= figures["nees_per_number"] <= 1.15
    # With an assumed exact calibration the errors exceed the covariance.
    assert figures["nees_noise_alone"] > 1.4
    assert 62 <= figures["coverage_percent"] <= 75
    assert 0.85 <= figures["joint_nees_per_number"] <= 1.15
