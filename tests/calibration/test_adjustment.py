"""The least-squares solver: against dense algebra, in limiting cases, and its covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.least_squares.adjustment import (
    AdjustmentError,
    Cauchy,
    Limits,
    Linearised,
    Lines,
    Loss,
    Part,
    Poses,
    Prior,
    Values,
    Vectors,
    independent,
    solve,
)
from geometry.arrays import normalised, numeric_jacobian
from geometry.pose import Pose
from tests.geometry.scenes import random_pose

seeds = st.integers(0, 2**32 - 1)


@dataclass(frozen=True)
class Linear:
    """a_i x[index_i] + b_i y = z_i + noise of 1: two stacks, x of many unknowns and y of one."""

    index: np.ndarray
    a: np.ndarray  # (N, 2, 2)
    b: np.ndarray  # (N, 2, 3)
    z: np.ndarray  # (N, 2)
    loss: Loss | None = None

    def linearise(self, values: Values) -> Linearised:
        x, y = values["x"].array, values["y"].array
        r = (self.a @ x[self.index][..., None])[..., 0] + self.b @ y[0] - self.z
        zero = np.zeros(len(r), dtype=int)
        return Linearised(r, [Part("x", self.index, self.a), Part("y", zero, self.b)])


def linear_problem(rng: np.random.Generator, loss: Loss | None = None, count: int = 60) -> tuple[dict, Linear]:
    index = np.concatenate([np.arange(7), rng.integers(0, 7, count - 7)])
    a, b = rng.normal(size=(count, 2, 2)), rng.normal(size=(count, 2, 3))
    truth = {"x": Vectors(rng.normal(size=(7, 2))), "y": Vectors(rng.normal(size=(1, 3)))}
    z = (a @ truth["x"].array[index][..., None])[..., 0] + b @ truth["y"].array[0] + rng.normal(size=(count, 2))
    return truth, Linear(index, a, b, z, loss)


def dense(term: Linear, at: np.ndarray) -> np.ndarray:
    J = np.zeros((len(term.z), 2, 17))
    for n, i in enumerate(term.index):
        J[n, :, 2 * i : 2 * i + 2] = term.a[n]
    J[..., 14:] = term.b
    return J.reshape(-1, 17)[:, at]


START = {"x": Vectors(np.zeros((7, 2))), "y": Vectors(np.zeros((1, 3)))}


@dataclass
class Counted:
    """Two numbers whose difference is known to 1e-4 of their sum; how often it was linearised."""

    count: int = 0
    loss: Loss | None = None

    def linearise(self, values: Values) -> Linearised:
        self.count += 1
        J = np.array([[1.0, 1.0], [1e-4, -1e-4]])
        r = J @ values["x"].array[0] - J @ [3.0, 1.0] * 1e3
        return Linearised(r[None], [Part("x", np.zeros(1, dtype=int), J[None])])


def test_weak_directions_take_one_step_with_little_damping_and_several_with_the_usual_one():
    counts = []
    for limits in (Limits(), Limits(damping=1e-12)):
        term = Counted()
        found = solve({"x": Vectors(np.zeros((1, 2)))}, [term], {"x": True}, limits)
        # The size of the last step is 1e-3 sigmas; the weak direction has sigmas of 7e3.
        np.testing.assert_allclose(found.values["x"].array[0], [3e3, 1e3], atol=10)
        counts.append(term.count)
    assert counts[1] <= 3 < counts[0]


class Valley(Counted):
    """The valley of Rosenbrock (1960), "An automatic method for finding the greatest or least value", Comp. J. 3."""

    def linearise(self, values: Values) -> Linearised:
        self.count += 1
        x, y = values["x"].array[0]
        J = np.array([[-60 * x, 30.0], [1.0, 0.0]])
        return Linearised(np.array([[30 * (y - x * x), x - 1]]), [Part("x", np.zeros(1, dtype=int), J[None])])


def test_a_narrow_curved_valley_is_followed_in_few_steps():
    valley = Valley()
    found = solve({"x": Vectors(np.array([[-1.2, 1.0]]))}, [valley], {"x": True})
    np.testing.assert_allclose(found.values["x"].array[0], 1, atol=2e-3)  # a step of 1e-3 sigmas ends the iteration
    assert valley.count < 20  # 74 without the second derivatives


@settings(max_examples=30)
@given(seed=seeds)
def test_sparse_and_dense_algebra_agree_in_values_and_covariance(seed):
    _, term = linear_problem(np.random.default_rng(seed))
    J = dense(term, np.arange(17))
    best = np.linalg.lstsq(J, term.z.ravel(), rcond=None)[0]
    found = solve(START, [term], {"x": True, "y": True})
    covariance = np.linalg.inv(J.T @ J)
    sigmas = np.sqrt(np.diagonal(covariance))
    away = np.concatenate([found.values["x"].array.ravel(), found.values["y"].array.ravel()]) - best
    assert np.all(np.abs(away) < 1e-3 * sigmas)  # the engine's own stop
    got = found.covariance([("y", 0), ("x", 3), ("x", 0)])
    order = [14, 15, 16, 6, 7, 0, 1]
    np.testing.assert_allclose(got, covariance[np.ix_(order, order)], rtol=1e-8, atol=1e-10)
    information = found.reduced_normal([("y", 0)])
    np.testing.assert_allclose(information, np.linalg.inv(covariance[14:, 14:]), rtol=1e-8, atol=1e-10)
    assert found.dof == 2 * 60 - 17


def test_fixed_numbers_keep_their_values_and_have_no_variance():
    _, term = linear_problem(np.random.default_rng(1))
    mask = np.array([[True, False, True]])
    found = solve(START, [term], {"x": True, "y": mask})
    assert found.values["y"].array[0, 1] == 0.0
    covariance = found.covariance([("y", 0)])
    assert np.all(covariance[1] == 0)
    J = dense(term, np.delete(np.arange(17), 15))
    np.testing.assert_allclose(covariance[np.ix_([0, 2], [0, 2])], np.linalg.inv(J.T @ J)[14:, 14:], rtol=1e-8)


def test_an_undetermined_direction_is_returned_and_has_no_covariance():
    _, term = linear_problem(np.random.default_rng(2))
    b = term.b.copy()
    b[..., 2] = 2 * b[..., 0]  # only y0 + 2 y2 has an effect
    found = solve(START, [Linear(term.index, term.a, b, term.z)], {"x": True, "y": True})
    with pytest.raises(AdjustmentError, match="do not determine"):
        found.covariance([("y", 0)])
    (direction,) = found.undetermined([("y", 0)])
    np.testing.assert_allclose(direction / direction[0], [1, 0, -0.5], atol=1e-6)


def test_a_prior_on_an_undetermined_direction_determines_it():
    _, term = linear_problem(np.random.default_rng(3))
    b = term.b.copy()
    b[..., 2] = 0
    known = Vectors(np.array([[0.0, 0.0, 4.0]]))
    prior = Prior((("y", 0),), (known,), np.diag([np.inf, np.inf, 0.25]))
    found = solve(START, [Linear(term.index, term.a, b, term.z), prior], {"x": True, "y": True})
    assert found.values["y"].array[0, 2] == pytest.approx(4.0)
    assert found.covariance([("y", 0)])[2, 2] == pytest.approx(0.25)


def test_with_a_robust_loss_outliers_have_little_influence():
    truth, term = linear_problem(np.random.default_rng(4), Cauchy(), count=300)
    z = term.z.copy()
    z[10:20] += 200.0
    clean = solve(START, [term], {"x": True, "y": True})
    found = solve(START, [Linear(term.index, term.a, term.b, z, Cauchy())], {"x": True, "y": True})
    sigmas = np.sqrt(np.diagonal(clean.covariance([("y", 0)])))
    assert np.all(np.abs(found.values["y"].array - clean.values["y"].array) < 0.5 * sigmas)
    assert np.all(found.weights[0][10:20] < 0.01)
    least_squares = solve(START, [Linear(term.index, term.a, term.b, z)], {"x": True, "y": True})
    assert np.any(np.abs(least_squares.values["y"].array - truth["y"].array) > 5 * sigmas)


def test_start_values_without_finite_residuals_are_refused():
    _, term = linear_problem(np.random.default_rng(5))
    broken = Linear(term.index, term.a, term.b, np.full_like(term.z, np.nan))
    with pytest.raises(AdjustmentError, match="start values"):
        solve(START, [broken], {"x": True})


@settings(max_examples=40)
@given(seed=seeds)
def test_minus_is_the_inverse_of_plus_for_each_kind_of_unknown(seed):
    rng = np.random.default_rng(seed)
    delta = rng.normal(scale=1e-4, size=(2, 6))
    poses = Poses.of([random_pose(rng), random_pose(rng)])
    np.testing.assert_allclose(poses.plus(delta).minus(poses), delta, atol=1e-12)
    lines = Lines(rng.normal(size=(2, 3)), normalised(rng.normal(size=(2, 3))))
    # The direction is normalised, and the point opposite the old one shifts along the line: both of second order.
    np.testing.assert_allclose(lines.plus(delta[:, :4]).minus(lines), delta[:, :4], atol=1e-6)


@settings(max_examples=40)
@given(seed=seeds)
def test_a_shift_of_a_lines_point_along_it_is_no_difference(seed):
    rng = np.random.default_rng(seed)
    lines = Lines(rng.normal(size=(3, 3)), normalised(rng.normal(size=(3, 3))))
    slid = Lines(lines.points + 0.7 * lines.directions, lines.directions)
    np.testing.assert_allclose(slid.minus(lines), 0, atol=1e-12)


@pytest.mark.parametrize("kind", ["poses", "lines", "vectors"])
def test_the_derivatives_of_a_prior_equal_finite_differences(kind):
    rng = np.random.default_rng(6)
    if kind == "poses":
        known = Poses.of([random_pose(rng)])
        now = known.plus(np.array([[0.1, 0.2, -0.1, 0.3, -0.2, 0.1]]))
    elif kind == "lines":
        known = Lines(rng.normal(size=(1, 3)), normalised(rng.normal(size=(1, 3))))
        now = known
    else:
        known = Vectors(rng.normal(size=(1, 4)))
        now = Vectors(rng.normal(size=(1, 4)))
    root = rng.normal(size=(known.dof, known.dof))
    prior = Prior((("it", 0),), (known,), root @ root.T)
    line = prior.linearise({"it": now})
    expected = numeric_jacobian(
        lambda d: prior.linearise({"it": now.plus(d[None])}).residuals[0], np.zeros(known.dof), 1e-5
    )
    np.testing.assert_allclose(line.parts[0].jacobian[0], expected, rtol=1e-5, atol=1e-4)


def test_a_pose_measured_twice_gives_the_mean_and_its_covariance():
    rng = np.random.default_rng(7)
    first = random_pose(rng)
    second = first.plus(np.full(6, 0.02))
    terms = [
        *independent("p", Poses.of([first]), np.full((1, 6), 0.1)),
        *independent("p", Poses.of([second]), np.full((1, 6), 0.1)),
    ]
    found = solve({"p": Poses.of([Pose.identity()])}, terms, {"p": True})
    np.testing.assert_allclose(found.values["p"].minus(Poses.of([first])), 0.01, atol=1e-5)
    np.testing.assert_allclose(found.covariance([("p", 0)]), np.eye(6) * 0.005, atol=1e-6)


def test_unknowns_without_prior_knowledge_get_no_prior():
    assert independent("p", Vectors(np.zeros((2, 3))), np.full((2, 3), np.inf)) == []
