"""The pose from labelled spots: exact for exact pixels, correct covariances, no pose where spots determine none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geometry import rotations
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import (
    SolveLimits,
    covariance_of,
    fit_pose,
    fit_pose_robust,
    is_measurement,
    pixel_covariance,
    whiten,
)
from geometry.rig import Beam, Rig
from tests.geometry.scenes import LENSES, paper_rig, random_pose, random_rig

NOISE_PX = 0.1


def skew_rig() -> Rig:
    """The paper's rig with beams that neither meet nor lie in one plane."""
    rig = paper_rig(LENSES[5])
    points = {"A": [0.0, 0.05, 0.1], "B": [0.05, 0.0, -0.1], "C": [-0.05, 0.1, 0.0]}
    up = {"A": 0.1, "B": -0.05, "C": 0.0}
    beams = {n: Beam(n, b.direction + np.array([0, 0, up[n]]), np.array(points[n])) for n, b in rig.beams.items()}
    return replace(rig, beams=beams)


RIGS = {"fan": paper_rig(LENSES[5]), "skew": skew_rig()}
MODELS = {name: SpotModel.of(rig) for name, rig in RIGS.items()}


def isotropic(count: int, sigma_px: float = NOISE_PX) -> np.ndarray:
    """Covariances (count, 2, 2), px^2."""
    return np.tile(sigma_px**2 * np.eye(2), (count, 1, 1))


def oblique(rng: np.random.Generator, count: int) -> np.ndarray:
    """Covariances (count, 2, 2), px^2, of ellipses of any direction, 0.05 to 0.4 px long."""
    axes = rng.uniform(0.05, 0.4, (count, 2))
    a = rng.uniform(0, np.pi, count)
    R = np.moveaxis(np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]), -1, 0)
    return R * axes[:, None, :] ** 2 @ np.swapaxes(R, -1, -2)


def seen_pose(model: SpotModel, rng: np.random.Generator, turn_deg: float = 30.0, shift_m: float = 1.0) -> Pose:
    """A pose at which all spots have a pixel."""
    while True:
        pose = random_pose(rng, shift_m, np.deg2rad(turn_deg))
        if np.isfinite(model.project(pose)[0]).all():
            return pose


def row_of(model: SpotModel, *spots: str) -> np.ndarray:
    names = [s for _, s in model.views]
    return np.array([names.index(s) for s in spots])


# -- exact pixels -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", RIGS)
def test_exact_pixels_give_the_exact_pose_from_a_start_30_degrees_off(name):
    model, rng = MODELS[name], np.random.default_rng(1)
    rows, solved = np.arange(len(model)), 0
    for _ in range(100):
        pose = seen_pose(model, rng, turn_deg=10, shift_m=0.3)
        axis = rng.normal(size=3)
        away = np.concatenate([rng.uniform(-0.3, 0.3, 3), np.deg2rad(30) * axis / np.linalg.norm(axis)])
        start = pose.plus(away)
        if np.isnan(model.project(start)[0]).any():
            continue  # a spot has no projection at this start, which the docstring excludes
        solved += 1
        fit = fit_pose(model, rows, model.project(pose)[0], isotropic(len(rows)), start)
        assert fit is not None
        assert np.abs(fit.world_from_body.minus(pose)).max() < 1e-9
        assert fit.rms_px < 1e-9
    assert solved > 90


def test_any_rig_with_tilted_screens_and_skew_beams_is_solved():
    rng = np.random.default_rng(2)
    for _ in range(10):
        model = SpotModel.of(random_rig(rng))
        pose = random_pose(rng, 0.1, 0.1)
        uv = model.project(pose)[0]
        rows = np.flatnonzero(np.isfinite(uv[:, 0]))
        if len(rows) < 5:
            continue
        fit = fit_pose(model, rows, uv[rows], isotropic(len(rows)), pose.plus(rng.normal(0, 0.05, 6)))
        assert fit is not None
        assert np.abs(fit.world_from_body.minus(pose)).max() < 1e-9


