"""Steps of a microsecond to a second, weak and strong jerk, precise and missing spots: motions are finite and exact."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.arrays import Array
from geometry.compiled_linalg import cholesky, posterior
from tests.marks import further_slow
from tracking.rigid_body.models.motion import STATE
from tracking.smoothing.motion.fixed_interval import RunInformation, filtered, log_likelihood, smoothed
from tracking.smoothing.motion.run_detections import Reference, unknown_moments
from tracking.smoothing.motion.timed_run import NEAR

FRAMES = 8
FIRST = np.repeat([0.1, 0.1, 2.0, 2.0, 50.0, 50.0], 3) ** 2
# Covariances of white jerk over a step of one second, (3, 3), and its root.
UNIT = np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1]], dtype=np.longdouble)


def extreme(seed: int, near: float) -> tuple[Reference, RunInformation, Array, list[Array], list[Array]]:
    """A run about rest, and its spots as rows A (n, 6) and values y (n,), of unit sigma.

    near: m and rad, sigma of each pose about the reference.
    """
    rng = np.random.default_rng(seed)
    dt, jerk = 10 ** rng.uniform(-6, 0, FRAMES), 10 ** rng.uniform(-3, 9, (FRAMES, 6))
    L, g, rows, values = np.zeros((FRAMES, 6, 6)), np.zeros((FRAMES, 6)), [], []
    for k in range(FRAMES):
        spots, size = rng.choice([0, 1, 2, 3]), 10 ** (0.5 * rng.uniform(-2, 12))
        A = np.vstack([rng.normal(size=(2 * spots, 6)) * size, np.eye(6) / near])
        y = np.concatenate([rng.normal(size=2 * spots), np.zeros(6)])
        L[k], g[k] = A.T @ A, A.T @ y
        rows.append(A)
        values.append(y)
    still = Reference(np.tile(np.eye(3), (FRAMES, 1, 1)), np.zeros((FRAMES, 3)), np.zeros((FRAMES, 12)))
    none = np.zeros((FRAMES, 2))
    return still, RunInformation(L, g, dt, none, none, unknown_moments(FRAMES), FIRST), jerk, rows, values


def root(A: Array) -> Array:
    """Lower triangular root in extended precision."""
    out = np.zeros_like(A)
    for j in range(len(A)):
        out[j, j] = np.sqrt(A[j, j] - out[j, :j] @ out[j, :j])
        out[j + 1 :, j] = (A[j + 1 :, j] - out[j + 1 :, :j] @ out[j, :j]) / out[j, j]
    return out


def inverse(L: Array) -> Array:
    """Of a lower triangular matrix, in extended precision."""
    out = np.eye(len(L), dtype=np.longdouble)
    for i in range(len(L)):
        out[i] = (out[i] - L[i, :i] @ out[:i]) / L[i, i]
    return out


def least_squares(info: RunInformation, jerk: Array, rows: list[Array]) -> Array:
    """Covariance (T, 18, 18) by Householder's triangulation of all equations, in extended precision."""
    equations = []

    def add(k: int, A: Array, before: Array | None = None) -> None:
        row = np.zeros((len(A), STATE * FRAMES), np.longdouble)
        row[:, STATE * k : STATE * k + A.shape[1]] = A
        if before is not None:
            row[:, STATE * (k - 1) : STATE * k] = before
        equations.append(row)

    add(0, np.diag(1 / np.sqrt(FIRST.astype(np.longdouble))))
    for k in range(FRAMES):
        add(k, rows[k].astype(np.longdouble))
        if k > 0:
            dt = np.longdouble(info.dt[k])
            scale = np.sqrt(dt) * np.array([dt**2, dt, np.longdouble(1)])
            F, W = np.eye(STATE, dtype=np.longdouble), np.zeros((STATE, STATE), np.longdouble)
            for i in range(6):
                F[i, 6 + i], F[i, 12 + i], F[6 + i, 12 + i] = dt, dt * dt / 2, dt
                W[i::6, i::6] = inverse(root(UNIT)) / (scale * np.sqrt(np.longdouble(jerk[k, i])))
            add(k, W, -W @ F)
    A = np.vstack(equations)
    for j in range(A.shape[1]):
        largest = j + int(np.argmax(np.abs(A[j:, j])))
        A[[j, largest]] = A[[largest, j]]
        v = A[j:, j].copy()
        v[0] += np.copysign(np.sqrt(v @ v), v[0])
        A[j:] -= np.outer(v, (2 / (v @ v)) * (v @ A[j:]))
    half = inverse(A[: A.shape[1]].T * np.tri(A.shape[1], dtype=np.longdouble))
    P = half.T @ half
    return np.stack([P[STATE * k : STATE * (k + 1), STATE * k : STATE * (k + 1)] for k in range(FRAMES)])


def ratios(P: Array, true: Array) -> Array:
    """Variances of P over the true ones, along the directions in which these differ most."""
    half = inverse(root(true))
    return np.linalg.eigvalsh((half @ P.astype(np.longdouble) @ half.T).astype(float))


@pytest.mark.parametrize("seed", further_slow(range(25), fast=10))
def test_covariances_are_those_of_extended_precision(seed):
    """Jerks of 1e-3 to 1e9, steps of 1e-6 to 1 s, information of 1e-2 to 1e12."""
    still, info, jerk, rows, _ = extreme(seed, NEAR)
    out, true = smoothed(still, info, jerk, True), least_squares(info, jerk, rows)
    for k in range(FRAMES):
        for P, block in ((out.pose_P[k], true[k, :6, :6]), (out.motion_P[k], true[k, 6:12, 6:12])):
            np.testing.assert_allclose(ratios(P, block), 1.0, atol=0.05)


@pytest.mark.parametrize("near", [NEAR, 1e4, 1e9])
def test_all_is_finite_symmetric_and_positive_definite(near):
    for seed in range(100):
        still, info, jerk, *_ = extreme(1000 + seed, near)
        out = smoothed(still, info, jerk, True)
        assert all(np.isfinite(part).all() for part in out)
        assert np.isfinite(log_likelihood(still, info, jerk))
        assert all(np.isfinite(part).all() for part in filtered(still, info, jerk))
        for P in (*out.pose_P, *out.motion_P):
            np.testing.assert_array_equal(P, P.T)
            sigma = np.sqrt(np.diagonal(P))
            assert np.linalg.eigvalsh(P / np.outer(sigma, sigma))[0] > -1e-14


def test_a_precise_spot_of_a_pose_that_is_kilometres_away_leaves_it_finite():
    """One spot of 1e-6: the covariance of the other directions has no digit left for it."""
    rng = np.random.default_rng(4)
    for _ in range(200):
        A = rng.normal(size=(2, 6)) * 1e6
        P, _ = posterior(np.eye(STATE) * 1e9, A.T @ A)
        again, log_det = posterior(P, A.T @ A)
        assert np.isfinite(again).all()
        assert np.isfinite(log_det)
        # No pivot of a root is larger than the row that it belongs to.
        assert np.all(np.abs(cholesky(P, 0.0)).max(axis=1) <= 1.01 * np.sqrt(np.diagonal(P)))
