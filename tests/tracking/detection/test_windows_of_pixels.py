"""Windows and blocks of pixels are read alike, whatever the picture's depth and wherever they lie."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from geometry.arrays import Array
from tracking.detection.candidates import _mark_significant, _read_block, _sum_squares, block_workspace
from tracking.detection.narrow_light import PolynomialFrame
from tracking.detection.pixels import CLIPPED, OUTSIDE, VALID, Pixels, Window, read_window
from tracking.detection.quality import _AWAY, _correlation_within
from tracking.noise import BLOCK

WIDTH, HEIGHT = 90, 70


def picture(seed: int) -> Array:
    """Grey values, 8 bit, some of them clipped."""
    return np.minimum(np.random.default_rng(seed).integers(0, 300, (HEIGHT, WIDTH)), 255).astype(np.uint8)


def pixels_of(image: Array) -> Pixels:
    """A picture for compiled code."""
    return Pixels(image.view(np.uint8), image.itemsize, image.shape[1], image.shape[0])


@pytest.mark.parametrize("cell", [1, 2, 4])
@pytest.mark.parametrize(
    ("left", "top"), [(0, 0), (31, 17), (-3, 20), (40, -2), (WIDTH - 4 * 9, HEIGHT - 4 * 7), (70, 60)]
)
def test_the_cells_of_a_window_are_the_means_of_their_pixels(cell, left, top):
    grey, window = picture(1), Window(left, top, 9, 7, cell)
    for image in (grey, grey.astype(np.uint16)):
        values, state = np.full(100, np.nan), np.full(100, np.nan)
        read_window(pixels_of(image), window, 250.0, values, state)
        for i in range(window.rows):
            for j in range(window.columns):
                u, v = left + j * cell, top + i * cell
                inside = u >= 0 and v >= 0 and u + cell <= WIDTH and v + cell <= HEIGHT
                block = grey[v : v + cell, u : u + cell] if inside else np.zeros((1, 1))
                assert values[9 * i + j] == block.mean()
                assert state[9 * i + j] == (OUTSIDE if not inside else CLIPPED if block.max() >= 250 else VALID)


@pytest.mark.parametrize("square", [2, 3, 5, 7])
@pytest.mark.parametrize(("left", "top"), [(0, 0), (16, 24), (WIDTH - 12, HEIGHT - 12), (WIDTH // 8 * 8, 8)])
def test_a_block_is_significant_where_the_sum_of_a_square_about_one_of_its_pixels_is(square, left, top):
    grey, flat = picture(2), block_workspace()
    marks = flat[-1].reshape(BLOCK + 8, -1)[4 : 4 + BLOCK, 4 : 4 + BLOCK]
    padded = np.pad(grey.astype(int), 20, mode="reflect")[20 - 3 + top :, 20 - 3 + left :][: BLOCK + 6, : BLOCK + 6]
    sums = sliding_window_view(padded, (square, square)).sum(axis=(2, 3))
    # Those about the pixels of the block; of 2x2 pixels those that contain one.
    sums = (
        sums[2 : BLOCK + 3, 2 : BLOCK + 3]
        if square == 2
        else sums[3 - square // 2 :, 3 - square // 2 :][:BLOCK, :BLOCK]
    )
    for image in (grey, grey.astype(np.uint16)):
        _read_block(pixels_of(image), left - 4, top - 4, flat)
        _sum_squares(flat)
        for more, expected in ((0.0, True), (0.5, False)):
            least = [sums.max() + more if s == square else np.inf for s in (2, 3, 5, 7)]
            possible = _mark_significant(flat, *least)
            assert possible or not expected
            assert marks.any() == expected


@pytest.mark.parametrize("S", [(1600.0, 0.0, 1600.0), (1600.0, 0.0, 400.0), (1600.0, 500.0, 700.0)])
def test_the_correlation_of_residuals_is_that_of_cells_a_third_of_a_width_apart_in_each_direction(S):
    """Waves along one axis: the correlation over a distance is the mean cosine over its directions."""
    window = Window(0, 0, 241, 241, 1)
    frame = PolynomialFrame(-120.0, -120.0, S[0] ** 0.5, S[2] ** 0.5, S, False)
    v, u = np.mgrid[0:241, 0:241]
    root = np.linalg.cholesky([[S[0], S[1]], [S[1], S[2]]])
    for along in (0, 1):
        wave = np.linalg.solve(root, np.stack([u.ravel(), v.ravel()]))[along] * 2 * np.pi  # a period is one width
        rho, away2 = _correlation_within(window, frame, np.sqrt(2) * np.cos(wave), np.ones(u.size))
        steps = 2 * np.pi * _AWAY * np.cos(np.arange(4) * np.pi / 4)
        assert away2 == pytest.approx(_AWAY**2, rel=0.06)  # rounded to cells
        assert rho == pytest.approx(np.mean(np.cos(steps)), abs=0.06)