@pytest.mark.parametrize("spots", ["1245", "1346", "2356"])
def test_two_beams_seen_at_both_ends_suffice(spots):
    rng = np.random.default_rng(3)
    for name in RIGS:
        model = MODELS[name]
        rows = row_of(model, *spots)
        pose = seen_pose(model, rng)
        fit = fit_pose(model, rows, model.project(pose)[0][rows], isotropic(4), pose.plus(rng.normal(0, 0.05, 6)))
        assert fit is not None
        assert is_measurement(fit, SolveLimits())
        assert fit.dof == 2
        assert np.abs(fit.world_from_body.minus(pose)).max() < 1e-9


# -- observability -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spots", ["123", "456"])
def test_three_spots_of_one_screen_do_not_determine_a_pose(spots):
    """They are collinear in every pose, so that a turn of the vehicle about their line is not observable."""
    model, rng = MODELS["fan"], np.random.default_rng(4)
    rows = row_of(model, *spots)
    for _ in range(50):
        pose = seen_pose(model, rng)
        fit = fit_pose(model, rows, model.project(pose)[0][rows], isotropic(3), pose)
        assert fit is not None
        assert not fit.observable
        assert np.isinf(fit.covariance).all()
        assert not is_measurement(fit, SolveLimits())


def test_three_noisy_spots_of_one_screen_do_not_determine_a_pose():
    model, rng = MODELS["fan"], np.random.default_rng(5)
    rows = row_of(model, "1", "2", "3")
    for _ in range(50):
        pose = seen_pose(model, rng)
        uv = model.project(pose)[0][rows] + rng.normal(0, NOISE_PX, (3, 2))
        fit = fit_pose(model, rows, uv, isotropic(3), pose)
        assert fit is None or not is_measurement(fit, SolveLimits())


@pytest.mark.parametrize("count", [1, 2])
def test_one_or_two_spots_do_not_determine_a_pose(count):
    model = MODELS["skew"]
    uv = model.project(Pose.identity())[0]
    fit = fit_pose(model, np.arange(count), uv[:count], isotropic(count), Pose.identity())
    assert fit is not None
    assert not fit.observable


def test_without_spots_there_is_no_fit():
    assert (
        fit_pose(MODELS["fan"], np.zeros(0, dtype=int), np.zeros((0, 2)), np.zeros((0, 2, 2)), Pose.identity()) is None
    )


def test_from_a_start_at_which_a_beam_misses_its_screen_there_is_no_fit():
    model = MODELS["fan"]
    rows = np.arange(len(model))
    backwards = Pose.from_ypr(np.array([np.pi / 2, 0, 0]), np.zeros(3))
    assert fit_pose(model, rows, model.project(Pose.identity())[0], isotropic(6), backwards) is None


def test_three_spots_of_skew_beams_on_two_screens_determine_a_pose_without_redundancy():
    model, rng = MODELS["skew"], np.random.default_rng(6)
    rows = row_of(model, "1", "2", "6")
    pose = seen_pose(model, rng, turn_deg=10)
    fit = fit_pose(model, rows, model.project(pose)[0][rows], isotropic(3), pose)
    assert fit is not None
    assert fit.observable
    assert fit.dof == 0
    assert fit.consistent(0.5)  # no redundancy


def test_a_vague_pose_is_not_a_measurement():
    model = MODELS["fan"]
    fit = fit_pose(model, np.arange(6), model.project(Pose.identity())[0], isotropic(6), Pose.identity())
    assert fit is not None
    sigma_m = np.sqrt(np.linalg.eigvalsh(fit.covariance[:3, :3])[-1])
    sigma_rad = np.sqrt(np.linalg.eigvalsh(fit.covariance[3:, 3:])[-1])
    assert is_measurement(fit, SolveLimits(1.01 * sigma_m, 1.01 * sigma_rad))
    assert not is_measurement(fit, SolveLimits(0.99 * sigma_m, 1.01 * sigma_rad))
    assert not is_measurement(fit, SolveLimits(1.01 * sigma_m, 0.99 * sigma_rad))


# -- covariance -------------------------------------------------------------------------------------------------------


