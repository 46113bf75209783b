"""Compiled matrices and rotations against numpy and against geometry/rotations.py."""

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
def test_compiled_rotations_equal_the_numpy_ones(angle):
    w = vector(np.random.default_rng(1), angle)
    R = rotations.exp(w)
    np.testing.assert_allclose(compiled_linalg.exp(w), R, rtol=0, atol=1e-15)
    np.testing.assert_allclose(compiled_linalg.log(R), rotations.log(R), rtol=0, atol=1e-12)
    np.testing.assert_allclose(compiled_linalg.right_jacobian(w), rotations.right_jacobian(w), rtol=0, atol=1e-8)


@settings(max_examples=30, deadline=None)
@given(seed=seeds)
def test_pose_minus_is_the_inverse_of_pose_plus(seed):
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
def test_solve_equals_numpy(seed, n):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(n, n)) + 3 * np.eye(n), rng.normal(size=(n, 2))
    x, log_det = compiled_linalg.solve(a, b)
    np.testing.assert_allclose(a @ x, b, rtol=0, atol=1e-9)
    assert log_det == pytest.approx(np.linalg.slogdet(a)[1], abs=1e-9)
    np.testing.assert_allclose(compiled_linalg.multiply(a, b), a @ b, rtol=0, atol=1e-12)
    np.testing.assert_allclose(compiled_linalg.apply(a, b[:, 0].copy()), a @ b[:, 0], rtol=0, atol=1e-12)


def test_the_determinant_of_a_singular_system_is_not_finite():
    a = np.ones((3, 3))
    assert not np.isfinite(compiled_linalg.solve(a, np.ones((3, 1)))[1])


def a_covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    A = rng.normal(size=(n, 2 * n))
    return A @ A.T / (2 * n)


@settings(max_examples=30, deadline=None)
@given(seed=seeds, n=st.integers(1, 18), k=st.integers(1, 6))
def test_a_cholesky_factor_times_its_transpose_is_the_matrix(seed, n, k):
    rng = np.random.default_rng(seed)
    P = a_covariance(rng, n)
    L = compiled_linalg.cholesky(P)
    np.testing.assert_array_equal(L, np.tril(L))
    np.testing.assert_allclose(L @ L.T, P, rtol=0, atol=1e-12)
    # A number without variance has a row and a column of zeros; the others are not affected.
    fixed = rng.integers(n)
    P[fixed], P[:, fixed] = 0.0, 0.0
    L = compiled_linalg.cholesky(P)
    assert np.isfinite(L).all()
    np.testing.assert_allclose(L @ L.T, P, rtol=0, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(seed=seeds, n=st.integers(6, 18), rank=st.integers(0, 6))
def test_a_posterior_covariance_equals_the_dense_formula(seed, n, rank):
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
def test_a_posterior_is_positive_definite_even_with_a_vague_prior(vague):
    """P - P H^T S^-1 H P has rounding errors of 1e-16 P, here as large as the result or larger."""
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
            # With a vague prior the covariance is that of the measurement, to the last digits.
            C = np.linalg.inv(Y)
            scale = np.sqrt(np.outer(np.diagonal(C), np.diagonal(C)))
            np.testing.assert_allclose(out[:6, :6] / scale, C / scale, rtol=0, atol=1e-6)
