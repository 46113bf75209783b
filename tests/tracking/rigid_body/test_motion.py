"""Motion model of a rigid body, against numerical derivatives, integrals and smaller steps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from geometry.arrays import Array, numeric_jacobian
from geometry.pose import Pose
from tracking.rigid_body.models.motion import ANY_MOMENT, STATE, predicted, process_noise, updated

JERK = np.repeat([20.0, 60.0], 3) ** 2
NONE = np.zeros(2)
State = tuple[Pose, Array]


def a_state(seed: int, rate: float = 3.0) -> State:
    """A pose and a motion; rate: the typical size of angular rate, rad/s, and a tenth of the angular acceleration's."""
    rng = np.random.default_rng(seed)
    pose = Pose.from_ypr(rng.uniform(-1, 1, 3), rng.normal(size=3))
    return pose, rng.normal(size=12) * np.repeat([1.0, rate, 10.0, 10 * rate], 3)


def a_covariance(seed: int) -> Array:
    """A covariance of the size that a tracker has: fractions of a millimetre and of a milliradian."""
    A = np.random.default_rng(seed).normal(size=(STATE, 2 * STATE))
    sigma = np.repeat([3e-4, 2e-4, 0.02, 0.02, 1.0, 1.0], 3)
    return np.asarray(A @ A.T / (2 * STATE) * np.outer(sigma, sigma))


def stepped(state: State, P: Array, dt: float, steps: int = 1, jerk: Array = JERK) -> tuple[State, Array]:
    R, t, m = state[0].rotation, state[0].translation, state[1]
    for _ in range(steps):
        R, t, m, P, _ = predicted(R, t, m, P, dt / steps, jerk, NONE, NONE, *ANY_MOMENT)
    return (Pose(R, t), m), P


def in_sigmas(A: Array, B: Array) -> float:
    """Largest difference of two covariances, in units of B's sigmas."""
    sigma = np.sqrt(np.diagonal(B))
    return float(np.abs((A - B) / np.outer(sigma, sigma)).max())


@pytest.mark.parametrize("dt", [0.002, 0.01, 0.1])
@pytest.mark.parametrize("rate", [0.0, 1e-6, 3.0, 20.0])
def test_the_transition_is_the_derivative_of_the_motion(rate, dt):
    pose, m = a_state(1, rate)
    (there, m_there), _ = stepped((pose, m), np.eye(STATE), dt)

    def moved(delta: Array) -> Array:
        (p, m_p), _ = stepped((pose.plus(delta[:6]), m + delta[6:]), np.eye(STATE), dt)
        return np.concatenate([p.minus(there), m_p - m_there])

    F = predicted(pose.rotation, pose.translation, m, np.eye(STATE), dt, JERK, NONE, NONE, *ANY_MOMENT)[4]
    # Central differences with a step of 1e-6: rounding of 1e-16 / 1e-6 and curvature of 1e-12.
    np.testing.assert_allclose(F, numeric_jacobian(moved, np.zeros(STATE)), atol=1e-8)


def test_a_body_with_constant_accelerations_follows_the_textbook_formulas():
    pose, _ = a_state(2)
    m = np.zeros(12)
    m[:3], m[6:9] = [1.0, -2.0, 0.5], [3.0, 0.1, -9.8]
    m[3:6], m[9:12] = [0.0, 0.0, 0.7], [0.0, 0.0, 0.4]  # about one axis, where angles add up
    (there, m_there), _ = stepped((pose, m), np.eye(STATE), 0.3)
    np.testing.assert_allclose(there.translation, pose.translation + 0.3 * m[:3] + 0.045 * m[6:9], atol=1e-14)
    np.testing.assert_allclose(there.minus(pose)[3:], [0, 0, 0.3 * 0.7 + 0.045 * 0.4], atol=1e-14)
    np.testing.assert_allclose(m_there[:6], m[:6] + 0.3 * m[6:], atol=1e-14)
    np.testing.assert_array_equal(m_there[6:], m[6:])


def test_white_jerk_adds_the_integral_of_a_triple_integrator():
    # Of one axis, by van Loan's matrix exponential; a body at rest, where all six are such chains of integrators.
    dt, chain = 0.05, np.diag([1.0, 1.0], 1)
    for axis, q in ((0, JERK[0]), (4, JERK[4])):
        big = np.zeros((6, 6))
        big[:3, :3], big[2, 5], big[3:, 3:] = -chain, q, chain.T
        both = expm(big * dt)
        Q = both[3:, 3:].T @ both[:3, 3:]
        _, P = stepped((Pose.identity(), np.zeros(12)), np.zeros((STATE, STATE)), dt)
        rows = [axis, axis + 6, axis + 12]
        np.testing.assert_allclose(P[np.ix_(rows, rows)], Q, rtol=1e-9)
        others = np.setdiff1d(np.arange(STATE), rows)
        assert np.all(P[np.ix_(rows, others)] == 0)


