"""The unscented filter: equal to the Kalman filter where everything is linear, valid covariances everywhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry.arrays import Array
from tracking.unscented import (
    SPREAD,
    X0,
    Lasting,
    PrintedFilter,
    Spread,
    bearings,
    gate,
    observability,
    predict,
    process,
    selection,
    sigma_points,
    square_root,
    student_t,
    update,
)

SPREADS = [Spread(), Spread(0.55, 2.0, -2.0), Spread(1e-3, 2.0, 0.0)]


def random_covariance(rng, n):
    A = rng.normal(size=(n, n))
    return A @ A.T + 1e-3 * np.eye(n)


@pytest.mark.parametrize("spread", SPREADS)
def test_for_linear_functions_it_is_the_kalman_filter(spread):
    rng = np.random.default_rng(4)
    n, m = 5, 3
    x, P, Q, R = rng.normal(size=n), random_covariance(rng, n), random_covariance(rng, n), random_covariance(rng, m)
    F, H, z = rng.normal(size=(n, n)), rng.normal(size=(m, n)), rng.normal(size=m)
    predicted, P_predicted = predict(x, P, lambda rows: rows @ F.T, Q, spread)
    np.testing.assert_allclose(predicted, F @ x, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(P_predicted, F @ P @ F.T + Q, rtol=1e-7, atol=1e-7)
    step = update(predicted, P_predicted, z, lambda rows: rows @ H.T, R, spread)
    S = H @ P_predicted @ H.T + R
    K = P_predicted @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(step.x, predicted + K @ (z - H @ predicted), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(step.P, P_predicted - K @ S @ K.T, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(step.innovation_covariance, S, rtol=1e-7, atol=1e-7)


def weights(spread: Spread, n: int) -> tuple[Array, Array]:
    """Weights (2n + 1,) of mean and covariance, eq. (9) of Fu (2016); "1/2(n + lambda)" is 1 / (2 (n + lambda))."""
    scale = spread.scale(n)
    mean = np.full(2 * n + 1, 1 / (2 * scale))
    mean[0] = 1 - n / scale
    covariance = mean.copy()
    covariance[0] += 1 - spread.alpha**2 + spread.beta
    return mean, covariance


def test_the_weights_are_those_of_the_paper_as_they_are_meant():
    mean, covariance = weights(SPREAD, 8)
    np.testing.assert_allclose([mean[0], covariance[0], mean[1]], [-7.815, -5.118, 0.55096], atol=5e-4)
    assert mean.sum() == pytest.approx(1.0)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**9), which=st.sampled_from(range(len(SPREADS))))
def test_covariances_are_positive_semidefinite_for_any_function(seed, which):
    rng = np.random.default_rng(seed)
    n, m = 6, 3
    A, B, C = rng.normal(size=(n, n)), rng.normal(size=(n, n)), rng.normal(size=(m, n))

    def rough(rows):
        return (rows @ A.T) ** 2 * np.sin(rows @ B.T) + np.abs(rows)

    x, P = rng.normal(size=n), random_covariance(rng, n)
    x, P = predict(x, P, rough, np.zeros((n, n)), SPREADS[which])
    step = update(x, P, rng.normal(size=m), lambda rows: np.cos(rows @ C.T), 1e-6 * np.eye(m), SPREADS[which])
    for matrix in (P, step.P):
        assert np.array_equal(matrix, matrix.T)
        assert np.linalg.eigvalsh(matrix)[0] >= -1e-12 * np.linalg.norm(matrix)
    difference = np.linalg.eigvalsh(P - step.P)[0]
    assert difference >= -1e-8 * np.linalg.norm(P), "a measurement adds no uncertainty"


def test_the_covariance_equals_the_usual_weighted_sum():
    rng = np.random.default_rng(8)
    x, P = rng.normal(size=8), random_covariance(rng, 8)
    mean, covariance = predict(x, P, np.sin, np.zeros((8, 8)), SPREAD)
    values, (wm, wc) = np.sin(sigma_points(x, P, SPREAD)), weights(SPREAD, 8)
    np.testing.assert_allclose(mean, wm @ values, atol=1e-10)
    np.testing.assert_allclose(covariance, (values - mean).T @ (wc[:, None] * (values - mean)), atol=1e-9)


def test_a_square_has_the_mean_and_variance_of_a_chi_square():
    mean, variance = predict(np.zeros(1), np.eye(1), np.square, np.zeros((1, 1)))
    assert mean[0] == pytest.approx(1.0)
    assert variance[0, 0] == pytest.approx(2.0)


@pytest.mark.parametrize("settings_", [{"alpha": 0.0}, {"alpha": 2.0, "beta": 2.0}])
def test_a_spread_that_allows_indefinite_covariances_is_refused(settings_):
    with pytest.raises(ValueError, match="expected"):
        Spread(**settings_)


def test_an_indefinite_covariance_is_refused_and_a_singular_one_is_not():
    with pytest.raises(ValueError, match="negative eigenvalue"):
        square_root(np.diag([1.0, -0.1]))
    singular = np.outer([1.0, 2.0], [1.0, 2.0])
    L = square_root(singular)
    np.testing.assert_allclose(L @ L.T, singular, atol=1e-12)


def turning(rows):
    """A turn rate model, 0.1 s: x, y, heading, speed, rate."""
    x, y, heading, speed, rate = rows.T
    return np.stack([x + 0.1 * speed * np.cos(heading), y + 0.1 * speed * np.sin(heading), heading + 0.1 * rate,
                     speed, rate], axis=-1)  # fmt: skip


def range_and_bearing(rows):
    return np.stack([np.hypot(rows[:, 0] + 5, rows[:, 1] + 5), np.arctan2(rows[:, 1] + 5, rows[:, 0] + 5)], axis=-1)


def test_the_covariance_of_a_nonlinear_filter_agrees_with_its_errors():
    rng = np.random.default_rng(11)
    Q = np.diag([1e-6, 1e-6, 1e-6, 1e-4, 1e-4])
    R = np.diag([0.05, 0.01]) ** 2
    P0 = np.diag([0.5, 0.5, 0.2, 0.2, 0.1]) ** 2
    nees, nis = [], []
    for _ in range(25):
        truth = np.array([3.0, 2.0, 0.3, 1.0, 0.2])
        x, P = truth + np.linalg.cholesky(P0) @ rng.normal(size=5), P0
        for _ in range(40):
            truth = turning(truth[None])[0] + np.sqrt(np.diag(Q)) * rng.normal(size=5)
            z = range_and_bearing(truth[None])[0] + np.sqrt(np.diag(R)) * rng.normal(size=2)
            x, P = predict(x, P, turning, Q)
            step = update(x, P, z, range_and_bearing, R)
            x, P = step.x, step.P
            nis.append(step.nis)
        error = x - truth
        nees.append(error @ np.linalg.solve(P, error))
    assert 0.7 < np.mean(nees) / 5 < 1.35  # 25 runs: sigma of the mean ratio is sqrt(2 / 125) = 0.13
    assert 0.9 < np.mean(nis) / 2 < 1.1  # 1000 values: 0.03


@pytest.mark.parametrize("rule", [gate, student_t])
def test_a_robust_update_equals_the_standard_one_for_a_likely_measurement_and_resists_an_unlikely_one(rule):
    x, P, R = np.zeros(2), np.eye(2), np.eye(2)
    usual = update(x, P, np.array([0.5, -1.0]), np.copy, R)
    robust = update(x, P, np.array([0.5, -1.0]), np.copy, R, rule=rule)
    np.testing.assert_allclose(robust.x, usual.x)
    assert robust.weight == 1.0
    far = update(x, P, np.array([100.0, 0.0]), np.copy, R, rule=rule)
    assert np.abs(far.x).max() < 0.05  # the standard update moves by 50
    assert far.weight < 1e-4
    assert np.linalg.eigvalsh(P - far.P)[0] >= -1e-12


def test_a_lasting_rule_gives_a_likely_measurement_after_an_unlikely_one_the_weight_of_that():
    rule, usual = Lasting(steps=3), [student_t(nis, 2) for nis in (1.0, 900.0, 2.0, 3.0, 4.0)]
    assert [rule(nis, 2) for nis in (1.0, 900.0, 2.0, 3.0, 4.0)] == [1.0, usual[1], usual[1], usual[1], 1.0]
    assert usual == [1.0, usual[1], 1.0, 1.0, 1.0]
    assert usual[1] < 1e-3
    assert Lasting()(900.0, 2) == usual[1]


@pytest.mark.parametrize("rule", [student_t, Lasting()])
def test_the_student_t_update_recovers_from_a_state_that_is_wrong_and_too_certain(rule):
    x, P = np.zeros(1), 1e-2 * np.eye(1)
    for _ in range(200):
        x, P = predict(x, P, np.copy, 1e-2 * np.eye(1))
        step = update(x, P, np.array([5.0]), np.copy, 1e-2 * np.eye(1), rule=rule)
        x, P = step.x, step.P
    assert x[0] == pytest.approx(5.0, abs=0.1)


def trajectory():
    t = 0.1 * np.arange(100)
    states = np.tile(X0, (len(t), 1))
    states[:, :3] += 0.3 * np.sin(0.4 * t[:, None] + np.arange(3))
    states[:, 3:6] = 0.12 * np.cos(0.4 * t[:, None] + np.arange(3))
    return states


def test_eq_4_does_not_observe_the_range_and_eq_5_does_not_observe_the_attitude():
    prior = np.diag([10.0, 5.0, 2.0, 5.0, 5.0, 2.0, 1.0, 1.0]) ** 2
    selected = observability(trajectory(), process(0.1), selection, 1e-3 * np.eye(4), prior)
    seen = observability(trajectory(), process(0.1), bearings, 1e-3 * np.eye(4), prior)
    assert selected.rank == seen.rank == 6
    assert selected.observed() == (False, True, True, False, True, True, True, True)
    assert seen.observed() == (True, True, True, True, True, True, False, False)
    assert selected.sigma[0] == pytest.approx(10.0)
    assert seen.sigma[0] < 1.0


def test_the_information_is_that_of_many_independent_measurements():
    states = np.zeros((10, 1))
    o = observability(states, np.copy, np.copy, 4.0 * np.eye(1), 9.0 * np.eye(1))
    assert o.information[0, 0] == pytest.approx(10 / 4, rel=1e-6)
    assert o.sigma[0] == pytest.approx((1 / 9 + 10 / 4) ** -0.5, rel=1e-6)


def test_the_printed_filter_keeps_its_value_while_the_target_moves():
    printed = PrintedFilter(x=np.array([21.0, 9.0, 0.5, 0, 0, 0, 0.4, 0.1]), P=1e-4 * np.eye(8))
    for k in range(60):
        last = printed.step(np.array([9.0, 0.5 + 0.02 * k, 0.4, 0.1]), 0.1).x
    assert abs(last[2] - (0.5 + 0.02 * 59)) > 0.3  # the standard filter follows within 0.05 m
