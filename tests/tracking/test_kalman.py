"""The Kalman filter of one spot: steady gains, restart at a bend, and numerical stability."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracking import kalman

DT = 0.01  # s


def kalata(index: float) -> tuple[float, float]:
    """The steady gains alpha and beta for a tracking index Lambda = sigma_a dt^2 / sigma_z.

    Kalata (1984), "The tracking index", IEEE Trans. AES-20: white acceleration, constant within a frame.
    """
    r = (4 + index - np.sqrt(8 * index + index**2)) / 4
    alpha = 1 - r**2
    return alpha, 2 * (2 - alpha) - 4 * np.sqrt(1 - alpha)


@pytest.mark.parametrize("index", [1e-2, 0.1, 1.0, 10.0])
def test_the_steady_gains_agree_with_kalatas_closed_form(index):
    sigma_z = 0.2
    sigma_a = index * sigma_z / DT**2
    x, P = np.zeros(4), np.diag([1.0, 1, 1e4, 1e4])
    R = sigma_z**2 * np.eye(2)
    for _ in range(3000):
        x, P = kalman.predict(x, P, DT, np.array(sigma_a))
        before = P
        x, P = kalman.update(x, P, np.zeros(2), R)
    # After an innovation of (1, 0) px, position and rate move by alpha and beta / dt.
    moved, _ = kalman.update(np.zeros(4), before, np.array([1.0, 0.0]), R)
    alpha, beta = kalata(index)
    np.testing.assert_allclose(moved, [alpha, 0.0, beta / DT, 0.0], rtol=1e-6, atol=1e-9)


def test_equations_1_and_2_agree_with_a_hand_calculation():
    x = np.array([100.0, 50.0, 30.0, -20.0])
    P = np.diag([1.0, 4.0, 9.0, 16.0])
    moved, grown = kalman.predict(x, P, 0.5, np.array(2.0))
    np.testing.assert_allclose(moved, [115.0, 40.0, 30.0, -20.0])
    # u: 1 + 0.25 * 9 + 4 * 0.0625 / 4, u with its rate: 0.5 * 9 + 4 * 0.125 / 2, rate: 9 + 4 * 0.25
    assert grown[0, 0] == pytest.approx(1 + 2.25 + 0.0625)
    assert grown[0, 2] == pytest.approx(4.5 + 0.25)
    assert grown[2, 2] == pytest.approx(10.0)
    assert grown[1, 1] == pytest.approx(4 + 4 + 0.0625)
    np.testing.assert_array_equal(grown, grown.T)
    assert grown[0, 1] == grown[0, 3] == grown[2, 3] == 0  # the axes are independent


def test_process_noise_is_the_scatter_from_random_accelerations_constant_within_a_step():
    """20,000 draws: variances to 1 %, 1 sigma."""
    rng = np.random.default_rng(1)
    a = 40.0 * rng.standard_normal((20_000, 2))
    moved = np.column_stack([a * DT**2 / 2, a * DT])
    sampled = moved.T @ moved / len(moved)
    Q = kalman.process_noise(np.full(2, 40.0), DT)
    scale = np.sqrt(np.outer(np.diagonal(Q), np.diagonal(Q)))
    np.testing.assert_allclose(sampled / scale, Q / scale, atol=0.05)


def test_two_half_steps_without_acceleration_are_one_step():
    rng = np.random.default_rng(2)
    x, A = rng.normal(size=4), rng.normal(size=(4, 4))
    once = kalman.predict(x, A @ A.T, DT, np.array(0.0))
    half = kalman.predict(*kalman.predict(x, A @ A.T, DT / 2, np.array(0.0)), DT / 2, np.array(0.0))
    np.testing.assert_allclose(half[0], once[0], atol=1e-14)
    np.testing.assert_allclose(half[1], once[1], atol=1e-14)


def test_the_restart_at_a_bend_follows_equation_6():
    z, last = np.array([120.0, 80.0]), np.array([117.0, 84.0])
    R, R_last = np.array([[0.02, 0.005], [0.005, 0.01]]), np.diag([0.03, 0.04])
    x, P = kalman.restart(z, R, last, R_last, DT)
    np.testing.assert_allclose(x, [120.0, 80.0, 300.0, -400.0])
    np.testing.assert_allclose(P[:2, :2], R)
    np.testing.assert_allclose(P[:2, 2:], R / DT)
    np.testing.assert_allclose(P[2:, 2:], (R + R_last) / DT**2)
    np.testing.assert_allclose(P, P.T)


def test_the_covariance_of_a_restart_is_the_scatter_of_restarts():
    rng = np.random.default_rng(3)
    R, R_last = np.array([[0.02, 0.005], [0.005, 0.01]]), np.array([[0.03, -0.01], [-0.01, 0.04]])
    n = 20_000
    z = rng.multivariate_normal([3.0, 4.0], R, n)
    last = rng.multivariate_normal([0.0, 0.0], R_last, n)
    x, P = kalman.restart(z, np.broadcast_to(R, (n, 2, 2)), last, np.broadcast_to(R_last, (n, 2, 2)), np.full(n, DT))
    scale = np.sqrt(np.outer(np.diagonal(P[0]), np.diagonal(P[0])))
    np.testing.assert_allclose(np.cov(x.T) / scale, P[0] / scale, atol=0.04)
    assert np.linalg.eigvalsh(P[0])[0] > 0


def test_after_a_gap_the_rate_of_a_restart_is_the_mean_over_the_gap():
    x, P = kalman.restart(np.array([10.0, 0.0]), np.eye(2), np.zeros(2), np.eye(2), 0.05)
    np.testing.assert_allclose(x, [10.0, 0.0, 200.0, 0.0])
    assert P[2, 2] == pytest.approx(2 / 0.05**2)


@given(spread=st.floats(-6, 8), sigma_z=st.floats(-6, 2), sigma_a=st.floats(-3, 7), seed=st.integers(0, 2**32 - 1))
def test_josephs_form_keeps_the_covariance_symmetric_and_positive(spread, sigma_z, sigma_a, seed):
    """Over 14 orders of magnitude between state and measurement, where (I - KH) P alone goes negative."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(4, 4)) * 10.0 ** (spread / 2)
    x, P = np.zeros(4), A @ A.T
    R = 10.0 ** (2 * sigma_z) * np.eye(2)
    for _ in range(20):
        x, P = kalman.predict(x, P, DT, np.array(10.0**sigma_a))
        x, P = kalman.update(x, P, rng.normal(size=2), R)
        np.testing.assert_array_equal(P, P.T)
        # Each number against its own scale: position and rate differ by a hundred.
        d = np.sqrt(np.diagonal(P))
        assert np.all(d > 0)
        assert np.linalg.eigvalsh(P / np.outer(d, d))[0] > -1e-9


