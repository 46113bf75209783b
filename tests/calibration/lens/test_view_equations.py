"""Solutions of some photographs, held-out errors and scatter from the equations of single photographs."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.stats import multivariate_normal

from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.lens_fit import LensFit, fit, robust_fit
from calibration.lens.fit.lens_models import LensModel
from calibration.lens.fit.lens_parameters import AS_STATED, BoardFreedom
from calibration.lens.fit.lens_start import start
from calibration.lens.fit.view_equations import ViewEquations
from tests.calibration.lens.lens_scenes import TRUTH, Scene, photographs
from tests.marks import further_slow


@cache
def fitted(coefficients: int = 5) -> tuple[CornerTable, LensFit]:
    table = photographs(Scene(views=12), 1)
    _, values = start(table, False)
    return table, robust_fit(table, LensModel(coefficients), values, AS_STATED)


@pytest.mark.parametrize("coefficients", [5, 8])
def test_all_views_have_the_covariance_of_the_fit(coefficients):
    table, found = fitted(coefficients)
    _, C = ViewEquations.of(table, found).solution()
    np.testing.assert_allclose(np.sqrt(np.diagonal(C))[:4], np.sqrt(np.diagonal(found.covariance))[:4], rtol=2e-3)


def test_half_of_the_views_have_the_solution_of_a_fit_to_them():
    table, found = fitted()
    half = np.arange(12) % 2 == 0
    change, C = ViewEquations.of(table, found).solution(half)
    other = fit(table, found.used & half[table.view], found.model, found.values, AS_STATED)
    apart = (other.lens - found.lens)[found.model.free] - change
    assert np.all(np.abs(apart) < 0.1 * np.sqrt(np.diagonal(C)))


def test_a_view_held_out_is_predicted_as_by_a_fit_without_it():
    table, found = fitted()
    equations = ViewEquations.of(table, found)
    without = fit(table, found.used & (table.view != 3), found.model, found.values, AS_STATED)
    change = (without.lens - found.lens)[found.model.free]
    assert equations.moved(change).chi2[3] / equations.count[3] == pytest.approx(equations.held_out_px2()[3], rel=0.02)


def test_views_have_the_density_that_the_others_predict():
    """Five views of a linear model, each with six unknowns of its own, whose priors are flat."""
    rng = np.random.default_rng(3)
    view = np.repeat(np.arange(5), 8)
    shared, own, residuals = (rng.normal(size=(40, 2, k)) for k in (3, 6, 1))
    equations = ViewEquations.of_rows(
        shared, own, residuals[..., 0], view, np.arange(5), np.zeros((0, 3)), 3, np.zeros((len(view), 1))
    )
    change, _ = equations.solution()
    J, left = [], []  # of each view, in directions that its own unknowns do not reach
    for v in range(5):
        N = null_space(own[view == v].reshape(-1, 6).T).T
        J.append(N @ shared[view == v].reshape(-1, 3))
        left.append(N @ residuals[view == v].ravel())
    density = 0.0
    for v in range(5):
        A, y = (np.concatenate([x for u, x in enumerate(xs) if u != v]) for xs in (J, left))
        C = np.linalg.inv(A.T @ A)
        predicted = multivariate_normal(J[v] @ C @ A.T @ y, np.eye(len(J[v])) + J[v] @ C @ J[v].T)
        density += -2 * predicted.logpdf(left[v]) - len(J[v]) * np.log(2 * np.pi)
    assert sum(equations.moved(change).predicted()) == pytest.approx(density, rel=1e-6)


def test_the_bend_follows_without_a_fit_in_which_it_is_free():
    table = photographs(Scene(views=12, warp=(0.02, 0.0, 0.01)), 3)
    _, values = start(table, False)
    flat = robust_fit(table, LensModel(5), values, AS_STATED)
    bent = fit(table, flat.used, flat.model, flat.values, BoardFreedom(warp=True))
    change, _ = ViewEquations.of(table, flat, BoardFreedom(warp=True)).solution()
    np.testing.assert_allclose(change[9:], bent.warp, rtol=0.1, atol=1e-3)


def test_scatter_is_one_for_noise_and_larger_for_errors_common_to_a_photograph():
    factors = []
    for common_px in (0.0, 0.3):
        squares = []
        for seed in range(6):
            table = photographs(Scene(views=12, lens=TRUTH), 70 + seed)
            rng = np.random.default_rng(seed)
            middle = table.pixels.mean(axis=0)
            grow = 1 + rng.normal(0, common_px / 300, (table.views, 2))
            table.pixels[:] = middle + (table.pixels - middle) * grow[table.view]
            _, values = start(table, False)
            squares.append(ViewEquations.of(table, robust_fit(table, LensModel(5), values, AS_STATED)).scatter().factor)
        factors.append(float(np.sqrt(np.mean(np.square(squares)))))
    assert factors[0] == pytest.approx(1, abs=0.15)
    assert factors[1] > 1.2


def test_the_equations_at_other_values_are_those_of_the_residuals_there():
    """Of linear residuals A x - b: their squares and gradients at any x, in any basis."""
    rng = np.random.default_rng(3)
    A, b, x, basis = rng.normal(size=(4, 6, 3)), rng.normal(size=(4, 6)), rng.normal(size=3), rng.normal(size=(3, 3))
    S, g = np.swapaxes(A, 1, 2) @ A, -np.einsum("vri,vr->vi", A, b)
    at_zero = ViewEquations(basis.T @ S @ basis, g @ basis, np.sum(b**2, axis=1), np.full(4, 6), np.arange(4), basis, 3)
    left = A @ x - b
    there = at_zero.moved(x)
    np.testing.assert_allclose(there.chi2, np.sum(left**2, axis=1))
    np.testing.assert_allclose(there.gradient, np.einsum("vri,vr->vi", A, left) @ basis)


def drawn_apart(
    views: int, rng: np.random.Generator, sizes: tuple[float, ...] = (3.0, 1.0, 1.0), noise: float = 0.0
) -> tuple[np.ndarray, ViewEquations]:
    """The error (3,) of three unknowns by photographs that see unknowns of their own, and the equations there."""
    rows = rng.normal(0, 1, (views, 6, 3))
    S = np.swapaxes(rows, 1, 2) @ rows
    values, vectors = np.linalg.eigh(S.sum(axis=0))
    basis = vectors / np.sqrt(values)
    own = rng.normal(0, sizes, (views, 3))
    gradient = (
        -((S @ own[..., None])[..., 0] + noise * np.einsum("vri,vr->vi", rows, rng.normal(size=(views, 6)))) @ basis
    )
    zeros = np.zeros(views)
    at_truth = ViewEquations(basis.T @ S @ basis, gradient, zeros, zeros.astype(int), np.arange(views), basis, 3)
    error, _ = at_truth.solution()
    return error, at_truth.moved(error)


@pytest.mark.parametrize("views", further_slow([5, 8, 13, 30], fast=2))
def test_photographs_that_scatter_have_errors_of_the_stated_size_however_few_they_are(views):
    rng = np.random.default_rng(views)
    squares = []
    for _ in range(400):
        error, equations = drawn_apart(views, rng)
        squares.append(error**2 / np.diagonal(equations.scattered_covariance(equations.scatter())))
    spread = np.sqrt(np.mean(squares, axis=0))
    assert np.all((spread > 0.7) & (spread < 1.2)), spread  # without degrees of freedom 1.2 to 1.6


@pytest.mark.parametrize("views", further_slow([5, 8, 13]))
def test_photographs_that_scatter_alike_in_every_direction_are_not_held_for_worse(views):
    """Left out in turn, few photographs change the unknowns by more than these err; without that, .6 to .8 sigmas."""
    rng = np.random.default_rng([views, 1])
    squares = []
    for _ in range(600):
        error, equations = drawn_apart(views, rng, (1.0, 1.0, 1.0))
        squares.append(error**2 / np.diagonal(equations.scattered_covariance(equations.scatter())))
    assert 0.85 < np.sqrt(np.mean(squares)) < 1.15


def errors_by_alike_neighbours(views: int, share: float, rng: np.random.Generator) -> tuple[float, float]:
    """The error of an unknown that bends 9 x 6 points of each photograph, in sigmas, and the stated factor.

    Neighbours share the share of their squared error, over two spacings.
    """
    places = np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), axis=-1).reshape(-1, 2)
    K = (1 - share) * np.eye(54) + share * np.exp(-np.sum((places[:, None] - places) ** 2, axis=2) / 8)
    x, y = (places / 4 - 1).T
    zero = np.zeros(54)
    own = np.stack(
        [np.stack([f, zero], 1) for f in (zero + 1, x, y)] + [np.stack([zero, f], 1) for f in (zero + 1, x, y)], 2
    )
    rows, bends = [], [np.stack([x * x, x * y], 1), np.stack([x * y, y * y], 1), np.stack([x**3, y**3], 1)]
    for _ in range(views):
        turned = rng.normal(size=(3, 3))
        rows.append(np.stack([sum(t * b for t, b in zip(by, bends, strict=True)) for by in turned], axis=2))
    residuals = np.concatenate([np.linalg.cholesky(K) @ rng.normal(size=(54, 2)) for _ in range(views)])
    every = np.arange(views)
    at_truth = ViewEquations.of_rows(
        np.concatenate(rows), np.tile(own, (views, 1, 1)), residuals, np.repeat(every, 54), every, np.zeros((0, 3)), 3,
        np.tile(places, (views, 1)),
    )  # fmt: skip
    change, _ = at_truth.solution()
    there = at_truth.moved(change)
    spread = there.scatter()
    return float(change[0] / np.sqrt(there.scattered_covariance(spread)[0, 0])), spread.correlated


@pytest.mark.parametrize("views", further_slow([5, 12], fast=1))
def test_corners_that_share_errors_with_their_neighbours_count_as_fewer(views):
    """Without it 1.19 sigmas of five photographs, since few that happen to agree show no scatter."""
    rng = np.random.default_rng(views)
    found = np.array([errors_by_alike_neighbours(views, 0.7, rng) for _ in range(300)])
    assert np.sqrt(np.mean(found[:, 0] ** 2)) == pytest.approx(1.0, abs=0.15)
    assert np.median(found[:, 1]) > 1.5


def test_independent_corners_are_taken_as_such():
    rng = np.random.default_rng(3)
    assert np.mean([errors_by_alike_neighbours(6, 0.0, rng)[1] == 1.0 for _ in range(100)]) > 0.98


def test_noise_is_taken_for_scatter_less_often_the_more_photographs_there_are():
    rng = np.random.default_rng(4)
    share = [
        np.mean([drawn_apart(views, rng, (0.0, 0.0, 0.0), 1.0)[1].scatter().is_significant for _ in range(600)])
        for views in (5, 12, 40)
    ]
    # 10 % of five, 5.9 % of twelve, 3.0 % of forty photographs; the standard deviation is at most 1.2 %.
    np.testing.assert_allclose(share, [0.1, 0.059, 0.03], atol=0.03)
    assert share[0] > share[2] + 0.03
