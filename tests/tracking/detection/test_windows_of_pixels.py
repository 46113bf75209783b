"""Windows and blocks of pixels are read alike, whatever the picture's depth and wherever they lie."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from geometry.arrays import Array
from tracking.detection.candidates import _mark_significant, _read_block, _sum_squares, block_workspace
from tracking.detection.pixels import CLIPPED, OUTSIDE, VALID, Pixels, Window, read_window
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
