"""Chi-square and gamma quantiles against scipy and a published table."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import chdtrc, chdtri, gammaincinv

from geometry.uncertainty.chi_square import chi2_limit, chi2_tail, gamma_quantile


@pytest.mark.parametrize("dof", [1, 2, 3, 6, 12, 47, 1000])
@pytest.mark.parametrize("p", [1e-300, 1e-12, 1e-6, 0.01, 0.3, 0.5, 0.9, 1 - 1e-6])
def test_a_chi_square_quantile_equals_scipys_and_its_tail_inverts_it(dof, p):
    limit = chi2_limit(p, dof)
    assert limit == pytest.approx(chdtri(dof, p), rel=1e-12)
    assert chi2_tail(limit, dof) == pytest.approx(p, rel=1e-9)


@pytest.mark.parametrize("value", [1e-9, 0.1, 3.0, 50.0, 500.0])
@pytest.mark.parametrize("dof", [1, 2, 7, 200])
def test_the_tail_of_a_chi_square_equals_scipys(value, dof):
    assert chi2_tail(value, dof) == pytest.approx(chdtrc(dof, value), rel=1e-11)


@pytest.mark.parametrize("shape", [1.0, 1.5, 30.0, 1e3, 1e5, 1e7])
@pytest.mark.parametrize("p", [0.025, 0.5, 0.975])
def test_a_gamma_quantile_equals_scipys(shape, p):
    assert gamma_quantile(1 - p, shape) == pytest.approx(gammaincinv(shape, p), rel=1e-9)


def test_certain_and_undefined_probabilities_have_their_limits():
    assert chi2_limit(0.0, 3) == math.inf
    assert chi2_limit(1.0, 3) == 0
    assert (chi2_tail(0.0, 3), chi2_tail(math.inf, 3), chi2_tail(1e6, 3)) == (1, 0, 0)
    assert np.isnan(chi2_tail(math.nan, 3))
    for p, shape in ((-0.1, 1.0), (1.1, 1.0), (0.5, 0.0), (math.nan, 1.0)):
        with pytest.raises(ValueError, match="expected a shape above 0 and a probability"):
            gamma_quantile(p, shape)


@pytest.mark.parametrize(
    ("p", "dof", "value"), [(0.05, 6, 12.592), (0.01, 2, 9.210), (0.001, 6, 22.458), (0.05, 1, 3.841)]
)
def test_quantiles_equal_a_published_chi_square_table(p, dof, value):
    """NIST/SEMATECH e-Handbook of Statistical Methods, sec. 1.3.6.7.4."""
    assert chi2_limit(p, dof) == pytest.approx(value, abs=5e-4)