def monte_carlo(model: SpotModel, count: int, seed: int) -> tuple[float, float]:
    """RMS of pose errors over the Cramer-Rao bound, pooled over the six coordinates, and the mean NEES."""
    rng = np.random.default_rng(seed)
    rows = np.arange(len(model))
    ratio2, nees = [], []
    for _ in range(count):
        pose = seen_pose(model, rng)
        uv, J = model.project(pose)
        C = oblique(rng, len(rows))
        noisy = uv + (np.linalg.cholesky(C) @ rng.normal(size=(len(rows), 2, 1)))[..., 0]
        fit = fit_pose(model, rows, noisy, C, pose.plus(rng.normal(0, 0.02, 6)))
        assert fit is not None
        # The error of the file contract: t_true = t_est + dt, R_true = R_est Exp(dtheta).
        error = pose.minus(fit.world_from_body)
        bound = np.linalg.inv(sum(J[i].T @ np.linalg.inv(C[i]) @ J[i] for i in rows))
        ratio2.append(error**2 / np.diagonal(bound))
        nees.append(error @ np.linalg.solve(fit.covariance, error))
    return float(np.sqrt(np.mean(ratio2))), float(np.mean(nees))


@pytest.mark.parametrize("name", RIGS)
def test_errors_reach_the_cramer_rao_bound_and_agree_with_the_covariance(name):
    """300 poses: the ratio scatters by 0.03 about 1 and the mean NEES by 0.2 about 6."""
    ratio, nees = monte_carlo(MODELS[name], 300, seed=9)
    assert ratio < 1.05
    assert 5.5 < nees < 6.5


@pytest.mark.slow
@pytest.mark.parametrize("name", RIGS)
def test_errors_reach_the_cramer_rao_bound_over_2000_poses(name):
    """The ratio scatters by 0.011, the mean NEES by 0.08."""
    ratio, nees = monte_carlo(MODELS[name], 2000, seed=10)
    assert 0.97 < ratio < 1.04
    assert 5.75 < nees < 6.25


def test_twice_the_noise_is_four_times_the_covariance_and_the_same_pose():
    model, rng = MODELS["skew"], np.random.default_rng(11)
    rows = np.arange(6)
    C = oblique(rng, 6)
    uv = model.project(Pose.identity())[0] + rng.normal(0, NOISE_PX, (6, 2))
    one, two = (fit_pose(model, rows, uv, scale * C, Pose.identity()) for scale in (1.0, 4.0))
    assert one is not None
    assert two is not None
    assert np.abs(two.world_from_body.minus(one.world_from_body)).max() < 1e-8
    np.testing.assert_allclose(two.covariance, 4 * one.covariance, rtol=1e-6)
    assert two.chi2 == pytest.approx(one.chi2 / 4, rel=1e-6)


def test_the_mean_chi_square_equals_the_degrees_of_freedom():
    """The mean chi2 of correct fits is dof = 2 m - 6; that of 300 fits of dof 6 has a standard deviation of 0.2."""
    model, rng = MODELS["fan"], np.random.default_rng(12)
    rows = np.arange(6)
    fits = []
    for _ in range(300):
        C = oblique(rng, 6)
        noise = (np.linalg.cholesky(C) @ rng.normal(size=(6, 2, 1)))[..., 0]
        fits.append(fit_pose(model, rows, model.project(Pose.identity())[0] + noise, C, Pose.identity()))
    assert {f.dof for f in fits} == {6}
    assert np.mean([f.chi2 for f in fits]) == pytest.approx(6, abs=0.5)
    assert np.mean([f.consistent(0.1) for f in fits]) == pytest.approx(0.9, abs=0.06)


def test_whitened_noise_has_unit_covariance():
    C = oblique(np.random.default_rng(13), 100)
    W = whiten(C)
    np.testing.assert_allclose(W @ C @ np.swapaxes(W, -1, -2), np.tile(np.eye(2), (100, 1, 1)), atol=1e-9)


