"""Planned sigmas against the scatter of pose errors of simulated rigs."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from calibration.budget import (
    BEAM_DIRECTIONS,
    CAMERA_POSES,
    INTRINSICS,
    SCREEN_POSES,
    ExpectedErrors,
    PoseBudget,
    RigErrors,
    along,
    dots_on_screen,
    expected_errors,
    group_of,
    worst_direction,
)
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import fit_pose
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import POSE as POSE_NAMES
from geometry.uncertainty.rig_uncertainty import RigCovariance, RigUncertainty, Sensitivity, perturbed_rig
from tests.geometry.scenes import LENSES, paper_rig

SIGMA_PX = 0.1
POSE = Pose.from_ypr(np.deg2rad([6.0, -4.0, 3.0]), np.array([0.1, -0.05, 0.08]))


def stacked(*poses: Pose) -> Pose:
    return Pose(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses]))


def budget_of(rig: Rig, errors: RigErrors, edge_px: float = 0.0) -> PoseBudget:
    model = SpotModel.of(rig)
    return PoseBudget(model, Sensitivity(rig, model, errors.names), errors, SIGMA_PX, edge_px)


def root(C: np.ndarray) -> np.ndarray:
    """A with A A^T = C, of a covariance that may be singular."""
    values, vectors = np.linalg.eigh(C)
    return vectors * np.sqrt(np.maximum(values, 0))


def solved_error(rig: Rig, errors: RigErrors, delta: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """The pose error (6,) for rig errors delta (p,) and pixel errors noise (n, 2)."""
    model = SpotModel.of(rig)
    true_pixels, _ = SpotModel.of(perturbed_rig(rig, errors.names, delta)).project(POSE)
    spread = RigUncertainty(rig, model, RigCovariance(errors.names, errors.covariance))
    rows = np.arange(len(model))
    covariances = np.broadcast_to(SIGMA_PX**2 * np.eye(2), (len(model), 2, 2))
    fit = fit_pose(model, rows, true_pixels + noise, covariances, POSE, calibration=spread)
    return POSE.minus(fit.world_from_body)


def squared_sigmas(errors: np.ndarray, covariance: np.ndarray) -> tuple[float, int]:
    """The sum of squares (N, 6) in sigmas over the range of the covariance, and its rank."""
    size = np.sqrt(np.diagonal(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    real = values > 1e-9 * values[-1]
    along_axes = (errors / size) @ vectors[:, real]
    return float(np.sum(along_axes**2 / values[real])), len(errors) * int(real.sum())


def assert_in_band(total: float, count: int) -> None:
    """Within the 99.9 % band of the chi-square."""
    lo, hi = chi2.ppf([0.0005, 0.9995], count)
    assert lo < total < hi, f"{total / count:.3f} per direction, allowed {lo / count:.3f} to {hi / count:.3f}"


@pytest.fixture(scope="module")
def rig() -> Rig:
    return paper_rig(LENSES[5])


@pytest.fixture(scope="module")
def errors(rig) -> RigErrors:
    return expected_errors(rig, ExpectedErrors())[0]


def scatter(rig, errors, C, noise_px, count, seed):
    """Pose errors (count, 6) for rig errors with covariance C (p, p) and pixel noise noise_px."""
    rng = np.random.default_rng(seed)
    A, views = root(C), len(SpotModel.of(rig))
    return np.array(
        [
            solved_error(rig, errors, A @ rng.normal(size=len(C)), noise_px * rng.normal(size=(views, 2)))
            for _ in range(count)
        ]
    )


def test_pose_errors_of_random_rigs_agree_with_the_plan(rig, errors):
    planned = budget_of(rig, errors).of(stacked(POSE))
    found = scatter(rig, errors, errors.covariance, SIGMA_PX, 150, seed=1)
    assert_in_band(*squared_sigmas(found, planned.total[0]))


def test_pose_errors_from_noise_alone_agree_with_the_noise_part(rig, errors):
    planned = budget_of(rig, errors).of(stacked(POSE))
    found = scatter(rig, errors, np.zeros_like(errors.covariance), SIGMA_PX, 120, seed=2)
    assert_in_band(*squared_sigmas(found, planned.noise[0]))


@pytest.mark.parametrize("group", [INTRINSICS, CAMERA_POSES, SCREEN_POSES, BEAM_DIRECTIONS])
def test_pose_errors_from_one_group_agree_with_its_part(group, rig, errors):
    planned = budget_of(rig, errors).of(stacked(POSE))
    found = scatter(rig, errors, errors.groups[group], 0.0, 60, seed=3)
    assert_in_band(*squared_sigmas(found, planned.groups[0, list(errors.groups).index(group)]))


def test_effects_agree_with_complete_solutions(rig, errors):
    """The effects are linear; second-order terms of a sigma are about 1e-3 of it."""
    planned = budget_of(rig, errors).of(stacked(POSE))
    for i, name in enumerate(errors.move_names):
        if i % 4 == 0 and errors.move_sigmas[i] > 0:
            found = solved_error(rig, errors, errors.moves[:, i], np.zeros((6, 2)))
            size = np.abs(planned.effects[0]).max(axis=1)  # of the largest effect on each axis
            # The true rig differs by the move; the pose error has the opposite sign: estimate = truth + G S (-move).
            np.testing.assert_allclose(found, -planned.effects[0, :, i], atol=0.01 * size.max(), err_msg=name)


def test_the_parts_sum_to_the_total(rig, errors):
    poses = stacked(POSE, Pose.identity())
    b = budget_of(rig, errors).of(poses)
    np.testing.assert_allclose(b.noise + b.groups.sum(axis=1), b.total, rtol=1e-7, atol=1e-18)


def test_covariance_between_groups_is_in_the_total_only(rig):
    """A lens error that is compensated by an error of the camera's pose, as stated in the rig file."""
    names = ("cameras.left.cx", "cameras.left.rot_y_rad")
    C = np.array([[0.09, 0.99 * 0.3 * 2.5e-4], [0.99 * 0.3 * 2.5e-4, 2.5e-4**2]])
    stated = RigCovariance(names, C)
    errors, sources = expected_errors(rig, ExpectedErrors(), stated, whole=True)
    assert sources == {INTRINSICS: "rig file", CAMERA_POSES: "rig file"}
    b = budget_of(rig, errors).of(stacked(POSE))
    alone = b.noise + b.groups.sum(axis=1)
    assert not np.allclose(alone, b.total, rtol=0.01)
    found = scatter(rig, errors, errors.covariance, SIGMA_PX, 100, seed=4)
    assert_in_band(*squared_sigmas(found, b.total[0]))


