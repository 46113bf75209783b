"""Rotations: inverses, limiting cases (zero, a half turn, a pitch of 90 degrees), and against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geometry import rotations
from geometry.arrays import numeric_jacobian

number = st.floats(-1, 1)
axes = st.tuples(number, number, number).filter(lambda v: np.linalg.norm(v) > 0.1)
# Angles near zero, near the switch to a series at 1e-4, ordinary ones, and near half a turn.
angles = st.one_of(
    st.sampled_from([0.0, 1e-12, 1e-9, 0.99e-4, 1.01e-4, 1e-3, np.pi - 1e-9, np.pi - 1e-12, np.pi]),
    st.floats(0, np.pi),
)
turns = st.builds(lambda axis, angle: np.array(axis) / np.linalg.norm(axis) * angle, axes, angles)
ROUNDING = 4e-15  # rounding of unit vectors after a dozen operations


@given(turn=turns)
def test_the_exponential_equals_scipys(turn):
    np.testing.assert_allclose(rotations.exp(turn), Rotation.from_rotvec(turn).as_matrix(), rtol=0, atol=ROUNDING)


@given(turn=turns)
def test_exp_is_the_inverse_of_log(turn):
    R = Rotation.from_rotvec(turn).as_matrix()
    np.testing.assert_allclose(rotations.exp(rotations.log(R)), R, rtol=0, atol=ROUNDING)


@given(turn=turns.filter(lambda v: np.linalg.norm(v) < np.pi - 1e-9))
def test_log_is_the_inverse_of_exp(turn):
    np.testing.assert_allclose(rotations.log(rotations.exp(turn)), turn, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("small", [1e-9, 1e-12, 1e-15])
def test_a_small_turn_keeps_its_digits(small):
    turn = small * np.array([0.6, -0.48, 0.64])
    np.testing.assert_allclose(rotations.log(rotations.exp(turn)), turn, rtol=1e-12)


@given(turn=turns)
def test_the_largest_angle_is_half_a_turn(turn):
    R = rotations.exp(turn)
    assert rotations.angle(R) <= np.pi + ROUNDING
    assert rotations.angle(R) == pytest.approx(np.linalg.norm(turn), abs=ROUNDING)


@given(turn=turns)
def test_a_quaternion_has_unit_length_and_w_of_zero_or_more_and_equals_scipys(turn):
    R = Rotation.from_rotvec(turn)
    q = rotations.quaternion_from_matrix(R.as_matrix())
    assert q[0] >= 0
    assert np.linalg.norm(q) == pytest.approx(1, abs=1e-15)
    expected = R.as_quat(scalar_first=True)
    assert min(np.abs(q - expected).max(), np.abs(q + expected).max()) < ROUNDING


@given(turn=turns, scale=st.floats(0.01, 100), sign=st.sampled_from([-1, 1]))
def test_the_rotation_of_a_quaternion_does_not_depend_on_its_length_and_sign(turn, scale, sign):
    R = Rotation.from_rotvec(turn)
    q = sign * scale * R.as_quat(scalar_first=True)
    np.testing.assert_allclose(rotations.matrix_from_quaternion(q), R.as_matrix(), rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_a_turn_about_an_axis_has_that_axis(axis):
    R = 2 * np.outer(axis, axis) - np.eye(3)
    np.testing.assert_allclose(np.abs(rotations.log(R)), np.pi * axis, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(np.abs(rotations.quaternion_from_matrix(R)), [0, *axis], rtol=0, atol=ROUNDING)


@given(yaw=st.floats(-3.1, 3.1), pitch=st.floats(-1.5, 1.5), roll=st.floats(-3.1, 3.1))
def test_yaw_pitch_roll_equal_scipys_and_are_recovered(yaw, pitch, roll):
    ypr = np.array([yaw, pitch, roll])
    R = rotations.matrix_from_ypr(ypr)
    np.testing.assert_allclose(R, Rotation.from_euler("ZYX", ypr).as_matrix(), rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(rotations.ypr_from_matrix(R), ypr, rtol=0, atol=1e-13)  # cos(1.5) costs a digit


def test_positive_angles_turn_the_nose_left_and_down_and_the_left_side_up():
    nose, left = np.array([1.0, 0, 0]), np.array([0.0, 1, 0])
    quarter = np.pi / 2
    np.testing.assert_allclose(rotations.matrix_from_ypr(np.array([quarter, 0, 0])) @ nose, left, atol=ROUNDING)
    np.testing.assert_allclose(rotations.matrix_from_ypr(np.array([0, quarter, 0])) @ nose, [0, 0, -1], atol=ROUNDING)
    np.testing.assert_allclose(rotations.matrix_from_ypr(np.array([0, 0, quarter])) @ left, [0, 0, 1], atol=ROUNDING)


@given(
    yaw=st.floats(-3.1, 3.1),
    roll=st.floats(-3.1, 3.1),
    side=st.sampled_from([-1, 1]),
    short=st.sampled_from([0.0, 1e-15, 1e-12, 1e-10, 2e-9, 1e-8, 1e-6, 1e-3]),
)
def test_near_a_pitch_of_90_degrees_the_angles_still_reproduce_the_rotation(yaw, roll, side, short):
    # By way of scipy's quaternion, so that the matrix has the rounding errors of any other.
    R = Rotation.from_euler("ZYX", [yaw, side * (np.pi / 2 - short), roll]).as_matrix()
    again = rotations.matrix_from_ypr(rotations.ypr_from_matrix(R))
    # Closer than 1e-9 rad to the pole, yaw and roll are not distinguished, which causes an error of that size.
    np.testing.assert_allclose(again, R, rtol=0, atol=2e-9 if short < 1e-9 else 1e-14)


@pytest.mark.parametrize("side", [-1, 1])
def test_at_a_pitch_of_90_degrees_roll_is_zero(side):
    R = rotations.matrix_from_ypr(np.array([0.5, side * np.pi / 2, 0.3]))
    np.testing.assert_allclose(
        rotations.ypr_from_matrix(R), [0.5 - side * 0.3, side * np.pi / 2, 0], rtol=0, atol=ROUNDING
    )


@given(turn=turns)
def test_the_right_jacobian_equals_finite_differences(turn):
    R = rotations.exp(turn)
    differences = numeric_jacobian(lambda v: rotations.log(R.T @ rotations.exp(v)), turn)
    np.testing.assert_allclose(rotations.right_jacobian(turn), differences, rtol=0, atol=1e-8)


@given(axis=axes)
def test_the_right_jacobian_is_continuous_where_its_series_begins(axis):
    direction = np.array(axis) / np.linalg.norm(axis)
    below, above = (rotations.right_jacobian(direction * 1e-4 * s) for s in (1 - 1e-9, 1 + 1e-9))
    np.testing.assert_allclose(below, above, rtol=0, atol=2e-12)  # 1 - cos(1e-4) has eight digits, times 1e-4


@given(yaw=st.floats(-3, 3), pitch=st.floats(-1.3, 1.3), roll=st.floats(-3, 3))
def test_the_jacobian_of_the_angles_equals_finite_differences(yaw, pitch, roll):
    R = rotations.matrix_from_ypr(np.array([yaw, pitch, roll]))
    differences = numeric_jacobian(lambda d: rotations.ypr_from_matrix(R @ rotations.exp(d)), np.zeros(3))
    np.testing.assert_allclose(rotations.ypr_jacobian(R), differences, rtol=0, atol=2e-8)


def test_a_stack_gives_the_same_as_each_element_alone():
    vectors = np.random.default_rng(3).normal(0, 1, (2, 5, 3))
    vectors[0, 0], vectors[0, 1] = 0, [0, 0, np.pi]
    R = rotations.exp(vectors)
    of_matrix = (
        rotations.log, rotations.angle, rotations.quaternion_from_matrix, rotations.ypr_from_matrix,
        rotations.ypr_jacobian,
    )  # fmt: skip
    for i, j in np.ndindex(2, 5):
        np.testing.assert_allclose(R[i, j], rotations.exp(vectors[i, j]), atol=ROUNDING)
        np.testing.assert_allclose(
            rotations.right_jacobian(vectors)[i, j], rotations.right_jacobian(vectors[i, j]), atol=ROUNDING
        )
        for f in of_matrix:
            np.testing.assert_allclose(f(R)[i, j], f(R[i, j]), atol=1e-13)


def test_the_rotation_nearest_to_a_mean_matrix_is_the_mean_of_scipy_and_turns_with_the_rotations():
    matrices = rotations.exp(np.random.default_rng(3).normal(0.0, 0.5, (40, 3)))
    mean = rotations.nearest_rotation(matrices.mean(axis=0))
    np.testing.assert_allclose(mean, Rotation.from_matrix(matrices).mean().as_matrix(), atol=1e-14)
    turn = rotations.exp(np.array([2.0, -1.0, 0.5]))
    np.testing.assert_allclose(rotations.nearest_rotation((turn @ matrices).mean(axis=0)), turn @ mean, atol=1e-14)
    np.testing.assert_allclose(rotations.nearest_rotation(matrices[0]), matrices[0], atol=1e-15)
