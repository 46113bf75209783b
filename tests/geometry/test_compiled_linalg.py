"""The compiled small matrices and rotations against numpy and against the stacked formulas."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry import compiled_linalg, rotations
from geometry.pose import Pose

seeds = st.integers(0, 2**32 - 1)
ANGLES = (0.0, 1e-9, 1e-5, 0.3, 2.0, np.pi - 1e-7)


def vector(rng: np.random.Generator, angle: float) -> np.ndarray:
    axis = rng.normal(size=3)
    return angle * axis / np.linalg.norm(axis)


@pytest.mark.parametrize("angle", ANGLES)
def test_rotations_are_those_of_the_stacked_formulas(angle):
    w = vector(np.random.default_rng(1), angle)
    R = rotations.exp(w)
    np.testing.assert_allclose(compiled_linalg.exp(w), R, rtol=0, atol=1e-15)
    np.testing.assert_allclose(compiled_linalg.log(R), rotations.log(R), rtol=0, atol=1e-12)
    np.testing.assert_allclose(compiled_linalg.right_jacobian(w), rotations.right_jacobian(w), rtol=0, atol=1e-8)


@settings(max_examples=30, deadline=None)
@given(seed=seeds)
def test_a_pose_moved_and_taken_apart_again_gives_the_same_difference(seed):
    rng = np.random.default_rng(seed)
    pose = Pose(rotations.exp(vector(rng, 1.0)), rng.normal(size=3))
    delta = np.concatenate([rng.normal(size=3), vector(rng, rng.uniform(0, 3.0))])
    R, t = compiled_linalg.pose_plus(pose.rotation, pose.translation, delta)
    expected = pose.plus(delta)
    np.testing.assert_allclose(R, expected.rotation, rtol=0, atol=1e-14)
    np.testing.assert_allclose(t, expected.translation, rtol=0, atol=1e-14)
    np.testing.assert_allclose(
        compiled_linalg.pose_minus(R, t, pose.rotation, pose.translation), delta, rtol=0, atol=1e-12
    )


@settings(max_examples=30, deadline=None)
@given(seed=seeds, n=st.integers(1, 12))
def test_a_system_is_solved_as_numpy_solves_it(seed, n):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(n, n)) + 3 * np.eye(n), rng.normal(size=(n, 2))
    x, log_det = compiled_linalg.solve(a, b)
    np.testing.assert_allclose(a @ x, b, rtol=0, atol=1e-9)
    assert log_det == pytest.approx(np.linalg.slogdet(a)[1], abs=1e-9)
    np.testing.assert_allclose(compiled_linalg.multiply(a, b), a @ b, rtol=0, atol=1e-12)
    np.testing.assert_allclose(compiled_linalg.apply(a, b[:, 0].copy()), a @ b[:, 0], rtol=0, atol=1e-12)


def test_a_singular_system_is_seen_by_its_determinant():
    a = np.ones((3, 3))
    assert not np.isfinite(compiled_linalg.solve(a, np.ones((3, 1)))[1])


def a_covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    A = rng.normal(size=(n, 2 * n))
    return A @ A.T / (2 * n)


@settings(max_examples=30, deadline=None)
@given(seed=seeds, n=st.integers(1, 18), k=st.integers(1, 6))
def test_a_triangular_factor_squared_is_the_matrix(seed, n, k):
    rng = np.random.default_rng(seed)
    P = a_covariance(rng, n)
    L = compiled_linalg.cholesky(P)
    np.testing.assert_array_equal(L, np.tril(L))
    np.testing.assert_allclose(L @ L.T, P, rtol=0, atol=1e-12)
    # What does not vary has a row and column of zeros; the others are as without it.
    fixed = rng.integers(n)
    P[fixed], P[:, fixed] = 0.0, 0.0
    L = compiled_linalg.cholesky(P)
    assert np.isfinite(L).all()
    np.testing.assert_allclose(L @ L.T, P, rtol=0, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(seed=seeds, n=st.integers(6, 18), rank=st.integers(0, 6))
def test_a_posterior_covariance_is_the_dense_formula(seed, n, rank):
    rng = np.random.default_rng(seed)
    P, J = a_covariance(rng, n), rng.normal(size=(rank, 6))
    Y = np.zeros((n, n))
    Y[:6, :6] = J.T @ J
    out, log_det = compiled_linalg.posterior(P, J.T @ J)
    # (P^-1 + Y)^-1 without the inverse of P, which may be nearly singular.
    np.testing.assert_allclose(out, np.linalg.solve(np.eye(n) + P @ Y, P), rtol=0, atol=1e-10)
    np.testing.assert_array_equal(out, out.T)
    assert log_det == pytest.approx(np.linalg.slogdet(np.eye(n) + P @ Y)[1], abs=1e-9)


@pytest.mark.parametrize("vague", [1.0, 1e4, 1e8, 1e14])
def test_a_posterior_is_positive_definite_however_vague_the_prior(vague):
    """The textbook's P - P H^T S^-1 H P is left with rounding of 1e-16 P: here as much as the result, or more."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        Y = np.linalg.inv(a_covariance(rng, 6))
        P = vague * a_covariance(rng, 18)
        out, _ = compiled_linalg.posterior(P, Y)
        sigma = np.sqrt(np.diagonal(out))
        assert np.isfinite(sigma).all()
        assert np.linalg.eigvalsh(out[:6, :6] / np.outer(sigma[:6], sigma[:6]))[0] > 0
        assert np.linalg.eigvalsh(out / np.outer(sigma, sigma))[0] > -1e-12
        if vague > 1e7:
            # A vague prior leaves what was measured the measurement's covariance, to the last digits.
            C = np.linalg.inv(Y)
            scale = np.sqrt(np.outer(np.diagonal(C), np.diagonal(C)))
            np.testing.assert_allclose(out[:6, :6] / scale, C / scale, rtol=0, atol=1e-6)
