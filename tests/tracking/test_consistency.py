"""Consistency of reported poses with their own spots and with the causal pass: false alarms and detection of errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import fit_pose
from tests.geometry.scenes import paper_rig, random_pose
from tracking.consistency import (
    CausalAgreement,
    SpotAgreement,
    against_causal,
    against_own_spots,
    contradictory,
    is_covariance,
    mahalanobis2,
)

MODEL = SpotModel.of(paper_rig())
N = len(MODEL)
NOISE_PX = 0.1
FRAMES = 2000


def frames(rng: np.random.Generator, count: int = FRAMES) -> tuple[Pose, np.ndarray, np.ndarray, np.ndarray]:
    """True poses (T,), spots seen in the picture (T, n), measured pixels and their covariances."""
    poses = [random_pose(rng, 0.1, 0.1) for _ in range(count)]
    true = Pose(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses]))
    uv, _ = MODEL.project(true)
    used = MODEL.in_picture(uv)
    cov = np.broadcast_to(NOISE_PX**2 * np.eye(2), (count, N, 2, 2)).copy()
    return true, used, uv + NOISE_PX * rng.standard_normal(uv.shape), cov


def fitted(true: Pose, used: np.ndarray, uv: np.ndarray, cov: np.ndarray) -> tuple[Pose, np.ndarray]:
    """Each frame's own fit and its covariance."""
    fits = []
    for k in range(len(uv)):
        rows = np.flatnonzero(used[k])
        fit = fit_pose(MODEL, rows, uv[k, rows], cov[k, rows], true[k])
        assert fit is not None
        fits.append(fit)
    poses = [f.world_from_body for f in fits]
    stacked = Pose(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses]))
    return stacked, np.stack([f.covariance for f in fits])


def test_the_false_alarm_rate_of_correct_poses_is_as_stated():
    """At p = 0.01 instead of 1e-6, to have enough events: poses estimated without the spots, and fits to them."""
    rng = np.random.default_rng(1)
    true, used, uv, cov = frames(rng)
    P = np.diag([3e-4**2] * 3 + [1e-4**2] * 3)
    apart = true.plus(rng.multivariate_normal(np.zeros(6), P, FRAMES))
    alone = against_own_spots(MODEL, apart, np.broadcast_to(P, (FRAMES, 6, 6)), used, uv, cov, p=0.01)
    assert alone.contradicts.mean() == pytest.approx(0.01, abs=0.01)  # 4.5 sigma of that many
    assert against_own_spots(MODEL, apart, np.broadcast_to(P, (FRAMES, 6, 6)), used, uv, cov).contradicts.sum() == 0
    fit, C = fitted(true[slice(0, 300)], used[:300], uv[:300], cov[:300])
    own = against_own_spots(MODEL, fit, C, used[:300], uv[:300], cov[:300], p=0.01)
    assert own.contradicts.mean() <= 0.01


@pytest.mark.parametrize("sigmas", [15.0, 200.0])
def test_a_pose_away_from_its_spots_contradicts_them(sigmas):
    """The frame's own fit has a small residual, but the reported pose is off, with a small stated covariance."""
    rng = np.random.default_rng(2)
    true, used, uv, cov = frames(rng, 100)
    fit, C = fitted(true, used, uv, cov)
    largest = np.sqrt(np.linalg.eigvalsh(C)[:, -1])
    direction = np.linalg.eigh(C)[1][:, :, -1]
    off = fit.plus(sigmas * largest[:, None] * direction)
    agreement = against_own_spots(MODEL, off, C / 16, used, uv, cov)
    assert agreement.contradicts.all()
    assert np.all(agreement.rms_px > 3 * NOISE_PX)


def test_a_pose_with_a_large_covariance_may_lie_far_from_its_spots():
    rng = np.random.default_rng(3)
    true, used, uv, cov = frames(rng, 50)
    P = np.broadcast_to(np.diag([0.01**2] * 3 + [0.005**2] * 3), (50, 6, 6))  # 5 px
    off = true.plus(rng.standard_normal((50, 6)) * np.array([0.01] * 3 + [0.005] * 3))
    assert not against_own_spots(MODEL, off, P, used, uv, cov).contradicts.any()
    assert against_own_spots(MODEL, off, P * 1e-6, used, uv, cov).contradicts.all()


def test_chi_square_agrees_with_the_inverse_of_the_joint_covariance():
    """A second computation of chi-square: the joint covariance of all pixels, inverted directly."""
    rng = np.random.default_rng(4)
    true, used, uv, cov = frames(rng, 20)
    A = rng.standard_normal((6, 6)) * np.array([1e-2] * 3 + [3e-3] * 3)[:, None]
    P = A @ A.T
    off = true.plus(np.full((20, 6), 0.05))
    agreement = against_own_spots(MODEL, off, np.broadcast_to(P, (20, 6, 6)), used, uv, cov)
    for k in range(20):
        rows = np.flatnonzero(used[k])
        projected, J = MODEL.project(off[k])
        e, H = (uv[k, rows] - projected[rows]).ravel(), J[rows].reshape(-1, 6)
        S = NOISE_PX**2 * np.eye(len(e)) + H @ P @ H.T
        assert agreement.chi2[k] == pytest.approx(e @ np.linalg.solve(S, e), rel=1e-6)
        assert agreement.dof[k] == len(e)
        assert agreement.rms_px[k] == pytest.approx(np.sqrt(np.mean(e**2)))


