"""The pose solver with the covariance of a calibration: noise part, systematic part, covariances of the spots."""

from __future__ import annotations

import numpy as np

from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import PoseFit, fit_pose
from geometry.uncertainty.rig_uncertainty import RigCovariance, RigUncertainty, perturbed_rig, rig_names
from tests.geometry.scenes import LENSES, paper_rig

RIG = paper_rig(LENSES[5])
MODEL = SpotModel.of(RIG)
POSE = Pose.from_ypr(np.array([0.05, -0.03, 0.04]), np.array([0.1, 0.05, -0.08]))
NAMES = rig_names(RIG)
SIGMAS = np.array(
    [3e-4 if n.endswith(("_m", "_rad")) else 1e-4 if "direction" in n or ".k" in n else 0.3 for n in NAMES]
)
SIGMAS[[i for i, n in enumerate(NAMES) if ".p1" in n or ".p2" in n]] = 1e-5
COVARIANCE = RigCovariance(NAMES, np.diag(SIGMAS**2))
SPREAD = RigUncertainty(RIG, MODEL, COVARIANCE)
NOISE_PX = 0.05


def drawn_fit(rng: np.random.Generator, rows: np.ndarray) -> tuple[PoseFit, np.ndarray]:
    """A fit to noisy spots of a rig with randomly drawn errors, and the true pixels of all views."""
    true = SpotModel.of(perturbed_rig(RIG, NAMES, SIGMAS * rng.normal(size=len(SIGMAS)))).project(POSE)[0]
    uv = true[rows] + NOISE_PX * rng.normal(size=(len(rows), 2))
    C = np.tile(NOISE_PX**2 * np.eye(2), (len(rows), 1, 1))
    fit = fit_pose(MODEL, rows, uv, C, POSE, calibration=SPREAD)
    assert fit is not None
    return fit, true


def test_noise_and_systematic_part_are_covariances_that_sum_to_the_whole():
    fit, _ = drawn_fit(np.random.default_rng(0), np.arange(6))
    np.testing.assert_allclose(fit.noise + fit.systematic, fit.covariance, rtol=1e-12)
    for part in (fit.noise, fit.systematic):
        assert np.linalg.eigvalsh(part)[0] > -1e-15
    assert 0.5 < fit.systematic_share < 1.0  # 0.3 px of the principal points against 0.05 px of noise


def test_a_perfect_calibration_gives_the_plain_solution():
    none = RigUncertainty(RIG, MODEL, RigCovariance(NAMES, np.zeros((len(NAMES), len(NAMES)))))
    uv = MODEL.project(POSE)[0] + np.random.default_rng(1).normal(0, NOISE_PX, (6, 2))
    C = np.tile(NOISE_PX**2 * np.eye(2), (6, 1, 1))
    plain, weighed = (fit_pose(MODEL, np.arange(6), uv, C, POSE, calibration=c) for c in (None, none))
    np.testing.assert_allclose(weighed.world_from_body.minus(plain.world_from_body), 0, atol=1e-12)
    np.testing.assert_allclose(weighed.covariance, plain.covariance, rtol=1e-9, atol=1e-20)
    np.testing.assert_allclose(weighed.spot_covariances(), plain.spot_covariances(), rtol=1e-9, atol=1e-18)
    assert np.all(plain.systematic == 0)
    np.testing.assert_allclose(weighed.systematic, 0, atol=1e-20)


def test_poses_from_wrongly_calibrated_rigs_scatter_as_the_covariance_predicts():
    rng = np.random.default_rng(2)
    nees, chi2 = [], []
    for _ in range(300):
        fit, _ = drawn_fit(rng, np.arange(6))
        delta = POSE.minus(fit.world_from_body)
        nees.append(delta @ np.linalg.solve(fit.covariance, delta))
        chi2.append(fit.chi2)
    # 300 draws of chi-square with six degrees of freedom: the means scatter by 0.2.
    assert abs(np.mean(nees) - 6) < 0.6
    assert abs(np.mean(chi2) - 6) < 0.6


def test_frames_of_one_rig_scatter_as_the_noise_part_predicts():
    rng = np.random.default_rng(3)
    off = SpotModel.of(perturbed_rig(RIG, NAMES, SIGMAS * rng.normal(size=len(SIGMAS))))
    C = np.tile(NOISE_PX**2 * np.eye(2), (6, 1, 1))
    poses = []
    for _ in range(400):
        uv = off.project(POSE)[0] + NOISE_PX * rng.normal(size=(6, 2))
        fit = fit_pose(MODEL, np.arange(6), uv, C, POSE, calibration=SPREAD)
        poses.append(fit.world_from_body.minus(POSE))
    seen = np.cov(np.transpose(poses))
    ratio = np.diagonal(seen) / np.diagonal(fit.noise)
    np.testing.assert_allclose(ratio, 1.0, atol=0.25)  # 400 draws: variances scatter by 7 %
    assert np.all(np.diagonal(fit.systematic) > 3 * np.diagonal(fit.noise))


def test_an_unused_spot_scatters_as_its_covariance_predicts():
    rng = np.random.default_rng(4)
    rows, hidden = np.array([0, 1, 3, 4, 5]), 2
    squares = []
    for _ in range(300):
        fit, true = drawn_fit(rng, rows)
        gap = true[hidden] - fit.projected_px[hidden]
        squares.append(gap @ np.linalg.solve(fit.spot_covariances()[hidden], gap))
    assert abs(np.mean(squares) - 2) < 0.35  # chi-square of two: the mean of 300 scatters by 0.12


def test_a_fit_from_a_far_start_uses_the_covariance_at_its_solution():
    rows = np.arange(6)
    uv = MODEL.project(POSE)[0]
    C = np.tile(NOISE_PX**2 * np.eye(2), (6, 1, 1))
    near = fit_pose(MODEL, rows, uv, C, POSE, calibration=SPREAD)
    far = fit_pose(MODEL, rows, uv, C, POSE.plus(np.full(6, 0.1)), calibration=SPREAD)
    np.testing.assert_allclose(far.covariance, near.covariance, rtol=1e-4, atol=1e-12)


def test_widened_scales_all_covariances():
    fit, _ = drawn_fit(np.random.default_rng(5), np.arange(6))
    wide = fit.widened(4.0)
    np.testing.assert_allclose(wide.covariance, 4 * fit.covariance)
    np.testing.assert_allclose(wide.noise, 4 * fit.noise, rtol=1e-9)
