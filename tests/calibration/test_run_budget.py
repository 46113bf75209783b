"""Uncertainty budgets of measured poses: sums, expanded uncertainty, and a Monte Carlo without linearisation."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.budget import AXES, group_of
from calibration.run_budget import LINES, along_axes, calibration_share, expanded, monte_carlo
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import fit_pose
from geometry.uncertainty.rig_uncertainty import RigCovariance, perturbed_rig, rig_names
from tests.lab.fake_results import fake_rig

RIG = fake_rig()
MODEL = SpotModel.of(RIG)
POSE = Pose.from_ypr(np.radians([4.0, 3.0, -5.0]), np.array([0.1, -0.05, 0.02]))
ROWS = np.flatnonzero(MODEL.in_picture(MODEL.project(POSE)[0]))
SPOTS = np.tile(0.01 * np.eye(2), (len(ROWS), 1, 1))
SIGMAS = {"fx": 0.5, "fy": 0.5, "cx": 0.5, "cy": 0.5}


def errors(seed: int = 1, correlated: bool = True) -> RigCovariance:
    """Of plausible size: 0.5 px, 0.2 mm, 0.1 mrad; correlated between all parameters, or not."""
    names = rig_names(RIG)
    sigma = np.array([SIGMAS.get(n.rsplit(".", 1)[1], 2e-4 if n.endswith("_m") else 1e-4) for n in names])
    if not correlated:
        return RigCovariance(names, np.diag(sigma**2))
    A = np.random.default_rng(seed).normal(size=(len(names), 2 * len(names)))
    C = A @ A.T
    scale = sigma / np.sqrt(np.diagonal(C))
    return RigCovariance(names, C * np.outer(scale, scale))


def share_of(covariance: RigCovariance, factor: float = 1.0):
    """The share where the run stated `factor` times the covariance that the weights of the spots give."""
    first = calibration_share(RIG, covariance, POSE, ROWS, SPOTS, np.eye(6))
    plain = np.linalg.solve(first.adjusted, first.sensitivity)
    return calibration_share(RIG, covariance, POSE, ROWS, SPOTS, factor * plain @ covariance.matrix @ plain.T)


def test_the_lines_of_a_correlated_calibration_add_up_to_its_share():
    share = share_of(errors(), 1.1)
    parts = share.by_line()
    assert list(parts) == ["lenses", "screens", "cameras", "beams"]
    assert min(np.linalg.eigvalsh(part).min() for part in parts.values()) > -1e-12 * np.trace(share.total)
    np.testing.assert_allclose(sum(parts.values()), share.total, rtol=1e-9, atol=1e-9 * np.abs(share.total).max())


def test_without_correlation_a_line_is_what_its_parameters_do_alone():
    covariance = errors(correlated=False)
    share = share_of(covariance)
    group = np.array([group_of(name) for name in covariance.names])
    for line, groups in LINES.items():
        own = np.isin(group, groups)
        K = share.sensitivity[:, own]
        alone = K @ covariance.matrix[np.ix_(own, own)] @ K.T
        np.testing.assert_allclose(share.by_line()[line], alone, rtol=1e-9, atol=1e-9 * np.abs(alone).max())


@pytest.mark.parametrize("factor", [1.0, 0.8, 1.3])
def test_the_sensitivities_give_the_share_that_the_run_states(factor):
    share = share_of(errors(), factor)
    np.testing.assert_allclose(share.adjusted, np.sqrt(factor) * np.eye(6), atol=1e-6)
    stated = share_of(errors()).total * factor
    np.testing.assert_allclose(share.total, stated, rtol=1e-6, atol=1e-9 * np.abs(stated).max())


@pytest.mark.parametrize(
    "name", ["cameras.left.fx", "cameras.right.rot_x_rad", "screens.left.z_m", "beams.B.direction_y"]
)
def test_a_sensitivity_is_the_change_of_the_pose_that_the_solver_finds(name):
    covariance = errors()
    share = share_of(covariance)
    p = covariance.names.index(name)
    size = 0.1 * np.sqrt(covariance.matrix[p, p])
    pixels = SpotModel.of(perturbed_rig(RIG, [name], np.array([size]))).project(POSE)[0][ROWS]
    fit = fit_pose(MODEL, ROWS, pixels, np.linalg.inv(share.weights), POSE)
    expected = share.sensitivity[:, p] * size
    np.testing.assert_allclose(fit.world_from_body.minus(POSE), expected, rtol=0, atol=0.01 * np.linalg.norm(expected))


def test_effective_degrees_of_freedom_are_those_of_the_guide():
    """JCGM 100:2008, G.4.1, example: 0.25, 0.57 and 0.82 % with 9, 4 and 14 degrees of freedom give 1.03 % and 19."""
    variances = np.repeat(np.square([[0.25], [0.57], [0.82]]), len(AXES), axis=1)
    found = expanded(variances, np.array([9.0, 4.0, 14.0]))
    np.testing.assert_allclose(found.combined, 1.03, atol=0.005)
    np.testing.assert_allclose(found.degrees_of_freedom, 19.0, atol=0.05)
    assert found.factor[0] == pytest.approx(2.14, abs=0.005)  # table G.2, 95.45 %
    assert expanded(variances, np.full(3, np.inf)).factor[0] == pytest.approx(2.0, abs=1e-4)


@pytest.mark.parametrize(("draws", "within"), [(600, 0.12), pytest.param(10_000, 0.02, marks=pytest.mark.slow)])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_monte_carlo_of_rigs_agrees_with_the_budget(draws, within, seed):
    share = share_of(errors(seed), 0.9)
    J = MODEL.project(POSE)[1][ROWS]
    noise = np.linalg.inv(np.einsum("mia,mij,mjb->ab", J, np.linalg.inv(SPOTS), J)) / 9
    u, U = monte_carlo(RIG, share, POSE, noise, np.inf, draws, seed)
    found = expanded(np.stack([along_axes(noise, POSE), along_axes(share.total, POSE)]), np.full(2, np.inf))
    np.testing.assert_allclose(u, found.combined, rtol=within)
    np.testing.assert_allclose(U, found.expanded, rtol=within)
