"""Photographs whose corners have different noise: near boards out of focus, far ones sharp."""

from dataclasses import replace

import numpy as np

from calibration.lens.fit import lens_fit
from calibration.lens.intrinsics import IntrinsicsOptions, calibrate_intrinsics
from tests.calibration.lens.lens_scenes import Scene, photographs
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
