"""The ratio of the spots' errors to their stated sigmas, from the fits of the frames so far."""

import numpy as np
import pytest

from tracking.rigid_body.variance_factor import VarianceFactor


def scales(ratio, dof, fits, seed):
    """The noise scale before each of the fits of spots whose errors are `ratio` times their sigmas."""
    factor, out = VarianceFactor(), []
    for chi2 in ratio**2 * np.random.default_rng(seed).chisquare(dof, fits):
        out.append(factor.noise_scale)
        factor.update(float(chi2), dof)
    return np.array(out)


@pytest.mark.parametrize("ratio", [1.3, 1.5, 2.0])
def test_larger_errors_are_known_after_few_frames(ratio):
    after = np.array([scales(ratio, 6, 300, seed)[[25, 299]] for seed in range(40)])
    assert np.mean(after[:, 0]) == pytest.approx(ratio, rel=0.12)
    assert np.mean(after[:, 1]) == pytest.approx(ratio, rel=0.04)


@pytest.mark.parametrize("dof", [2, 6, 18])
def test_stated_sigmas_that_are_right_stay(dof):
    changed = np.array([scales(1.0, dof, 300, seed) != 1.0 for seed in range(40)])
    assert changed.mean() < 0.02
