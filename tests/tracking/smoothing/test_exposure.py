"""A picture shows the mean of a spot's path over the exposure; the reported pose is that at its middle."""

import numpy as np
import pytest

from geometry.compiled_projection import project_all
from geometry.pose import Pose
from lab.simulate.points import simulate_points
from tracking.smoothing.motion.clocks import clock_sigmas
from tracking.smoothing.motion.process_noise import corner_offsets, with_errors_along_axes
from tracking.smoothing.motion.run_detections import Reference
from tracking.smoothing.systematic_errors import exposure_offsets, exposure_sigmas, pose_shift

EXPOSURE_S = 0.02


@pytest.fixture(scope="module")
def turning():
    """Poses of a run, with random velocities and accelerations."""
    run = simulate_points("smooth", 3, frames=12, clutter=0.0)
    rng = np.random.default_rng(4)
    m = rng.normal(0, [0.5] * 3 + [1.5] * 3 + [8.0] * 3 + [20.0] * 3, (12, 12))
    return run.model, Reference(run.poses.rotation, run.poses.translation, m)


def mean_over_exposure(model, motion):
    """Mean pixels (T, n, 2), by quadrature over many instants."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    out = 0.0
    for node, weight in zip(nodes, weights, strict=True):
        h = 0.5 * EXPOSURE_S * node
        pose = Pose(motion.R, motion.t).plus(h * motion.m[:, :6] + 0.5 * h * h * motion.m[:, 6:])
        out = out + 0.5 * weight * project_all(model.numbers, pose.rotation, pose.translation)[0]
    return out


def test_the_offset_is_the_mean_of_a_path_less_its_middle(turning):
    model, motion = turning
    offsets = exposure_offsets(model.numbers, motion, EXPOSURE_S, np.ones(12, dtype=bool))
    middle, _ = project_all(model.numbers, motion.R, motion.t)
    expected = mean_over_exposure(model, motion) - middle
    seen = np.isfinite(expected).all(axis=-1)
    assert np.abs(expected[seen]).max() > 0.1
    assert np.abs(offsets - expected)[seen].max() < 0.01 * np.abs(expected[seen]).max()


def test_the_pose_at_mid_exposure_follows_from_the_mean_pixels(turning):
    """It is the pose that fits the means best, less the shift that the offsets cause."""
    model, motion = turning
    offsets = exposure_offsets(model.numbers, motion, EXPOSURE_S, np.ones(12, dtype=bool))
    shift = pose_shift(model.numbers, motion, offsets)
    _, J = project_all(model.numbers, motion.R, motion.t)
    left = offsets - np.einsum("tnij,tj->tni", J, shift)
    fine = np.isfinite(left).all(axis=-1)
    assert np.sqrt(np.mean(left[fine] ** 2)) < 0.2 * np.sqrt(np.mean(offsets[fine] ** 2))


def test_frames_with_a_velocity_jump_and_runs_without_an_exposure_time_have_no_offsets(turning):
    model, motion = turning
    steady = np.arange(12) % 2 == 0
    offsets = exposure_offsets(model.numbers, motion, EXPOSURE_S, steady)
    assert not offsets[~steady].any()
    assert offsets[steady].any()
    assert not exposure_offsets(model.numbers, motion, 0.0, steady).any()
    assert not pose_shift(model.numbers, motion, offsets)[~steady].any()


def test_components_that_turn_at_different_moments_of_an_exposure_are_both_within_their_sigmas():
    """One of them turns at the middle of the exposure, the other just after its end: only the first has an error."""
    b = np.array([1e-3, 0.0, 0.0, 0.0, 0.0, 5e-4])  # corner_offsets: 1 mm and 0.5 mrad
    sigma = np.array([2e-5] * 3 + [1e-5] * 3)
    information = np.diag(sigma**-2)
    for error in (b * [1, 0, 0, 0, 0, 0], b * [0, 0, 0, 0, 0, 1], b):
        L, g, less = with_errors_along_axes(b, information, information @ error)
        nees = error @ L @ error / np.count_nonzero(b)
        assert 0.4 < nees < 1.1
        np.testing.assert_allclose(np.linalg.inv(L), np.diag(sigma**2 + b**2), rtol=1e-9, atol=1e-18)
        np.testing.assert_allclose(np.linalg.solve(L, g), error, atol=1e-9)
        assert less == pytest.approx(error @ information @ error - error @ L @ error)


def test_a_corner_in_the_first_or_last_exposure_of_a_zig_zag_is_within_its_sigma():
    """What was before the first picture is not known: if the motion turns in the others, it may turn in that one."""
    dt, exposure_s, turn = 0.04, 0.01, 0.6
    t = dt * np.arange(9)
    places, m = np.zeros((9, 3)), np.zeros((9, 12))
    places[:, 0], m[:, 0] = turn * np.abs(t - t[4]) / 2, turn * np.sign(t - t[4] + 1e-9) / 2
    motion = Reference(np.tile(np.eye(3), (9, 1, 1)), places, m)
    sigmas = corner_offsets(motion, np.arange(9) == 4, exposure_s, np.full(9, dt))
    error = turn * exposure_s / 8  # of the mean over an exposure that begins or ends with the turn in its middle
    assert sigmas[[0, -1], 0] == pytest.approx(error)
    assert not sigmas[[0, -1], 1:].any()
    assert not corner_offsets(motion, np.zeros(9, dtype=bool), exposure_s, np.full(9, dt)).any()


def test_a_corner_outside_the_exposure_does_not_hide_one_inside_it():
    """A common error along b, as one impact causes, does not cover an error of one component alone."""
    b = np.array([1e-3, 0.0, 0.0, 0.0, 0.0, 5e-4])
    information = np.diag(np.array([2e-5] * 3 + [1e-5] * 3) ** -2.0)
    error = b * [0, 0, 0, 0, 0, 1]
    along = np.linalg.inv(np.linalg.inv(information) + np.outer(b, b))
    axes, _, _ = with_errors_along_axes(b, information, information @ error)
    assert error @ along @ error / 6 > 50
    assert error @ axes @ error / 6 < 1


def test_a_component_that_accelerates_while_another_one_turns_has_the_offset_of_its_acceleration():
    """Three beams shake at a quarter of the frame rate: the steps in which one axis turns are taken for jumps."""
    dt, exposure_s, turn, acceleration = 0.04, 0.03, 0.5, 40.0
    t = dt * np.arange(-3, 4)
    places, m = np.zeros((7, 3)), np.zeros((7, 12))
    places[:, 0], m[:, 0] = turn * np.abs(t) / 2, turn * np.sign(t) / 2
    m[3, 0] = turn / 2
    places[:, 1], m[:, 1] = acceleration * t**2 / 2, acceleration * t
    m[2:4, 1] = 0.0  # its velocity does not jump with the other one's
    motion = Reference(np.tile(np.eye(3), (7, 1, 1)), places, m)
    both, without_jumps = exposure_sigmas(motion, np.arange(7) == 3, exposure_s, np.full(7, dt))
    assert both[3, 0] == pytest.approx(turn * exposure_s / 8)
    assert without_jumps[3, 0] == 0.0
    assert both[3, 1] == without_jumps[3, 1] == pytest.approx(acceleration * exposure_s**2 / 24)


@pytest.mark.parametrize("sigma_frames", [0.2, 0.5, 1.0, 1.5])
@pytest.mark.parametrize("period", [12.0, 30.0])
def test_poses_of_an_unknown_offset_have_the_errors_beyond_the_first_order_that_they_state(sigma_frames, period):
    """A swing, seen at unknown offsets from the frames: what the velocity times the offset does not contain."""
    dt, k = 0.025, np.arange(240.0)
    turn = 2 * np.pi / period
    places, m = np.zeros((len(k), 3)), np.zeros((len(k), 12))
    places[:, 0], m[:, 0] = np.sin(turn * k), np.cos(turn * k) * turn / dt
    motion = Reference(np.tile(np.eye(3), (len(k), 1, 1)), places, m)
    offset = np.random.default_rng(3).normal(size=4000) * sigma_frames
    errors = np.sin(turn * (k[:, None] + offset)) - places[:, :1] - m[:, :1] * dt * offset
    sigmas = clock_sigmas(motion, sigma_frames * dt, np.full(len(k), dt))
    assert not sigmas[:, 1:].any()
    rms = np.sqrt(np.mean(errors**2, axis=1))
    # Where a swing's acceleration is zero the third order is left.
    assert np.all(rms < 1.5 * sigmas[:, 0])
    over = np.sqrt(np.mean(rms**2) / np.mean(sigmas[:, 0] ** 2))
    assert 0.2 < over < 1.0
    assert not clock_sigmas(motion, 0.0, np.full(len(k), dt)).any()
