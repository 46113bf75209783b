"""Beam calibration from known positions of a stand, against truth, and its errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from calibration.beams.beams import StandModel, calibrate_beams
from calibration.beams.spot_fit import line_through
from calibration.least_squares.adjustment import AdjustmentError
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance, perturbed_rig
from lab.calibrate.beams.beams_page import beam_findings
from lab.findings.finding import Level
from lab.simulate.scenarios import RIGS
from tests.calibration.beams.bench import (
    ARCSEC,
    SIGMA_PX,
    WORLD_FROM_STAND,
    drawn,
    errors,
    exact,
    opposed,
    positions,
    recorded,
    unknown_place,
)


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("known", [exact, unknown_place])
def test_noise_free_beams_are_exact_to_rounding(name, known):
    rng = np.random.default_rng(1)
    rig = RIGS[name]()
    poses = positions(rng, 20)
    spots = recorded(rng, rig, poses)
    model = SpotModel.of(rig)
    clean = replace(spots, pixels=model.project(WORLD_FROM_STAND @ poses)[0][spots.position, spots.view])
    found = calibrate_beams(drawn(rig, rng), clean, known(poses))
    e = errors(rig, found.rig)
    # The iteration stops at steps of 1e-3 sigmas; a sigma is at most about 30 arcsec and 0.5 mm.
    assert np.abs(e[:, :2]).max() < 0.05 * ARCSEC
    assert np.abs(e[:, 2:]).max() < 1e-6
    assert found.undetermined == []
    assert found.fit.scale == 1.0


def test_beams_far_from_the_nominal_ones_start_from_lines_through_the_spots():
    rng = np.random.default_rng(2)
    rig = opposed(RIGS["four-skew-beams"](), rng)
    poses = positions(rng)
    nothing = drawn(rig, rng, 100.0, 5.0)
    found = calibrate_beams(nothing, recorded(rng, rig, poses), exact(poses))
    sigmas = np.sqrt(np.diagonal(found.lines_covariance)).reshape(-1, 4)
    assert np.all(np.abs(errors(rig, found.rig)) < 5 * sigmas)


def test_two_beams_exchanged_in_the_drawing_do_not_matter_if_the_stand_is_known():
    rng = np.random.default_rng(3)
    rig = RIGS["fan"]()
    swapped = replace(rig, beams={"A": replace(rig.beams["C"], name="A"), **{n: rig.beams[n] for n in "BC"}})
    poses = positions(rng)
    found = calibrate_beams(swapped, recorded(rng, rig, poses), exact(poses))
    assert np.abs(errors(rig, found.rig)[:, :2]).max() < 15 * ARCSEC


def test_the_position_of_the_nominal_point_along_the_beam_does_not_matter():
    rng = np.random.default_rng(14)
    rig = RIGS["four-skew-beams"]()
    poses = positions(rng, 20)
    spots = recorded(rng, rig, poses)
    slid = replace(rig, beams={n: replace(b, point=b.point + 2.0 * b.direction) for n, b in rig.beams.items()})
    one, other = (calibrate_beams(r, spots, exact(poses)) for r in (rig, slid))
    np.testing.assert_allclose(one.lines.points, other.lines.points, atol=1e-6)
    np.testing.assert_allclose(one.lines_covariance, other.lines_covariance, rtol=1e-3, atol=1e-14)
    assert np.abs(np.sum(one.lines.points * one.lines.directions, axis=1)).max() < 1e-12  # nearest to the origin


def test_opposed_lasers_require_positions_at_different_distances_from_the_screens():
    rng = np.random.default_rng(15)
    rig = opposed(RIGS["unequal-fan"](), rng)
    sigma = {}
    for shift in (0.2, 0.8):
        poses = positions(rng, shift_m=(shift, 0.2, 0.2))
        found = calibrate_beams(rig, recorded(rng, rig, poses), exact(poses))
        sigma[shift] = np.sqrt(np.mean(found.direction_sigmas**2)) / ARCSEC
    # 40 positions; in 30 simulations each the errors were 26 and 12 arcsec RMS per axis
    assert sigma[0.2] > 20
    assert sigma[0.8] < 15


def test_up_to_half_of_the_points_of_a_line_may_be_outliers():
    rng = np.random.default_rng(4)
    direction = np.array([0.6, 0.0, 0.8])
    points = rng.uniform(2, 3, (40, 1)) * direction + rng.normal(0, 2e-4, (40, 3))
    points[:18] = rng.uniform(-3, 3, (18, 3))
    line = line_through(points)
    assert line is not None
    assert np.linalg.norm(np.cross(line[1], direction)) < 1e-3


def test_coincident_points_give_no_line():
    assert line_through(np.full((9, 3), 0.3)) is None


def test_outliers_are_excluded_and_do_not_change_the_result():
    rng = np.random.default_rng(5)
    rig = RIGS["unequal-fan"]()
    poses = positions(rng)
    spots = recorded(rng, rig, poses)
    clean = calibrate_beams(drawn(rig, rng), spots, exact(poses))
    bad = rng.choice(len(spots), 15, replace=False)
    pixels = spots.pixels.copy()
    pixels[bad[:10]] += 40.0  # reflections
    pixels[bad[10:]] += 6 * SIGMA_PX  # small ones
    found = calibrate_beams(drawn(rig, rng), replace(spots, pixels=pixels), exact(poses))
    assert set(bad) <= set(np.flatnonzero(~found.fit.kept))
    sigmas = np.sqrt(np.diagonal(clean.lines_covariance)).reshape(-1, 4)
    # Excluding 15 of 200 spots changes an estimate by about sqrt(15 / 200) of a sigma.
    assert np.all(np.abs(errors(clean.rig, found.rig)) < 1.0 * sigmas)


def test_inconsistent_spots_raise():
    rng = np.random.default_rng(6)
    rig = RIGS["fan"]()
    poses = positions(rng)
    spots = recorded(rng, rig, poses)
    mixed = replace(spots, position=rng.permutation(spots.position))
    with pytest.raises(AdjustmentError, match=r"only \d+ of \d+ spots are consistent"):
        calibrate_beams(rig, mixed, exact(poses))


def test_noise_larger_than_stated_increases_the_sigmas():
    rng = np.random.default_rng(7)
    rig = RIGS["fan"]()
    poses = positions(rng)
    spots = recorded(rng, rig, poses)
    understated = replace(spots, covariance=spots.covariance / 9)
    correct, found = (calibrate_beams(rig, s, exact(poses)) for s in (spots, understated))
    assert found.fit.scale == pytest.approx(3.0, rel=0.15)
    np.testing.assert_allclose(np.diagonal(found.lines_covariance), np.diagonal(correct.lines_covariance), rtol=0.3)


def test_with_yaw_alone_the_height_and_yaw_of_the_stand_are_undetermined():
    rng = np.random.default_rng(8)
    rig = RIGS["fan"]()
    yaw = np.deg2rad(np.linspace(-30, 30, 20))
    poses = Pose.from_ypr(np.stack([yaw, 0 * yaw, 0 * yaw], axis=1), np.zeros((20, 3)))
    spots = recorded(rng, rig, poses)
    found = calibrate_beams(drawn(rig, rng, 1e-3, 1e-3), spots, unknown_place(poses))
    assert list(found.undetermined) == [
        "all beams relative to the stand: a rotation about z",
        "all beams relative to the stand: a shift along z",
    ]
    assert found.motion.remedy() == "add positions turned by 10 deg or more about the stand's x and y"
    assert calibrate_beams(rig, spots, exact(poses)).undetermined == []  # determined by the known pose of the stand


def test_one_position_leaves_every_beam_undetermined():
    rng = np.random.default_rng(9)
    rig = opposed(RIGS["fan"](), rng)
    poses = Pose(np.eye(3)[None], np.zeros((1, 3)))
    found = calibrate_beams(rig, recorded(rng, rig, poses), exact(poses))
    assert len(found.undetermined) > 0
    assert "direction and offset, coupled" in found.undetermined[0]


def test_opposed_lasers_are_distinguished_from_one_line():
    rng = np.random.default_rng(10)
    rig = opposed(RIGS["fan"](), rng)
    poses = positions(rng)
    two = calibrate_beams(rig, recorded(rng, rig, poses), exact(poses))
    assert {(o.first, o.second) for o in two.collinearity} == {("A+", "A-"), ("B+", "B-"), ("C+", "C-")}
    assert all(o.p < 1e-3 for o in two.collinearity)
    straight = calibrate_beams(RIGS["fan"](), recorded(rng, RIGS["fan"](), poses), exact(poses))
    assert [o.first for o in straight.collinearity] == ["A end +", "B end +", "C end +"]
    assert all(o.p > 1e-3 for o in straight.collinearity)


def test_two_lasers_described_as_one_beam_are_detected():
    rng = np.random.default_rng(11)
    rig = RIGS["fan"]()
    truth = opposed(rig, rng, 3e-4, 5e-4)  # 1 arcmin and half a millimetre: no spot is an outlier
    poses = positions(rng)
    found = calibrate_beams(rig, recorded(rng, truth, poses), exact(poses))
    assert found.fit.kept.all()
    assert min(o.p for o in found.collinearity) < 1e-6


def test_errors_of_the_stand_increase_direction_sigmas_but_not_those_of_angles():
    rng = np.random.default_rng(12)
    rig = RIGS["fan"]()
    poses = positions(rng)
    spots = recorded(rng, rig, poses)
    yaw_sigma = 100 * ARCSEC
    loose = StandModel(poses, np.zeros(6), WORLD_FROM_STAND, np.diag([0, 0, 0, 0, 0, yaw_sigma**2]) + 1e-16 * np.eye(6))
    still, wide = (calibrate_beams(rig, spots, s) for s in (exact(poses), loose))
    assert wide.angles[0].sigma < 1.2 * still.angles[0].sigma
    assert np.diagonal(wide.lines_covariance).max() > np.diagonal(still.lines_covariance).max()


def rig_errors(rng: np.random.Generator, rig) -> RigCovariance:
    """Errors of cameras and screens from earlier steps, correlated between a camera and its screen."""
    names = [f"cameras.{c}.{p}" for c in rig.cameras for p in ("fx", "fy", "cx", "cy")]
    names += [
        f"{kind}.{c}.{p}" for kind in ("cameras", "screens") for c in rig.cameras for p in ("x_m", "z_m", "rot_y_rad")
    ]
    sigma = np.array(
        [1.0 if n.endswith(("fx", "fy", "cx", "cy")) else 3e-4 if n.endswith("_m") else 1e-4 for n in names]
    )
    mix = np.eye(len(names)) + 0.2 * rng.normal(size=(len(names), len(names)))
    return RigCovariance(tuple(names), (mix @ mix.T) * np.outer(sigma, sigma) / 2)


def simulated(seed: int, known: str):
    """Errors of a calibration in which every stated uncertainty is simulated, and its covariance."""
    rng = np.random.default_rng(seed)
    mounted = RIGS["unequal-fan"]()
    mounted = opposed(mounted, rng)
    poses = positions(rng, 40, shift_m=(0.6, 0.3, 0.3))
    spots = recorded(rng, mounted, poses)
    pose_sigmas = np.array([2e-4] * 3 + [20 * ARCSEC] * 3)
    read = poses.plus(rng.normal(size=(40, 6)) * pose_sigmas)
    knowledge = rig_errors(np.random.default_rng(0), mounted)
    assumed = perturbed_rig(
        mounted, knowledge.names, -rng.multivariate_normal(np.zeros(len(knowledge.names)), knowledge.matrix)
    )
    stand_sigmas = np.array([3e-4] * 3 + [30 * ARCSEC] * 3)
    if known == "known":
        place = WORLD_FROM_STAND.plus(rng.normal(size=6) * stand_sigmas)
        stand = StandModel(read, pose_sigmas, place, np.diag(stand_sigmas**2))
    else:
        stand = StandModel(read, pose_sigmas, None, None)
    found = calibrate_beams(drawn(assumed, rng, 0.01, 0.005), spots, stand, knowledge)
    return errors(mounted, found.rig), found


def tally(cases) -> tuple[float, float, float]:
    """Share of errors within 1 sigma, the mean NEES per parameter, the RMS angle (rad) between beams and truth."""
    within, nees, size = [], [], []
    for e, found in cases:
        sigma = np.sqrt(np.diagonal(found.lines_covariance))
        within.append(np.abs(e.ravel()) < sigma)
        nees.append(e.ravel() @ np.linalg.solve(found.lines_covariance, e.ravel()) / e.size)
        size.append(np.mean(np.sum(e[:, :2] ** 2, axis=1)))
    return float(np.mean(within)), float(np.mean(nees)), float(np.sqrt(np.mean(size)))


@pytest.mark.parametrize("known", ["known", "unknown"])
def test_errors_agree_with_the_covariance(known):
    # Shares within a sigma need many seeds, because the 24 errors of one are correlated; see the slow test.
    _, nees, _ = tally(simulated(s, known) for s in range(2))
    lo, hi = chi2.ppf([0.001, 0.999], 2 * 24) / (2 * 24)
    assert lo < nees < hi


@pytest.mark.slow
@pytest.mark.parametrize("known", ["known", "unknown"])
def test_errors_of_200_calibrations_agree_with_the_covariance(known):
    within, nees, size = tally(simulated(s, known) for s in range(200))
    lo, hi = chi2.ppf([0.025, 0.975], 200 * 24) / (200 * 24)
    print(
        f"{known}: within 1 sigma {within:.3f}, NEES {nees:.3f} ({lo:.3f} to {hi:.3f}), {size / ARCSEC:.1f} arcsec RMS"
    )
    assert lo < nees < hi
    assert 0.62 < within < 0.75


def bench_case(seed: int, known, mounted: Rig, shift_m: tuple[float, float, float] = (0.2, 0.2, 0.2)):
    """40 positions, spots with a sigma of 0.2 mm, exact cameras, screens and records."""
    rng = np.random.default_rng(7000 + seed)
    poses = positions(rng, shift_m=shift_m)
    found = calibrate_beams(drawn(mounted, rng), recorded(rng, mounted, poses), known(poses))
    return errors(mounted, found.rig), found


@pytest.mark.parametrize("known", [exact, unknown_place])
def test_40_positions_give_directions_within_15_arcsec(known):
    sizes = [np.sum(bench_case(s, known, RIGS["unequal-fan"]())[0][:, :2] ** 2, axis=1) for s in range(3)]
    assert np.sqrt(np.mean(sizes)) < 15 * ARCSEC


@pytest.mark.slow
@pytest.mark.parametrize("known", [exact, unknown_place])
def test_directions_of_200_simulations_are_within_15_arcsec_and_agree_with_the_covariance(known):
    within, nees, size = tally(bench_case(s, known, RIGS["unequal-fan"]()) for s in range(200))
    lo, hi = chi2.ppf([0.025, 0.975], 200 * 12) / (200 * 12)
    print(f"{known.__name__}: within {within:.3f}, NEES {nees:.3f} ({lo:.3f}-{hi:.3f}), {size / ARCSEC:.1f} arcsec")
    assert size < 15 * ARCSEC
    assert lo < nees < hi
    assert 0.62 < within < 0.75


def test_a_stand_that_hardly_tilts_gives_the_remedy_to_tilt():
    rng = np.random.default_rng(13)
    rig = RIGS["fan"]()
    poses = Pose.from_ypr(rng.uniform(-1, 1, (40, 3)) * np.deg2rad([25, 0.5, 0.5]), np.zeros((40, 3)))
    found = calibrate_beams(rig, recorded(rng, rig, poses), unknown_place(poses))
    assert found.undetermined == []
    (weak,) = [f for f in beam_findings(found, rig, [str(k) for k in range(40)]) if "goal" in f.what]
    assert weak.level > Level.PASS
    assert "the whole target relative to the stand" in weak.why
    assert weak.remedy.startswith("add positions turned by 10 deg or more about the stand's x and y")
