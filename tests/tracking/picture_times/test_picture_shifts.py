"""Spots that are not exposed at their frame's instant: shifts, and what they say about the state."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.compiled_linalg import pose_plus
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from lab.simulate.scenarios import RIGS
from tracking.detections import PictureClock
from tracking.rigid_body.models.information import add_clock_errors, exposed_after, picture_shifts, timed_spot
from tracking.rigid_body.models.motion import state_after
from tracking.smoothing.motion.run_detections import Between, Delays, Reference, RunDetections, moved_detections

MODEL = SpotModel.of(RIGS["four-skew-beams"]())
R, T = np.eye(3), np.zeros(3)
M = np.array([0.5, -0.3, 0.2, 0.4, -0.2, 0.6, 1.0, 2.0, -1.0, 3.0, -2.0, 1.0])
NO_P = np.zeros((6, 6))


def pixels_after(s: float) -> np.ndarray:
    R_then, t_then, _ = state_after(R, T, M, s)
    return MODEL.project(Pose(R_then, t_then))[0]


def test_a_late_picture_shows_the_spots_where_they_are_then():
    clocks = np.array([[0.0, 0.0, 0.0], [0.004, 0.0, 511.5]])
    shift, _ = picture_shifts(MODEL.numbers, MODEL.camera_of, clocks, R, T, M, NO_P)
    late = MODEL.camera_of == 1
    np.testing.assert_array_equal(shift[~late], 0.0)
    np.testing.assert_allclose(shift[late], (pixels_after(0.004) - pixels_after(0.0))[late], atol=1e-9)


def test_a_rolling_shutter_shows_each_spot_in_the_row_that_is_exposed_then():
    clock = PictureClock(0.001, 1.5e-5, 511.5)
    clocks = np.array([clock.numbers, clock.numbers])
    shift, _ = picture_shifts(MODEL.numbers, MODEL.camera_of, clocks, R, T, M, NO_P)
    shown = pixels_after(0.0) + shift
    for i in range(len(MODEL)):
        s = exposed_after(clocks[0], shown[i, 1])
        assert s == pytest.approx(float(clock.after_s(shown[i, 1])))
        np.testing.assert_allclose(pixels_after(s)[i], shown[i], atol=1e-4)


def test_the_covariance_of_a_shift_is_that_of_the_way_in_that_time():
    clocks = np.array([[0.004, 0.0, 511.5]] * 2)
    _, cov = picture_shifts(MODEL.numbers, MODEL.camera_of, clocks, R, T, np.zeros(12), np.eye(6) * 0.1**2)
    J = MODEL.project(Pose(R, T))[1]
    np.testing.assert_allclose(cov, (0.1 * 0.004) ** 2 * J @ np.swapaxes(J, 1, 2), rtol=1e-9)


def test_an_unknown_instant_widens_each_point_along_the_way_of_its_spot():
    clock = PictureClock(0.0, 1.5e-5, 511.5, 0.002, 2e-6)
    late = np.flatnonzero(MODEL.camera_of == 1)
    errors = np.array([[0.0, 0.0, 511.5], [clock.sigma_s, clock.row_sigma_s, clock.middle_row]])
    spots, J = (a[late] for a in MODEL.project(Pose(R, T)))
    speed, v = J @ M[:6], spots[:, 1]
    cov, none, first = np.zeros((2 + len(late), 2, 2)), np.zeros((2, 2)), np.array([0, 2, 2 + len(late)])
    uv = np.concatenate([none, spots + 0.1])  # two points of the first camera, whose clock is known
    add_clock_errors(MODEL.numbers, MODEL.camera_of, errors, R, T, M, NO_P, first, uv, 8.0, cov)
    np.testing.assert_array_equal(cov[:2], 0.0)
    expected = clock.variance_s2(v + 0.1)[:, None, None] * speed[:, :, None] * speed[:, None, :]
    np.testing.assert_allclose(cov[2:], expected, rtol=1e-9)
    # What is open about the velocity adds the way in that time, up to a limit.
    wide = np.zeros_like(cov)
    add_clock_errors(MODEL.numbers, MODEL.camera_of, errors, R, T, 0 * M, np.eye(6) * 1e6, first, uv, 8.0, wide)
    np.testing.assert_allclose(np.trace(wide[2:], axis1=1, axis2=2) / 2, 8.0**2, rtol=1e-9)


def test_points_are_moved_to_their_frames_instant_as_their_spots_move():
    """Their covariance grows by that of the way; points without a label move as the spots nearest to them."""
    after, jerk, n = 0.004, 2e6, len(MODEL)
    R_then, t_then, _ = state_after(R, T, M, after)
    uv, J = MODEL.project(Pose(R_then, t_then))
    cov = np.tile([[0.02, 0.005], [0.005, 0.03]], (n, 1, 1))
    first = np.searchsorted(MODEL.camera_of, [[0, 1, 2]])
    seen = RunDetections(uv, cov, np.zeros(n), np.array([0, n]), first, np.ones((1, 2), bool), np.ones(n), np.ones(n))
    delays = Delays(np.full(n, after), np.zeros(n), np.zeros(n), np.array([[[after, 0.0, 511.5]] * 2]))
    m_then = M + np.concatenate([after * M[6:], np.zeros(6)])
    ref = Reference(*(np.stack(pair) for pair in ((R, R_then), (T, t_then), (M, m_then))))
    jump, moment = np.array([[0.0, 0.0], [0.5, 0.5]]), np.array([[-1.0, 0.0], [0.002, 1e-4]])
    velocity_P = np.tile(np.eye(6) * 0.1**2, (2, 1, 1))
    between = Between(
        np.array([0.0, after]), np.array([0]), ref, velocity_P, np.full((2, 6), jerk), jump, moment
    )  # fmt: skip
    labels = np.where(np.arange(n) % 2, np.arange(n) - first[0, MODEL.camera_of], -1)[None]
    moved = moved_detections(MODEL.numbers, MODEL.camera_of, seen, delays, labels, between)
    np.testing.assert_allclose(moved[0], pixels_after(0.0), atol=1e-9)
    # Of the way, in m and rad: by the velocities, the jerk, and when the velocities jump.
    variance = (0.1 * after) ** 2 + jerk * after**5 / 20 + 0.5 * 1e-4**2
    np.testing.assert_allclose(moved[1], cov + variance * J @ np.swapaxes(J, 1, 2), rtol=1e-9)


@pytest.mark.parametrize("after", [-0.006, 0.0, 0.004])
def test_the_jacobian_by_the_state_is_that_of_finite_differences(after):
    at, J, H = np.empty(2), np.empty((2, 6)), np.empty((2, 18))
    for view in (0, len(MODEL) - 1):
        projected, _ = timed_spot(MODEL.numbers, view, R, T, M, after, at, J, H)
        assert projected
        exact, here = H.copy(), np.empty((2, 2))
        for k in range(18):
            for side, sign in enumerate((1.0, -1.0)):
                d = np.zeros(18)
                d[k] = sign * 1e-5
                R_k, t_k = pose_plus(R, T, d)
                timed_spot(MODEL.numbers, view, R_k, t_k, M + d[6:], after, here[side], J, H)
            np.testing.assert_allclose((here[0] - here[1]) / 2e-5, exact[:, k], rtol=2e-3, atol=2e-2)