def test_frames_without_pose_or_spots_never_contradict():
    rng = np.random.default_rng(5)
    true, used, uv, cov = frames(rng, 3)
    true.translation[0] = np.nan
    used[1] = False
    uv[2, ~used[2]] = np.nan
    cov[2, ~used[2]] = np.nan
    agreement = against_own_spots(MODEL, true, np.broadcast_to(1e-8 * np.eye(6), (3, 6, 6)), used, uv, cov)
    assert agreement.dof.tolist()[:2] == [0, 0]
    assert np.isnan(agreement.rms_px[:2]).all()
    assert not agreement.contradicts.any()
    assert np.isfinite(agreement.chi2).all()


def test_smoothed_and_causal_poses_of_the_same_measurements_agree_and_a_shifted_one_does_not():
    """Two estimators of one truth; the better one has half the sigmas and uses all measurements of the other."""
    rng = np.random.default_rng(6)
    true = Pose.identity().plus(np.zeros((FRAMES, 6)))
    scale = np.array([1e-3] * 3 + [1e-4] * 3)
    better, rest = scale * rng.standard_normal((2, FRAMES, 6)) * np.array([0.5, np.sqrt(0.75)])[:, None, None]
    P = np.broadcast_to(np.diag(scale**2), (FRAMES, 6, 6))
    smoothed, causal = true.plus(better), true.plus(better + rest)
    assert against_causal(smoothed, P / 4, causal, P, p=0.01).contradicts.mean() < 0.01
    shifted = smoothed.plus(np.array([8e-3, 0, 0, 0, 0, 0]))
    agreement = against_causal(shifted, P / 4, causal, P)
    assert agreement.contradicts.mean() > 0.7
    assert np.median(agreement.distance) == pytest.approx(8 / np.sqrt(1.25), rel=0.1)
    nowhere = replace(causal, translation=np.full((FRAMES, 3), np.nan))
    missing = against_causal(smoothed, P / 4, nowhere, P)
    assert np.isnan(missing.distance).all()
    assert not missing.contradicts.any()


def agreement_of(contradicts: bool, spots: int) -> SpotAgreement:
    return SpotAgreement(np.zeros(1), np.array([2 * spots]), np.zeros(1), np.array([contradicts]))


@pytest.mark.parametrize(
    ("own", "measured", "disagree", "causal_own", "accepted"),
    [
        ((False, 6), True, False, (False, 6), True),
        ((True, 6), True, False, (False, 6), False),  # its own spots contradict it
        ((False, 6), True, True, (False, 6), True),  # six spots confirm it: the causal pose was late at a bend
        ((False, 3), True, True, (False, 3), False),  # three spots fit any pose
        ((False, 0), False, True, (False, 3), False),  # no spot, and the causal pass has some
        ((False, 0), False, True, (False, 0), True),  # the causal pose is from the motion model, which has no bends
        ((False, 0), False, True, (True, 3), True),  # the causal pose contradicts its own spots
    ],
)
def test_which_frames_are_rejected(own, measured, disagree, causal_own, accepted):
    causal = CausalAgreement(np.zeros(1), np.array([disagree]))
    bad = contradictory(agreement_of(*own), np.array([measured]), causal, agreement_of(*causal_own))
    assert bad[0] == (not accepted)


def test_without_a_causal_pass_only_the_spots_decide():
    assert contradictory(agreement_of(True, 6), np.array([True]))[0]
    assert not contradictory(agreement_of(False, 3), np.array([True]))[0]


@pytest.mark.parametrize(
    ("matrix", "valid"),
    [
        (np.diag([1e-14, 1.0, 1e8]), True),  # units differ
        (np.diag([1.0, 0.0, 1.0]), False),
        (np.diag([1.0, -1e-12, 1.0]), False),
        (np.array([[1.0, 1.1, 0], [1.1, 1.0, 0], [0, 0, 1]]), False),
        (np.array([[1.0, 0.5, 0], [0.4, 1.0, 0], [0, 0, 1]]), False),
        (np.full((3, 3), np.nan), False),
        (np.diag([1.0, np.inf, 1.0]), False),
    ],
)
def test_only_valid_covariances_are_accepted(matrix, valid):
    assert is_covariance(matrix) == valid
    assert is_covariance(np.stack([matrix, np.eye(3)])).tolist() == [valid, True]


def test_the_mahalanobis_distance_does_not_depend_on_units():
    rng = np.random.default_rng(7)
    A = rng.standard_normal((50, 6, 6))
    C, gap = A @ np.swapaxes(A, -1, -2), rng.standard_normal((50, 6))
    units = np.array([1e3, 1.0, 1e-6, 10.0, 1e4, 1e-3])
    expected = np.einsum("ti,tij,tj->t", gap, np.linalg.inv(C), gap)
    np.testing.assert_allclose(mahalanobis2(gap, C), expected, rtol=1e-6)
    np.testing.assert_allclose(mahalanobis2(gap * units, C * np.outer(units, units)), expected, rtol=1e-6)