def test_a_pose_is_observable_if_the_solver_reports_it(rig, errors):
    rng = np.random.default_rng(5)
    model = SpotModel.of(rig)
    poses = Pose.from_ypr(np.deg2rad(rng.uniform(-70, 70, (120, 3))), rng.uniform(-1.2, 1.2, (120, 3)))
    b = budget_of(rig, errors).of(poses)
    assert 10 < b.observable.sum() < 110
    for i in range(len(poses.translation)):
        rows = np.flatnonzero(b.seen[i])
        covariances = np.broadcast_to(SIGMA_PX**2 * np.eye(2), (len(rows), 2, 2))
        fit = fit_pose(model, rows, b.pixels[i][rows], covariances, poses[i]) if len(rows) else None
        assert b.observable[i] == (fit is not None and fit.observable)
        assert np.isfinite(b.total[i]).all() == b.observable[i]
        assert np.isfinite(b.condition[i]) == b.observable[i]


def test_the_plan_agrees_with_the_covariance_of_the_solver(rig, errors):
    """Also if some spots are out of the picture, which must not contribute."""
    rng = np.random.default_rng(7)
    model = SpotModel.of(rig)
    poses = Pose.from_ypr(np.deg2rad(rng.uniform(-25, 25, (30, 3))), rng.uniform(-0.5, 0.5, (30, 3)))
    b = budget_of(rig, errors).of(poses)
    partly = [i for i in range(30) if b.observable[i] and not b.seen[i].all() and b.condition[i] < 30]
    assert len(partly) >= 5
    for i in partly:
        rows = np.flatnonzero(b.seen[i])
        covariances = np.broadcast_to(SIGMA_PX**2 * np.eye(2), (len(rows), 2, 2))
        spread = RigUncertainty(rig, model, RigCovariance(errors.names, errors.covariance))
        fit = fit_pose(model, rows, b.pixels[i][rows], covariances, poses[i], calibration=spread)
        np.testing.assert_allclose(b.total[i], fit.covariance, rtol=1e-4, atol=1e-4 * np.abs(fit.covariance).max())
        np.testing.assert_allclose(
            b.groups[i].sum(axis=0), fit.systematic, rtol=1e-3, atol=1e-4 * np.abs(fit.covariance).max()
        )


def test_a_spot_near_the_edge_is_not_visible(rig, errors):
    wide, near = (budget_of(rig, errors, edge).of(stacked(Pose.identity())) for edge in (0.0, 250.0))
    gap = np.min(np.minimum(wide.pixels + 0.5, SpotModel.of(rig).image_size_px - 0.5 - wide.pixels), axis=-1)
    assert wide.seen.all()
    np.testing.assert_array_equal(near.seen, gap >= 250)
    assert not near.seen.all()


