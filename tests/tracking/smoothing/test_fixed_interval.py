"""The fixed-interval smoother against one dense Gaussian of the whole run, and its test for velocity jumps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from geometry.arrays import Array
from geometry.pose import Pose
from tests.marks import further_slow
from tracking.rigid_body.models.motion import ANY_MOMENT, STATE, predicted, updated
from tracking.smoothing.motion import fixed_interval
from tracking.smoothing.motion.fixed_interval import (
    RunInformation,
    leave_one_out_log_likelihood,
    log_likelihood,
    smoothed,
)
from tracking.smoothing.motion.process_noise import SHOCK_SEPARATION
from tracking.smoothing.motion.run_detections import Reference, shifted, unknown_moments

DT = 0.01
JERK = np.repeat([20.0, 60.0], 3) ** 2


@dataclass(frozen=True)
class Run:
    """Deviations drawn from the model itself, and the information that noisy spots would give about them."""

    ref: Reference
    info: RunInformation
    jerk: Array  # (T, 6)
    true: Array  # (T, 18)


def transition(ref: Reference, info: RunInformation, jerk: Array, k: int) -> tuple[Array, Array, Array]:
    """F, the covariance that step k adds, and the deviation of the predicted reference from the reference itself."""
    args = ref.R[k - 1], ref.t[k - 1], ref.m[k - 1], np.zeros((STATE, STATE)), info.dt[k]
    R, t, m, Q, F = predicted(*args, jerk[k], info.velocity_jump[k], info.acceleration_jump[k], *ANY_MOMENT)
    away = Pose(R, t).minus(Pose(ref.R[k], ref.t[k]))
    return F, Q, np.concatenate([away, m - ref.m[k]])


def drawn(
    seed: int,
    frames: int,
    jump_at: int | None = None,
    jumps: float = 0.0,
    without_spots: slice = slice(0, 0),
    jerk: Array = JERK,
    moment: float = 0.5,
) -> Run:
    """A run. jumps: variance of the velocity jumps that the model allows for in every step.

    jump_at: frame before which a jump happens that the model does not allow for, at this moment of the step (0 to 1).
    without_spots: frames without information. jerk (6,) or (T, 6).
    """
    rng = np.random.default_rng(seed)
    t = 0.1 * np.cumsum(rng.normal(size=(frames, 3)) * DT, axis=0)
    angles = np.cumsum(rng.normal(size=(frames, 3)) * DT, axis=0)
    poses = Pose.from_ypr(angles, t)
    m = rng.normal(size=(frames, 12)) * np.repeat([0.3, 1.0, 1.0, 3.0], 3)
    ref = Reference(poses.rotation, t, m)  # any motion will do, since deviations refer to it
    J = rng.normal(size=(frames, 12, 6)) * [800, 800, 800, 1500, 1500, 1500]  # px per m and rad
    L = np.swapaxes(J, 1, 2) @ J / 0.1**2
    L[without_spots] = 0.0
    dt = np.full(frames, DT)
    dt[3 * frames // 4] = 2 * DT  # a frame was dropped
    sizes = np.full((frames, 2), jumps)
    first = np.repeat([0.02, 0.02, 0.5, 0.5, 5.0, 5.0], 3) ** 2
    info = RunInformation(L, np.zeros((frames, 6)), dt, sizes, 100 * sizes, unknown_moments(frames), first)
    jerk = np.array(np.broadcast_to(jerk, (frames, 6)), order="C")  # as in the program: no second machine code
    x = np.sqrt(first) * rng.normal(size=STATE)
    true, g = np.empty((frames, STATE)), np.zeros((frames, 6))
    for k in range(frames):
        if k > 0:
            if k == jump_at:
                jump = np.array([1.0, -0.5, 0.3, 3.0, -2.0, 1.0])
                x[:6] -= moment * dt[k] * jump  # until then the old velocity
                x[6:12] += jump
            F, Q, away = transition(ref, info, jerk, k)
            x = F @ x + away + np.linalg.cholesky(Q + 1e-25 * np.eye(STATE)) @ rng.normal(size=STATE)
        true[k] = x
        if L[k].any():
            g[k] = L[k] @ x[:6] + np.linalg.cholesky(L[k]) @ rng.normal(size=6)
    return Run(ref, info._replace(vector=g), jerk, true)


def dense(run: Run, without: int | None = None) -> tuple[Array, Array]:
    """Mean (T, 18) and covariance (18 T, 18 T) given all information, as one Gaussian; without that of one frame."""
    frames = len(run.info.dt)
    L, g = run.info.information.copy(), run.info.vector.copy()
    if without is not None:
        L[without], g[without] = 0.0, 0.0
    mean, P = np.zeros((frames, STATE)), np.zeros((frames, STATE, frames, STATE))
    P[0, :, 0] = np.diag(run.info.first_variance)
    for k in range(1, frames):
        F, Q, away = transition(run.ref, run.info, run.jerk, k)
        mean[k] = F @ mean[k - 1] + away
        P[k, :, :k] = np.tensordot(F, P[k - 1, :, :k], 1)
        P[:k, :, k] = P[k, :, :k].transpose(1, 2, 0)
        P[k, :, k] = F @ P[k - 1, :, k - 1] @ F.T + Q
    seen = [k for k in range(frames) if L[k].any()]
    rows = np.concatenate([np.arange(6) + STATE * k for k in seen])
    whole = P.reshape(frames * STATE, frames * STATE)
    # The information as measurements L^(T/2) x with covariance 1.
    H = np.zeros((6 * len(seen), frames * STATE))
    y = np.zeros(6 * len(seen))
    for n, k in enumerate(seen):
        root = np.linalg.cholesky(L[k]).T
        H[6 * n : 6 * n + 6, rows[6 * n : 6 * n + 6]] = root
        y[6 * n : 6 * n + 6] = np.linalg.solve(root.T, g[k]) - root @ mean[k, :6]
    seen_with_all = H @ whole
    K = np.linalg.solve(seen_with_all @ H.T + np.eye(len(y)), seen_with_all).T
    return mean + (K @ y).reshape(frames, STATE), whole - K @ seen_with_all


def log_evidence(run: Run, jerk: Array) -> float:
    """Sum of the log densities of the innovations, for measurements of x with covariance L^-1."""
    x, P, total = np.zeros(STATE), np.diag(run.info.first_variance), 0.0
    for k in range(len(run.info.dt)):
        if k > 0:
            F, Q, away = transition(run.ref, run.info, jerk, k)
            x, P = F @ x + away, F @ P @ F.T + Q
        L = run.info.information[k]
        if not L.any():
            continue
        C = np.linalg.inv(L)
        y, S = C @ run.info.vector[k] - x[:6], P[:6, :6] + C
        total -= 0.5 * (y @ np.linalg.solve(S, y) + np.linalg.slogdet(2 * np.pi * S)[1])
        K = P[:, :6] @ np.linalg.inv(S)
        x, P = x + K @ y, P - K @ P[:6]
    return total


def leave_one_out(run: Run, factor: float) -> float:
    out = smoothed(run.ref, run.info, factor * run.jerk, True)
    return float(leave_one_out_log_likelihood(out.x, out.pose_P, run.info))


RUNS = {
    "steady": lambda: drawn(1, 16),
    "jumps that are allowed for": lambda: drawn(2, 16, jumps=0.5),
    "no spots in the middle": lambda: drawn(3, 20, without_spots=slice(8, 13)),
    "no spots at the end": lambda: drawn(4, 14, without_spots=slice(10, 14)),
    "one frame": lambda: drawn(5, 1),
}


@pytest.mark.parametrize("kind", RUNS)
def test_means_and_covariances_are_those_of_one_dense_gaussian(kind):
    run = RUNS[kind]()
    frames = len(run.info.dt)
    x, pose_P, motion_P, *_ = smoothed(run.ref, run.info, run.jerk, True)
    mean, P = dense(run)
    blocks = np.stack([P[STATE * k : STATE * (k + 1), STATE * k : STATE * (k + 1)] for k in range(frames)])
    sigma = np.sqrt(np.diagonal(blocks, axis1=1, axis2=2))
    np.testing.assert_allclose((x - mean) / sigma, 0, atol=1e-6)
    scale = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose((pose_P - blocks[:, :6, :6]) / scale[:, :6, :6], 0, atol=1e-6)
    np.testing.assert_allclose((motion_P - blocks[:, 6:12, 6:12]) / scale[:, 6:12, 6:12], 0, atol=1e-6)


@pytest.mark.parametrize(
    "kind", ["steady", "jumps that are allowed for", "no spots in the middle", "no spots at the end"]
)
def test_energy_and_gamma_of_the_process_noise_agree_with_the_dense_gaussian(kind):
    """Of the jerk's share J of the noise covariance Q: energy r^T J r of the score r = Q^-1 w, w the noise's mean, and
    its expectation tr(J (Q^-1 - Q^-1 cov(w) Q^-1)), the number of components of the jerk that the data determine.
    The same of the share of the allowed jumps.
    """
    run = RUNS[kind]()
    without_jumps = run.info._replace(
        velocity_jump=np.zeros_like(run.info.velocity_jump), acceleration_jump=np.zeros_like(run.info.velocity_jump)
    )
    frames = len(run.info.dt)
    out = smoothed(run.ref, run.info, run.jerk, True)
    mean, P = dense(run)
    assert np.all(out.energy[0] == 0)  # there is no step before the first frame
    assert np.all(out.gamma[0] == 0)
    for k in range(1, frames):
        F, Q, away = transition(run.ref, run.info, run.jerk, k)
        jerk_share = transition(run.ref, without_jumps, run.jerk, k)[1]
        w = mean[k] - F @ mean[k - 1] - away
        step = np.hstack([-F, np.eye(STATE)])
        both = slice(STATE * (k - 1), STATE * (k + 1))
        C = step @ P[both, both] @ step.T
        jump_energy, jump_gamma = np.zeros(2), np.zeros(2)
        for axis in range(6):
            rows = [axis, axis + 6, axis + 12]
            inverse, share = np.linalg.inv(Q[np.ix_(rows, rows)]), jerk_share[np.ix_(rows, rows)]
            r, N = inverse @ w[rows], inverse - inverse @ C[np.ix_(rows, rows)] @ inverse
            assert out.energy[k, axis] == pytest.approx(r @ share @ r, rel=1e-4, abs=1e-4)
            assert out.gamma[k, axis] == pytest.approx(np.trace(share @ N), abs=1e-4)
            jump = (Q - jerk_share)[np.ix_(rows, rows)]
            jump_energy[axis // 3] += r @ jump @ r
            jump_gamma[axis // 3] += np.trace(jump @ N)
        np.testing.assert_allclose(out.jump_energy[k], jump_energy, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(out.jump_gamma[k], jump_gamma, atol=1e-4)


def test_the_mean_energy_of_the_process_noise_is_the_number_of_determined_components():
    ratio = []
    for seed in range(6):
        run = drawn(300 + seed, 150, jumps=0.01)
        out = smoothed(run.ref, run.info, run.jerk, True)
        ratio.append(out.energy.sum(axis=0) / out.gamma.sum(axis=0))
    # 6 x 150 steps, each of which determines about one component of every axis' noise: sqrt(2 / 900) = 0.05.
    np.testing.assert_allclose(np.mean(ratio, axis=0), 1.0, atol=0.2)


@pytest.mark.parametrize("kind", RUNS)
def test_the_covariances_of_the_ends_are_those_of_the_dense_gaussian(kind):
    run = RUNS[kind]()
    ends = smoothed(run.ref, run.info, run.jerk, True).ends_P
    _, P = dense(run)
    for end, block in zip(ends, (P[:STATE, :STATE], P[-STATE:, -STATE:]), strict=True):
        sigma = np.sqrt(np.diagonal(block))
        np.testing.assert_allclose((end - block) / np.outer(sigma, sigma), 0, atol=1e-6)


def test_the_last_frame_agrees_with_the_filter():
    run = drawn(6, 200)
    x, pose_P, motion_P, *_ = smoothed(run.ref, run.info, run.jerk, True)
    d, P = np.zeros(STATE), np.diag(run.info.first_variance)
    for k in range(len(run.info.dt)):
        if k > 0:
            F, Q, away = transition(run.ref, run.info, run.jerk, k)
            d, P = F @ d + away, F @ P @ F.T + Q
        L, g = run.info.information[k], run.info.vector[k]
        # The causal tracker's update of a state at rest in the origin, which moves by the change of the deviation.
        R, t, m, P, _, _ = updated(np.eye(3), np.zeros(3), np.zeros(12), P, L, g - L @ d[:6])
        d = d + np.concatenate([Pose(R, t).minus(Pose.identity()), m])
    sigma = np.sqrt(np.diagonal(P))
    np.testing.assert_allclose((x[-1] - d) / sigma, 0, atol=1e-6)
    np.testing.assert_allclose((pose_P[-1] - P[:6, :6]) / np.outer(sigma[:6], sigma[:6]), 0, atol=1e-6)
    np.testing.assert_allclose((motion_P[-1] - P[6:12, 6:12]) / np.outer(sigma[6:12], sigma[6:12]), 0, atol=1e-6)


@pytest.mark.parametrize("chunk", further_slow([7, 12, 24, 25, 1], fast=4))
def test_the_size_of_the_chunks_does_not_change_the_result(chunk, monkeypatch):
    run = drawn(7, 24, without_spots=slice(5, 8))
    compiled = smoothed(run.ref, run.info, run.jerk, True)  # all in one chunk
    monkeypatch.setattr(fixed_interval, "MOST_FRAMES_AT_ONCE", 12)
    monkeypatch.setattr(fixed_interval, "CHUNK", chunk)
    parts = ("_empty_interval", "_filter_checkpoints", "_filter_chunk", "_combine", "_test_process_noise")
    for name in (*parts, "_predict_backward"):
        monkeypatch.setattr(fixed_interval, name, getattr(fixed_interval, name).py_func)
    for a, b in zip(smoothed.py_func(run.ref, run.info, run.jerk), compiled, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-18)


def test_a_run_of_several_chunks_has_no_error_where_they_meet():
    one, times = drawn(8, 516), 16  # drawing all frames takes ten seconds
    ref = Reference(*(np.concatenate([a] * times) for a in one.ref))
    info = RunInformation(*(np.concatenate([a] * times) for a in one.info[:6]), one.info.first_variance)
    run = Run(ref, info, np.tile(one.jerk, (times, 1)), np.tile(one.true, (times, 1)))
    x, pose_P, *_ = smoothed(run.ref, run.info, run.jerk, True)
    meet = 8 * fixed_interval.CHUNK
    assert len(x) >= max(meet + 40, fixed_interval.MOST_FRAMES_AT_ONCE + 1)
    # The frames near the seam by themselves: frames 20 frames away change less than a thousandth of a sigma.
    part = slice(meet - 100, meet + 40)
    info = RunInformation(*(a[part] for a in run.info[:6]), run.info.first_variance)
    alone_x, alone_P, *_ = smoothed(Reference(*(a[part] for a in run.ref)), info, run.jerk[part], True)
    sigma = np.sqrt(np.diagonal(pose_P, axis1=1, axis2=2))[part]
    seam = slice(70, 120)
    np.testing.assert_allclose((alone_x[:, :6] - x[part, :6])[seam] / sigma[seam], 0, atol=1e-3)
    np.testing.assert_allclose(alone_P[seam], pose_P[part][seam], rtol=1e-2, atol=1e-2 * np.max(sigma) ** 2)


def test_the_likelihood_is_the_product_of_the_innovations_gaussians():
    run = drawn(9, 25, without_spots=slice(9, 12))

    def both(factor: float) -> Array:
        return np.array([log_likelihood(run.ref, run.info, factor * run.jerk), log_evidence(run, factor * run.jerk)])

    at_truth = both(1.0)
    for factor in (0.01, 0.3, 5.0, 1000.0):
        ours, plain = both(factor) - at_truth
        assert ours == pytest.approx(plain, abs=1e-5)


def test_the_true_jerk_is_the_likeliest():
    run = drawn(10, 400)
    factors = np.array([0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0])
    values = [log_likelihood(run.ref, run.info, f * run.jerk) for f in factors]
    assert factors[int(np.argmax(values))] == 1.0
    likelihoods = [leave_one_out(run, f) for f in factors]
    assert factors[int(np.argmax(likelihoods))] in (0.3, 1.0, 3.0)


def test_the_leave_one_out_likelihood_agrees_with_leaving_each_frame_out():
    run = drawn(11, 10, without_spots=slice(4, 6))

    def directly(factor: float) -> float:
        total = 0.0
        for k in range(10):
            L = run.info.information[k]
            if not L.any():
                continue
            mean, P = dense(Run(run.ref, run.info, factor * run.jerk, run.true), without=k)
            own = slice(STATE * k, STATE * k + 6)
            C = np.linalg.inv(L)
            y, S = C @ run.info.vector[k] - mean[k, :6], P[own, own] + C
            total -= 0.5 * (y @ np.linalg.solve(S, y) + np.linalg.slogdet(S)[1])
        return total

    ours = [leave_one_out(run, f) for f in (1.0, 0.1, 50.0)]
    plain = [directly(f) for f in (1.0, 0.1, 50.0)]
    np.testing.assert_allclose(np.array(ours) - ours[0], np.array(plain) - plain[0], atol=1e-4)


def test_the_covariances_of_smoothed_states_are_right():
    chi2, motion = [], []
    for seed in range(6):
        run = drawn(100 + seed, 150, without_spots=slice(70, 80))
        x, pose_P, motion_P, *_ = smoothed(run.ref, run.info, run.jerk, True)
        d = x - run.true
        chi2 += [d[k, :6] @ np.linalg.solve(pose_P[k], d[k, :6]) / 6 for k in range(0, 150, 10)]
        motion += [d[k, 6:12] @ np.linalg.solve(motion_P[k], d[k, 6:12]) / 6 for k in range(0, 150, 10)]
    # 90 states ten frames apart: the mean of chi-square / 6 scatters by 0.06.
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.2)
    assert np.mean(motion) == pytest.approx(1.0, abs=0.25)


def test_a_velocity_jump_is_found_at_its_step_and_none_in_steady_motion():
    shocks = []
    for seed in range(8):
        run = drawn(200 + seed, 120)
        steady = smoothed(run.ref, run.info, run.jerk, True)[3]
        assert steady[0] == 0.0  # there is no step before the first frame
        shocks.append(steady[1:-5])
        run = drawn(200 + seed, 120, jump_at=61)
        jumped = smoothed(run.ref, run.info, run.jerk, True)[3]
        assert int(np.argmax(jumped)) == 61
        assert jumped[61] > 200
        for moment in (0.05, 0.95):  # near an end of its step it may be found in the next one
            run = drawn(200 + seed, 120, jump_at=61, moment=moment)
            jumped = smoothed(run.ref, run.info, run.jerk, True)[3]
            assert abs(int(np.argmax(jumped)) - 61) <= SHOCK_SEPARATION
            assert np.max(jumped) > 200
    alarms = np.concatenate(shocks)
    # Chi-square of 6 degrees of freedom: its mean is 6, and it exceeds 45 five times in 10^8.
    assert np.mean(alarms) == pytest.approx(6.0, abs=1.0)
    assert np.max(alarms) < 45


def test_a_jump_that_the_model_allows_for_is_not_a_shock():
    run = drawn(12, 80, jump_at=41)
    assert smoothed(run.ref, run.info, run.jerk, True)[3][41] > 200
    run.info.velocity_jump[41], run.info.acceleration_jump[41] = 16.0, 100.0
    shock = smoothed(run.ref, run.info, run.jerk, True)[3]
    assert shock[41] < 20
    assert np.max(shock) < 45


def test_a_reference_is_shifted_by_pose_errors_as_defined_in_the_contract():
    run = drawn(13, 5)
    there = shifted(run.ref, 10 * run.true)
    np.testing.assert_allclose(
        Pose(there.R, there.t).minus(Pose(run.ref.R, run.ref.t)), 10 * run.true[:, :6], atol=1e-12
    )
    np.testing.assert_allclose(there.m - run.ref.m, 10 * run.true[:, 6:], atol=1e-12)