def test_two_half_steps_of_a_body_that_does_not_turn_are_one_step():
    pose, m = a_state(3)
    m[3:6] = m[9:12] = 0.0
    P0 = a_covariance(3)
    (one, m1), P1 = stepped((pose, m), P0, 0.04)
    (two, m2), P2 = stepped((pose, m), P0, 0.04, 2)
    np.testing.assert_allclose(two.minus(one), 0, atol=1e-13)
    np.testing.assert_allclose(m2, m1, rtol=1e-12)
    assert in_sigmas(P2, P1) < 1e-9


@pytest.mark.parametrize("rate", [1.0, 6.0])
def test_the_error_of_one_step_against_many_small_ones_is_less_than_the_angle_of_the_step(rate):
    # A first-order model: it neglects the rotation of noise and acceleration within a step.
    dt = 0.01
    pose, m = a_state(4, rate)
    m[9:12] = 0.0
    _, one = stepped((pose, m), a_covariance(4), dt)
    _, many = stepped((pose, m), a_covariance(4), dt, 100)
    angle = dt * float(np.linalg.norm(m[3:6]))
    assert in_sigmas(one, many) < 0.5 * angle


def test_a_covariance_stays_symmetric_and_positive_over_a_thousand_frames():
    (pose, m), P = a_state(5), a_covariance(5)
    J = np.random.default_rng(5).normal(size=(12, 6)) * [500, 500, 500, 3000, 3000, 3000]
    R, t = pose.rotation, pose.translation
    for k in range(1000):
        R, t, m, P, _ = predicted(R, t, m, P, 0.01, JERK, NONE, NONE, *ANY_MOMENT)
        if k % 50 < 40:  # ten frames without spots in fifty
            R, t, m, P, _, _ = updated(R, t, m, P, J.T @ J / 0.01, np.zeros(6))
        assert np.array_equal(P, P.T)
    sigma = np.sqrt(np.diagonal(P))
    assert np.linalg.eigvalsh(P / np.outer(sigma, sigma))[0] > 1e-9
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)


def test_a_jump_at_an_unknown_moment_of_a_step_has_the_covariance_of_random_moments():
    """Pose, velocity and acceleration at the end of the step, after jumps of velocity or acceleration at any moment."""
    rng, dt, draws = np.random.default_rng(6), 0.02, 200_000
    velocity_jump, acceleration_jump = 4.0, 900.0
    left = dt * rng.random(draws)  # s until the step ends
    size = np.sqrt(velocity_jump) * rng.normal(size=draws)
    of_jumps = np.stack([size * left, size, np.zeros(draws)])
    left = dt * rng.random(draws)
    size = np.sqrt(acceleration_jump) * rng.normal(size=draws)
    of_steps = np.stack([size * left**2 / 2, size * left, size])
    for values, args in ((of_jumps, (0.0, velocity_jump, 0.0)), (of_steps, (0.0, 0.0, acceleration_jump))):
        pp, pv, pa, vv, va, aa = process_noise(dt, *args, *ANY_MOMENT)
        Q = np.array([[pp, pv, pa], [pv, vv, va], [pa, va, aa]])
        scale = np.sqrt(np.maximum(np.diagonal(Q), 1e-30))
        # The mean of 2e5 squares is good to 0.5 % at worst (fourth moments of a Gaussian times a uniform factor).
        np.testing.assert_allclose((np.cov(values) - Q) / np.outer(scale, scale), 0, atol=0.02)


def test_the_kinds_of_process_noise_add_up_axis_by_axis():
    dt, velocity_jump, acceleration_jump = 0.02, np.array([4.0, 9.0]), np.array([100.0, 400.0])
    jerk = np.array([1.0, 4.0, 9.0, 16.0, 25.0, 36.0])
    P = predicted(
        np.eye(3), np.zeros(3), np.zeros(12), np.zeros((STATE, STATE)), dt, jerk, velocity_jump, acceleration_jump,
        *ANY_MOMENT,
    )[3]  # fmt: skip
    for i in range(6):
        rows = [i, i + 6, i + 12]
        parts = [(jerk[i], 0.0, 0.0), (0.0, velocity_jump[i // 3], 0.0), (0.0, 0.0, acceleration_jump[i // 3])]
        pp, pv, pa, vv, va, aa = np.sum([process_noise(dt, *part, *ANY_MOMENT) for part in parts], axis=0)
        np.testing.assert_allclose(P[np.ix_(rows, rows)], [[pp, pv, pa], [pv, vv, va], [pa, va, aa]], rtol=1e-12)
        assert np.all(P[np.ix_(rows, np.setdiff1d(np.arange(STATE), rows))] == 0)


def test_a_step_of_zero_length_changes_nothing():
    P0 = a_covariance(7)
    P = predicted(np.eye(3), np.zeros(3), np.ones(12), P0, 0.0, JERK, np.ones(2), np.ones(2), *ANY_MOMENT)[3]
    np.testing.assert_array_equal(P, P0)