def test_the_worst_direction_is_that_of_the_largest_variance():
    rng = np.random.default_rng(6)
    C = np.array([np.cov(rng.normal(size=(3, 9))) for _ in range(5)])
    sigma, direction = worst_direction(C)
    np.testing.assert_allclose(along(C, direction), sigma**2)
    others = rng.normal(size=(200, 3))
    others /= np.linalg.norm(others, axis=1, keepdims=True)
    assert np.all(np.einsum("ni,kij,nj->kn", others, C, others) <= sigma[:, None] ** 2 * (1 + 1e-12))
    nothing = worst_direction(np.full((1, 3, 3), np.nan))
    assert np.isnan(nothing[0]).all()
    assert np.isnan(nothing[1]).all()


# Expected errors --------------------------------------------------------------------------------------------------


def test_the_pose_error_from_a_lens_error_agrees_with_opencvs_resection(rig):
    """Independent check: dots projected with the true lens, cv2.solvePnP with the wrong one."""
    expected = ExpectedErrors(dot_survey_m=0.0)  # all dots have the same weight, as in solvePnP
    errors, _ = expected_errors(rig, expected)
    camera = rig.cameras["left"]
    dots = dots_on_screen(camera, rig.screens["left"], expected)
    pixels = camera.project(dots)
    for lens in ("fx", "cy", "k1", "p2"):
        move = errors.moves[:, errors.names.index(f"cameras.left.{lens}")]
        wrong = perturbed_rig(
            rig, errors.names, np.where([".left." in n and group_of(n) == INTRINSICS for n in errors.names], move, 0)
        )
        rvec = Rotation.from_matrix(camera.camera_from_world.rotation).as_rotvec()
        _, rvec, tvec = cv2.solvePnP(
            dots, pixels, wrong.cameras["left"].matrix, np.array(wrong.cameras["left"].distortion),
            rvec.copy(), camera.camera_from_world.translation.copy(), True, cv2.SOLVEPNP_ITERATIVE,
        )  # fmt: skip
        found = Pose(Rotation.from_rotvec(rvec.ravel()).as_matrix(), tvec.ravel()).minus(camera.camera_from_world)
        planned = np.array([move[errors.names.index(f"cameras.left.{n}")] for n in POSE_NAMES])
        assert np.abs(found).max() > 1e-6
        np.testing.assert_allclose(found, planned, atol=0.02 * np.abs(found).max(), err_msg=lens)


def test_a_camera_without_dots_has_the_approximate_pose(rig):
    small = {n: replace(s, size_m=(0.05, 0.05)) for n, s in rig.screens.items()}
    errors, _ = expected_errors(replace(rig, screens=small), ExpectedErrors())
    sigma = errors.move_sigmas[errors.names.index("cameras.left.x_m")]
    assert sigma == pytest.approx(ExpectedErrors().camera_position_m)


def test_all_distortion_coefficients_together_displace_the_corner_by_the_stated_sigma(rig):
    camera = rig.cameras["left"]
    errors, _ = expected_errors(rig, ExpectedErrors(distortion_px=0.2))
    names = [f"cameras.left.{n}" for n in ("k1", "k2", "p1", "p2", "k3")]
    _, rays = camera.rays(np.array([[-0.5, -0.5]]))
    points = camera.camera_from_world.inverse().translation + 3 * rays
    squares = 0.0
    for name in names:
        delta = np.where(np.array(errors.names) == name, errors.move_sigmas, 0.0)
        there = perturbed_rig(rig, errors.names, delta).cameras["left"].project(points)
        squares += float(np.sum((there - camera.project(points)) ** 2))
    assert np.sqrt(squares) == pytest.approx(0.2, rel=0.1)  # each is scaled at its own worst corner


def test_stated_groups_replace_assumed_ones(rig):
    names = tuple(f"beams.{b}.direction_{a}" for b in "ABC" for a in "xyz")
    stated = RigCovariance(names, 1e-10 * np.eye(9))
    errors, sources = expected_errors(rig, ExpectedErrors(), stated)
    assert sources[BEAM_DIRECTIONS] == "rig file"
    assert sources[INTRINSICS] == sources[CAMERA_POSES] == "assumed"
    place = [errors.names.index(n) for n in names]
    np.testing.assert_array_equal(errors.covariance[np.ix_(place, place)], stated.matrix)
    whole, sources = expected_errors(rig, ExpectedErrors(), stated, whole=True)
    assert set(sources) == {BEAM_DIRECTIONS}
    assert np.count_nonzero(whole.covariance) == 9


def test_a_beam_has_no_error_along_itself(rig):
    errors, _ = expected_errors(rig, ExpectedErrors())
    for name, beam in rig.beams.items():
        for kind in ("direction_", "point_"):
            place = [errors.names.index(f"beams.{name}.{kind}{a}{'_m' if kind == 'point_' else ''}") for a in "xyz"]
            C = errors.covariance[np.ix_(place, place)]
            assert beam.direction @ C @ beam.direction == pytest.approx(0, abs=1e-12 * np.trace(C))
            assert np.linalg.matrix_rank(C / np.trace(C), tol=1e-9) == 2
