"""Corners of different noise: near boards out of focus, far ones sharp, and narrow squares at the rim of a picture."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.lens.fit import lens_fit
from calibration.lens.intrinsics import IntrinsicsOptions, calibrate_intrinsics
from tests.calibration.lens.lens_scenes import SIZE, Scene, photographs
from tests.calibration.lens.test_intrinsics import FIVE, errors


def of_mixed_noise(seed: int, noise: np.ndarray):
    """Corners without noise, then noise by view."""
    table = photographs(Scene(views=len(noise), sigma_px=0.0), seed)
    rng = np.random.default_rng([seed, 7])
    return replace(table, pixels=table.pixels + rng.normal(size=(len(table), 2)) * noise[table.view, None])


def test_blurred_photographs_count_less_than_sharp_ones(monkeypatch):
    noise = np.repeat([0.06, 0.24], 5)
    squares, smaller = [], []
    for seed in range(4):
        table = of_mixed_noise(seed, noise)
        c = calibrate_intrinsics(table, replace(FIVE, warp=False))
        squares.append((errors(c) / c.sigmas) ** 2)
        assert c.table.view_noise is not None
        np.testing.assert_allclose(c.table.view_noise[5:] / c.table.view_noise[:5], 4, rtol=0.5)
        with monkeypatch.context() as patch:
            patch.setattr(lens_fit, "_NOISE_RATIO", np.inf)
            equal = calibrate_intrinsics(table, replace(FIVE, warp=False))
        smaller.append(c.sigmas[0] / equal.sigmas[0])
    assert np.mean(smaller) < 0.8
    # The mean of 36 squared numbers, which are correlated: within .3 to 2.2 with a probability of 99 %.
    assert 0.3 < np.mean(squares) < 2.2


def test_photographs_of_equal_noise_count_the_same():
    tables = [photographs(Scene(views=8), seed) for seed in range(3)]
    assert all(calibrate_intrinsics(t, IntrinsicsOptions(lens=FIVE.lens)).table.view_noise is None for t in tables)


def of_noise_at_the_rim(seed: int, elsewhere_px: float = 0.0):
    """Corners with the noise of their picture, .03 px in the middle and .3 px at its rim, and with other noise."""
    table = photographs(Scene(views=10, sigma_px=0.0), seed)
    away = np.linalg.norm(table.pixels / SIZE - 0.5, axis=1)
    sigmas = np.where(away > 0.35, 0.3, 0.03)
    rng = np.random.default_rng([seed, 8])
    drawn = np.hypot(sigmas, elsewhere_px)[:, None] * rng.normal(size=(len(table), 2))
    return replace(table, pixels=table.pixels + drawn, sigmas_px=sigmas)


@pytest.mark.slow
def test_corners_with_the_noise_of_their_picture_count_by_it():
    squares, smaller = [], []
    for seed in range(4):
        table = of_noise_at_the_rim(seed)
        c = calibrate_intrinsics(table, replace(FIVE, warp=False))
        squares.append((errors(c) / c.sigmas) ** 2)
        assert table.sigmas_px is not None
        at_rim = table.sigmas_px > 0.1
        np.testing.assert_allclose(c.table.noise[at_rim].mean() / c.table.noise[~at_rim].mean(), 10, rtol=0.3)
        assert c.fit.used[at_rim].mean() > 0.95  # not outliers
        equal = calibrate_intrinsics(replace(table, sigmas_px=None), replace(FIVE, warp=False))
        smaller.append(c.sigmas[0] / equal.sigmas[0])
    assert np.mean(smaller) < 0.8
    # The mean of 36 squared numbers, which are correlated: within .3 to 2.2 with a probability of 99 %.
    assert 0.3 < np.mean(squares) < 2.2


def test_noise_that_is_not_of_the_picture_is_added_to_it():
    table = of_noise_at_the_rim(5, 0.15)
    assert table.sigmas_px is not None
    c = calibrate_intrinsics(table, replace(FIVE, warp=False))
    at_rim = table.sigmas_px > 0.1
    expected = np.hypot(0.3, 0.15) / np.hypot(0.03, 0.15)
    np.testing.assert_allclose(c.table.noise[at_rim].mean() / c.table.noise[~at_rim].mean(), expected, rtol=0.2)


def test_noise_of_other_causes_alone_leaves_all_corners_alike():
    table = photographs(Scene(views=10, sigma_px=0.2), 6)
    sigmas = np.random.default_rng(9).uniform(0.001, 0.01, len(table))
    assert calibrate_intrinsics(replace(table, sigmas_px=sigmas), FIVE).table.picture_noise is None


def test_noise_of_the_picture_is_found_where_the_fit_rejects_the_noisy_corners():
    """With equal noise a third of the noisy corners are outliers; the others do not show that noise differs."""
    squares = []
    for seed in range(6):
        table = photographs(Scene(views=5, sigma_px=0.0, columns=4, rows=3, square_m=0.05), 20 + seed)
        rng = np.random.default_rng([seed, 10])
        sigmas = np.where(np.arange(len(table)) % 5 == 0, 0.5, 0.07)
        table = replace(table, pixels=table.pixels + sigmas[:, None] * rng.normal(size=(len(table), 2)))
        c = calibrate_intrinsics(replace(table, sigmas_px=sigmas), replace(FIVE, warp=False))
        noisy = sigmas > 0.1
        assert c.table.noise[noisy].mean() > 3 * c.table.noise[~noisy].mean()
        assert c.fit.used[noisy].mean() > 0.9
        squares.append((errors(c) / c.sigmas) ** 2)
    # The mean of 54 squared numbers, which are correlated: within .4 to 2 with a probability of 99 %.
    assert 0.4 < np.mean(squares) < 2
