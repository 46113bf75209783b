"""Consistency of each kind of measurement, and its share in the covariance of a result."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from calibration.least_squares.adjustment import Linearised, Part, Vectors, solve
from calibration.rig.joint import Unknowns, group_fit, information, shares


class Lines:
    """n measurements of linear functions of x (m), with sigma 1: A x = b."""

    loss = None

    def __init__(self, A, b):
        self.A, self.b = A, b

    def linearise(self, values):
        x = values["x"].array[0]
        n = len(self.b)
        part = Part("x", np.zeros(n, dtype=np.int64), self.A[:, None, :])
        return Linearised((self.A @ x - self.b)[:, None], [part])


def adjusted(rng, counts=(30, 12), truth=(1.0, -2.0, 0.5), sigmas=(1.0, 1.0)):
    x = np.array(truth)
    terms = []
    for n, s in zip(counts, sigmas, strict=True):
        A = rng.normal(size=(n, 3))
        terms.append(Lines(A, A @ x + rng.normal(0, s, n)))
    values = {"x": Vectors(np.zeros((1, 3)))}
    found = solve(values, terms, {"x": True})
    unknowns = Unknowns.of(found.values, {"x": True})
    C = found.covariance(unknowns.at)
    return terms, found, unknowns, C


def test_redundancies_of_all_kinds_sum_to_residuals_minus_unknowns():
    terms, found, unknowns, C = adjusted(np.random.default_rng(1))
    fits = [group_fit("", *information([t], found.values, unknowns), C) for t in terms]
    assert sum(f.redundancy for f in fits) == pytest.approx(42 - 3)
    assert sum(f.chi2 for f in fits) == pytest.approx(found.chi2)


def test_p_values_are_uniform_for_correct_sigmas_and_small_for_wrong_ones():
    rng = np.random.default_rng(2)
    right, wrong = [], []
    for _ in range(60):
        terms, found, unknowns, C = adjusted(rng)
        right.append(group_fit("", *information([terms[1]], found.values, unknowns), C).p)
        terms, found, unknowns, C = adjusted(rng, sigmas=(1.0, 2.5))
        wrong.append(group_fit("", *information([terms[1]], found.values, unknowns), C).p)
    # Uniform: the share below 0.1 is 0.1 with a sigma of sqrt(0.09 / 60) = 0.039.
    assert 0.02 < np.mean(np.array(right) < 0.1) < 0.2
    assert np.mean(np.array(wrong) < 0.1) > 0.9


def test_the_p_value_follows_from_the_covariance_of_the_residuals():
    terms, found, unknowns, C = adjusted(np.random.default_rng(4), counts=(4, 5))
    fit = group_fit("", *information([terms[1]], found.values, unknowns), C)
    Q = np.eye(5) - terms[1].A @ C @ terms[1].A.T
    mean, variance = np.trace(Q), 2 * np.trace(Q @ Q)
    assert fit.redundancy == pytest.approx(mean)
    assert fit.p == pytest.approx(chi2.sf(2 * mean / variance * fit.chi2, 2 * mean**2 / variance))


def test_parameters_measured_once_have_no_redundancy_and_no_p_value():
    once = Lines(np.eye(3), np.array([5.0, 6.0, 7.0]))
    found = solve({"x": Vectors(np.zeros((1, 3)))}, [once], {"x": True})
    unknowns = Unknowns.of(found.values, {"x": True})
    fit = group_fit("", *information([once], found.values, unknowns), found.covariance(unknowns.at))
    assert fit.redundancy == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(fit.p)
    assert np.isnan(fit.scale)


def test_shares_agree_with_the_simulated_effect_of_noise():
    rng = np.random.default_rng(3)
    terms, found, unknowns, C = adjusted(rng)
    effect = np.array([[1.0, 2.0, -1.0]])
    informations = {str(i): information([t], found.values, unknowns)[0] for i, t in enumerate(terms)}
    parts = shares(informations, C, effect)
    assert sum(p[0, 0] for p in parts.values()) == pytest.approx((effect @ C @ effect.T)[0, 0])
    # By simulation: new noise in the second kind alone.
    results = []
    for _ in range(4000):
        b = terms[1].b + rng.normal(size=len(terms[1].b))
        H = sum(t.A.T @ t.A for t in terms)
        results.append((effect @ np.linalg.solve(H, terms[0].A.T @ terms[0].b + terms[1].A.T @ b))[0])
    assert np.var(results) == pytest.approx(parts["1"][0, 0], rel=0.1)