def test_an_update_equals_least_squares_on_prior_and_measurement_together():
    """A second derivation: the information matrices add up."""
    rng = np.random.default_rng(4)
    A, x = rng.normal(size=(4, 4)), rng.normal(size=4)
    P, R, z = A @ A.T, np.array([[0.3, 0.1], [0.1, 0.2]]), rng.normal(size=2)
    H = np.eye(2, 4)
    information = np.linalg.inv(P) + H.T @ np.linalg.inv(R) @ H
    expected = np.linalg.solve(information, np.linalg.inv(P) @ x + H.T @ np.linalg.inv(R) @ z)
    got, covariance = kalman.update(x, P, z, R)
    np.testing.assert_allclose(got, expected, atol=1e-10)
    np.testing.assert_allclose(covariance, np.linalg.inv(information), atol=1e-10)


def test_innovations_agree_with_their_covariance():
    """Mean y S^-1 y = 2 over a run with the noise that the filter assumes; 2000 of them scatter by 0.045."""
    rng = np.random.default_rng(5)
    sigma_a, R = 3000.0, 0.1**2 * np.eye(2)
    truth, x, P = np.zeros(4), np.zeros(4), np.diag([1e-4, 1e-4, 1e4, 1e4])
    nis = []
    for _ in range(2000):
        a = sigma_a * rng.standard_normal(2)
        truth = kalman.transition(DT) @ truth + np.concatenate([a * DT**2 / 2, a * DT])
        x, P = kalman.predict(x, P, DT, np.array(sigma_a))
        z = truth[:2] + 0.1 * rng.standard_normal(2)
        nis.append(float(kalman.innovation(x, P, z, R)[2]))
        x, P = kalman.update(x, P, z, R)
    assert np.mean(nis) == pytest.approx(2.0, abs=0.18)


def test_many_spots_in_one_call_are_filtered_independently():
    rng = np.random.default_rng(6)
    A = rng.normal(size=(5, 4, 4))
    x, P = rng.normal(size=(5, 4)), A @ np.swapaxes(A, 1, 2)
    z, R = rng.normal(size=(5, 2)), np.tile(np.eye(2), (5, 1, 1)) * rng.uniform(0.1, 1, (5, 1, 1))
    sigma_a = rng.uniform(1, 100, 5)
    ahead, grown = kalman.predict(x, P, DT, sigma_a)
    after, small = kalman.update(ahead, grown, z, R)
    for i in range(5):
        one, wide = kalman.predict(x[i], P[i], DT, sigma_a[i])
        one, narrow = kalman.update(one, wide, z[i], R[i])
        np.testing.assert_allclose(after[i], one, atol=1e-12)
        np.testing.assert_allclose(small[i], narrow, atol=1e-12)
