"""Information of a frame's spots about the pose, against numerical derivatives and the ordinary Kalman filter."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.arrays import Array, Bools, numeric_jacobian
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from lab.simulate.scenarios import RIGS
from tracking.rigid_body.frame_summary import inverse
from tracking.rigid_body.models.information import frame_information, single_frame_pose, well_controlled
from tracking.rigid_body.models.motion import STATE, updated

MODEL = SpotModel.of(RIGS["fan"]())
VIEWS = MODEL.numbers
N = len(MODEL)
ALL = np.ones(N, dtype=bool)


def some(rng: np.random.Generator, noise_px: float = 0.5) -> tuple[Pose, Array, Array]:
    """A pose, noisy pixels (n, 2) seen from it and their covariances (n, 2, 2), all different."""
    pose = Pose.from_ypr(np.deg2rad([7, 0, 0]) + rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.2, 0.2, 3))
    A = rng.normal(size=(N, 2, 3)) * noise_px / np.sqrt(3)
    cov = A @ np.swapaxes(A, 1, 2) + 0.01 * np.eye(2)
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(cov), rng.normal(size=(N, 2)))
    return pose, MODEL.project(pose)[0] + noise, cov


def information(pose: Pose, use: Bools, uv: Array, cov: Array) -> tuple[Array, Array, float, int, float]:
    return frame_information(VIEWS, pose.rotation, pose.translation, use, uv, cov)


def chi2(pose: Pose, use: Bools, uv: Array, cov: Array) -> float:
    y = (uv - MODEL.project(pose)[0])[use]
    return float(np.einsum("ni,ni->", y, np.linalg.solve(cov[use], y[..., None])[..., 0]))


@pytest.mark.parametrize("seed", range(4))
def test_the_vector_is_the_gradient_of_the_chi_square_and_the_matrix_that_of_gauss_newton(seed):
    rng = np.random.default_rng(seed)
    pose, uv, cov = some(rng)
    use = rng.random(N) < 0.8
    L, g, misfit, count, log_det = information(pose, use, uv, cov)
    assert misfit == pytest.approx(chi2(pose, use, uv, cov), rel=1e-10)
    assert count == use.sum()
    assert log_det == pytest.approx(np.linalg.slogdet(2 * np.pi * cov[use])[1].sum(), rel=1e-10)
    gradient = numeric_jacobian(lambda d: np.array(chi2(pose.plus(d), use, uv, cov)), np.zeros(6))
    np.testing.assert_allclose(g, -0.5 * gradient, rtol=1e-5, atol=1e-5 * np.abs(g).max())
    J = numeric_jacobian(lambda d: MODEL.project(pose.plus(d))[0][use], np.zeros(6))
    np.testing.assert_allclose(L, np.einsum("nia,nij,njb->ab", J, np.linalg.inv(cov[use]), J), rtol=1e-5, atol=1.0)


def test_a_spot_without_a_projection_is_left_out():
    pose, uv, cov = some(np.random.default_rng(1))
    away = pose @ Pose.from_ypr(np.array([np.pi, 0.0, 0.0]), np.zeros(3))  # every beam misses its screen
    L, g, misfit, count, _ = information(away, ALL, uv, cov)
    assert (count, misfit) == (0, 0.0)
    assert not L.any()
    assert not g.any()


@pytest.mark.parametrize("spots", [1, 2, 3, N], ids="{} spots".format)
def test_an_update_is_the_ordinary_kalman_update_with_all_pixels_in_one_vector(spots):
    rng = np.random.default_rng(spots)
    pose, uv, cov = some(rng)
    use = np.zeros(N, dtype=bool)
    use[rng.permutation(N)[:spots]] = True  # fewer than three do not give the pose: the matrix lacks rank
    m = rng.normal(size=12)
    A = rng.normal(size=(STATE, 30)) * np.repeat([1e-3, 1e-3, 0.1, 0.1, 1.0, 1.0], 3)[:, None]
    P = A @ A.T / 30
    L, g, misfit, _, _ = information(pose, use, uv, cov)
    R1, t1, m1, P1, log_det, step = updated(pose.rotation, pose.translation, m, P, L, g)

    predicted_uv, J = MODEL.project(pose)
    H = np.zeros((2 * spots, STATE))
    H[:, :6] = J[use].reshape(-1, 6)
    C = np.zeros((spots, 2, spots, 2))
    C[range(spots), :, range(spots), :] = cov[use]
    C = C.reshape(2 * spots, 2 * spots)
    y = (uv - predicted_uv)[use].ravel()
    S = H @ P @ H.T + C
    K = P @ H.T @ np.linalg.inv(S)
    expected, sigma = pose.plus((K @ y)[:6]), np.sqrt(np.diagonal(P))
    np.testing.assert_allclose(Pose(R1, t1).minus(expected) / sigma[:6], 0, atol=1e-9)
    np.testing.assert_allclose((m1 - m - (K @ y)[6:]) / sigma[6:], 0, atol=1e-9)
    I_KH = np.eye(STATE) - K @ H
    joseph = I_KH @ P @ I_KH.T + K @ C @ K.T
    np.testing.assert_allclose((P1 - joseph) / np.outer(sigma, sigma), 0, atol=1e-9)
    assert log_det == pytest.approx(np.linalg.slogdet(S)[1] - np.linalg.slogdet(C)[1], rel=1e-9)
    # The innovation's chi-square, y^T S^-1 y, and the part of it that the motion absorbs.
    assert misfit - g @ step == pytest.approx(y @ np.linalg.solve(S, y), rel=1e-8)
    assert step @ np.linalg.solve(P[:6, :6], step) == pytest.approx(
        y @ np.linalg.solve(S, H @ P @ H.T @ np.linalg.solve(S, y)), rel=1e-8
    )


def test_no_small_step_improves_the_pose_of_a_single_frame():
    rng = np.random.default_rng(5)
    pose, uv, cov = some(rng, noise_px=0.2)
    start = pose.plus(rng.normal(size=6) * 2e-3)
    R, t, L, misfit, count = single_frame_pose(VIEWS, start.rotation, start.translation, ALL, uv, cov)
    assert count == N
    found = Pose(R, t)
    assert misfit == pytest.approx(chi2(found, ALL, uv, cov), rel=1e-9)
    sigma = np.sqrt(np.diagonal(np.linalg.inv(L)))
    for d in np.vstack([np.diag(sigma), -np.diag(sigma)]) * 0.01:
        assert chi2(found.plus(d), ALL, uv, cov) > misfit


def test_a_pose_that_the_spots_do_not_determine_has_an_infinite_covariance():
    pose, uv, cov = some(np.random.default_rng(6))
    L = information(pose, ALL, uv, cov)[0]
    np.testing.assert_allclose(inverse(L), np.linalg.inv(L), rtol=1e-6)
    two = np.arange(N) < 2
    assert np.isinf(inverse(information(pose, two, uv, cov)[0])).all()
    assert np.isinf(inverse(np.zeros((6, 6)))).all()


def test_a_spot_is_controlled_by_the_others_if_its_error_would_show_in_its_residual():
    """All six control each other; three alone do not; a spot that is far more accurate than the others is not
    controlled.
    """
    pose, _, _ = some(np.random.default_rng(2))
    cov = np.tile(0.01 * np.eye(2), (N, 1, 1))
    R, t = np.ascontiguousarray(pose.rotation), np.ascontiguousarray(pose.translation)
    assert well_controlled(VIEWS, R, t, ALL, cov).all()
    three = np.isin(np.arange(N), [0, 2, 4])
    assert not well_controlled(VIEWS, R, t, three, cov).any()
    worse = cov.copy()
    worse[1:] *= 100.0**2
    checked = well_controlled(VIEWS, R, t, ALL, worse)
    assert not checked[0]  # by spots that are a hundred times less accurate
    assert not checked[~ALL].any()


@pytest.mark.parametrize("view", range(N))
def test_an_error_of_a_controlled_spot_shows_in_its_residual(view):
    pose, _, _ = some(np.random.default_rng(view))
    cov = np.tile(0.01 * np.eye(2), (N, 1, 1))
    uv = MODEL.project(pose)[0]
    uv[view] += 5.0 / np.sqrt(2)
    R, t = np.ascontiguousarray(pose.rotation), np.ascontiguousarray(pose.translation)
    assert well_controlled(VIEWS, R, t, ALL, cov)[view]
    *_, misfit, _ = single_frame_pose(VIEWS, R, t, ALL, uv, cov)
    assert misfit > 25.0