def test_rank_is_judged_by_the_worst_direction():
    H = np.diag([1.0, 2, 3, 4, 5, 1e6])
    covariance, observable = covariance_of(H)
    assert observable
    np.testing.assert_allclose(covariance, np.linalg.inv(H))
    H[0, 0] = 1e-9
    assert not covariance_of(H)[1]


def test_the_covariance_of_a_pixel_equals_the_scatter_of_projected_poses():
    model, rng = MODELS["skew"], np.random.default_rng(14)
    covariance = np.diag([1, 2, 3, 0.5, 0.7, 0.9]) * 1e-8
    errors = rng.normal(size=(4000, 6)) * np.sqrt(np.diagonal(covariance))
    uv, J = model.project(Pose.identity())
    many = Pose(rotations.exp(errors[:, 3:]), errors[:, :3])
    scatter = model.project(many)[0] - uv
    sampled = np.einsum("tni,tnj->nij", scatter, scatter) / len(errors)
    claimed = pixel_covariance(J, covariance)
    # 4000 samples: 2.2 % of each variance, 1 sigma
    np.testing.assert_allclose(sampled, claimed, atol=0.1 * claimed.max())


# -- wrong spots ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("wrong", range(6))
@pytest.mark.parametrize("off_px", [8.0, 60.0])
def test_any_one_wrong_spot_of_six_is_left_out(name, wrong, off_px):
    model, rng = MODELS[name], np.random.default_rng(15)
    rows = np.arange(6)
    for _ in range(5):
        pose = seen_pose(model, rng, turn_deg=20, shift_m=0.5)
        uv = model.project(pose)[0] + rng.normal(0, NOISE_PX, (6, 2))
        away = rng.normal(size=2)
        uv[wrong] += off_px * away / np.linalg.norm(away)
        fit = fit_pose_robust(model, rows, uv, isotropic(6), pose.plus(rng.normal(0, 0.02, 6)))
        assert fit is not None
        assert list(fit.rows) == [r for r in rows if r != wrong]
        assert np.all(np.abs(fit.world_from_body.minus(pose)) < 6 * np.sqrt(np.diagonal(fit.covariance)))


@pytest.mark.parametrize("name", RIGS)
def test_right_spots_are_all_kept(name):
    model, rng = MODELS[name], np.random.default_rng(16)
    for _ in range(100):
        pose = seen_pose(model, rng)
        uv = model.project(pose)[0] + rng.normal(0, NOISE_PX, (6, 2))
        fit = fit_pose_robust(model, np.arange(6), uv, isotropic(6), pose)
        assert fit is not None
        assert list(fit.rows) == list(range(6))


@pytest.mark.parametrize("name", RIGS)
def test_two_wrong_spots_of_six_are_left_out_or_there_is_no_pose(name):
    """Four of six spots often fit wrong labels too; a wrong pose with small sigmas must not be returned."""
    model, rng = MODELS[name], np.random.default_rng(17)
    right = wrong = 0
    for _ in range(60):
        pose = seen_pose(model, rng, turn_deg=20, shift_m=0.5)
        uv = model.project(pose)[0] + rng.normal(0, NOISE_PX, (6, 2))
        bad = rng.choice(6, 2, replace=False)
        uv[bad] += rng.uniform(8, 60, (2, 1)) * (lambda a: np.column_stack([np.cos(a), np.sin(a)]))(
            rng.uniform(0, 2 * np.pi, 2)
        )
        expected = pose.plus(rng.normal(0, 0.003, 6)), 0.003**2 * np.eye(6)
        fit = fit_pose_robust(model, np.arange(6), uv, isotropic(6), pose, expected=expected)
        if fit is not None:
            good = set(fit.rows).isdisjoint(bad)
            right, wrong = right + good, wrong + (not good)
    assert wrong == 0
    assert right > 40


