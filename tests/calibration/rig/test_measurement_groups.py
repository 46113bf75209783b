"""Kinds of measurement: how well each fits, and whose errors make a result's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from calibration.least_squares.adjustment import Linearised, Part, solve
from calibration.least_squares.parameter_blocks import Vectors
from calibration.rig.measurement_groups import Unknowns, group_fit, information, shares


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


def test_redundancies_of_all_kinds_add_up_to_the_numbers_less_the_unknowns():
    terms, found, unknowns, C = adjusted(np.random.default_rng(1))
    fits = [group_fit("", *information([t], found.values, unknowns), C) for t in terms]
    assert sum(f.redundancy for f in fits) == pytest.approx(42 - 3)
    assert sum(f.chi2 for f in fits) == pytest.approx(found.chi2)


def test_the_test_of_a_kind_is_fair_where_sigmas_are_right_and_sees_where_they_are_not():
    rng = np.random.default_rng(2)
    right, wrong = [], []
    for _ in range(120):
        terms, found, unknowns, C = adjusted(rng)
        right.append(group_fit("", *information([terms[1]], found.values, unknowns), C).p)
        terms, found, unknowns, C = adjusted(rng, sigmas=(1.0, 2.5))
        wrong.append(group_fit("", *information([terms[1]], found.values, unknowns), C).p)
    # Uniform: the share below 0.1 is 0.1 give or take sqrt(0.09 / 120) = 0.027.
    assert 0.03 < np.mean(np.array(right) < 0.1) < 0.18
    assert np.mean(np.array(wrong) < 0.1) > 0.9


def test_the_chance_of_a_misfit_follows_from_the_residuals_own_covariance():
    terms, found, unknowns, C = adjusted(np.random.default_rng(4), counts=(4, 5))
    fit = group_fit("", *information([terms[1]], found.values, unknowns), C)
    Q = np.eye(5) - terms[1].A @ C @ terms[1].A.T
    mean, variance = np.trace(Q), 2 * np.trace(Q @ Q)
    assert fit.redundancy == pytest.approx(mean)
    assert fit.p == pytest.approx(chi2.sf(2 * mean / variance * fit.chi2, 2 * mean**2 / variance))


def test_what_is_measured_just_once_has_no_redundancy_and_no_verdict():
    once = Lines(np.eye(3), np.array([5.0, 6.0, 7.0]))
    found = solve({"x": Vectors(np.zeros((1, 3)))}, [once], {"x": True})
    unknowns = Unknowns.of(found.values, {"x": True})
    fit = group_fit("", *information([once], found.values, unknowns), found.covariance(unknowns.at))
    assert fit.redundancy == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(fit.p)
    assert np.isnan(fit.scale)


def test_shares_are_what_each_kinds_noise_does_to_the_result():
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