def test_one_wrong_spot_of_five_is_left_out_only_if_the_choice_is_clear():
    """With an error of 0.5 to 3 px two choices are often possible. Without the required lead, 8 % are wrong."""
    model, rng = MODELS["skew"], np.random.default_rng(21)
    rows = row_of(model, "1", "2", "4", "5", "6")
    right = wrong = 0
    for _ in range(200):
        pose = seen_pose(model, rng, turn_deg=20, shift_m=0.5)
        uv = model.project(pose)[0][rows] + rng.normal(0, NOISE_PX, (5, 2))
        bad, angle = rng.integers(5), rng.uniform(0, 2 * np.pi)
        uv[bad] += rng.uniform(0.5, 3) * np.array([np.cos(angle), np.sin(angle)])
        fit = fit_pose_robust(model, rows, uv, isotropic(5), pose)
        if fit is not None and len(fit.rows) == 4:
            good = rows[bad] not in fit.rows
            right, wrong = right + good, wrong + (not good)
    assert right > 80
    assert wrong <= 4


@pytest.mark.parametrize("wrong", range(4))
def test_a_wrong_one_of_four_spots_without_an_expected_pose_gives_no_pose(wrong):
    """Any three of them fit, so that the wrong one cannot be identified."""
    model, rng = MODELS["skew"], np.random.default_rng(18)
    rows = row_of(model, "1", "2", "4", "5")
    pose = seen_pose(model, rng, turn_deg=10)
    uv = model.project(pose)[0][rows] + rng.normal(0, NOISE_PX, (4, 2))
    uv[wrong] += [9.0, -11.0]
    assert fit_pose_robust(model, rows, uv, isotropic(4), pose) is None


@pytest.mark.parametrize("wrong", range(4))
def test_with_an_expected_pose_the_wrong_one_of_four_spots_is_left_out(wrong):
    model, rng = MODELS["skew"], np.random.default_rng(19)
    rows = row_of(model, "1", "2", "4", "5")
    found = 0
    for _ in range(10):
        pose = seen_pose(model, rng, turn_deg=10)
        uv = model.project(pose)[0][rows] + rng.normal(0, NOISE_PX, (4, 2))
        uv[wrong] += [19.0, -21.0]
        expected = pose.plus(rng.normal(0, 1e-3, 6)), 1e-6 * np.eye(6)
        fit = fit_pose_robust(model, rows, uv, isotropic(4), pose, expected=expected)
        if fit is not None:
            assert list(fit.rows) == [r for i, r in enumerate(rows) if i != wrong]
            found += 1
    assert found >= 8


def test_an_expected_pose_far_from_all_choices_is_not_used():
    """During a manoeuvre the predicted pose does not help to choose."""
    model, rng = MODELS["skew"], np.random.default_rng(20)
    rows = row_of(model, "1", "2", "4", "5")
    uv = model.project(Pose.identity())[0][rows] + rng.normal(0, NOISE_PX, (4, 2))
    uv[0] += [19.0, -21.0]
    elsewhere = Pose.identity().plus(np.array([0.5, 0.2, 0, 0.2, 0, 0.3])), 1e-6 * np.eye(6)
    assert fit_pose_robust(model, rows, uv, isotropic(4), Pose.identity(), expected=elsewhere) is None


def test_residuals_below_the_smallest_outlier_are_accepted_as_model_error():
    """Sigmas of 0.01 px, a calibration error of 0.03 px: the chi-square test fails, but no spot is an outlier."""
    model = MODELS["fan"]
    uv = model.project(Pose.identity())[0]
    uv[2] += [0.03, 0.03]
    fit = fit_pose_robust(model, np.arange(6), uv, isotropic(6, 0.003), Pose.identity())
    assert fit is not None
    assert not fit.consistent(1e-5)
    assert len(fit.rows) == 6


def test_with_a_known_error_scale_the_same_residuals_exclude_no_spot():
    model = MODELS["fan"]
    uv = model.project(Pose.identity())[0]
    uv[2] += [0.7, 0.7]
    strict = fit_pose_robust(model, np.arange(6), uv, isotropic(6), Pose.identity())
    wide = fit_pose_robust(model, np.arange(6), uv, isotropic(6), Pose.identity(), noise_scale=5.0)
    assert strict is None or len(strict.rows) == 5
    assert wide is not None
    assert len(wide.rows) == 6
