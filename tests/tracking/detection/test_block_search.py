"""The maps of the fast first pass, compared with sums over all pixels."""

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from tracking.detection.block_search import (
    BETWEEN2,
    HIGHEST2,
    HIGHEST4,
    HIGHEST8,
    Blocks,
    bin_pixels,
    find_highest_between,
    find_highest_pairs,
    find_highest_quads,
    sum_2x2,
)
from tracking.noise import BLOCK


def highest(image: np.ndarray, size: int, step: int, start: int, reach: int) -> np.ndarray:
    """The largest sum (n, m) of size x size pixels that begin at start + k step, up to `reach` px beyond each block."""
    sums = sliding_window_view(image.astype(np.int64), (size, size)).sum(axis=(2, 3))
    rows, columns = (n // BLOCK for n in image.shape)
    out = np.zeros((rows, columns))
    for i in range(rows):
        for j in range(columns):
            at = [
                [k for k in range(start % step, n, step) if BLOCK * b - reach <= k < BLOCK * (b + 1)]
                for n, b in zip(sums.shape, (i, j), strict=True)
            ]
            out[i, j] = sums[np.ix_(*at)].max()
    return out


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_largest_sums_of_each_block_are_those_of_the_pixels(dtype):
    rng = np.random.default_rng(1)
    image = rng.integers(0, np.iinfo(dtype).max, (64, 96)).astype(dtype)
    blocks = Blocks.of(96, 64)
    rows, columns = blocks.maps.shape[1:]
    runs = np.array([[row, 0, columns] for row in range(rows)])
    bin_pixels(image, runs, blocks.pairs)
    sum_2x2(blocks.pairs, runs, 2, blocks.quads)
    find_highest_pairs(blocks, runs)
    find_highest_quads(blocks, runs)
    find_highest_between(image, runs, blocks.maps, blocks.lines[0])
    inside = np.s_[: rows - 1, : columns - 1]  # in the last blocks sums may begin that end outside the picture
    np.testing.assert_array_equal(blocks.maps[HIGHEST2], highest(image, 2, 2, 0, 0))
    np.testing.assert_array_equal(blocks.maps[HIGHEST4][inside], highest(image, 4, 2, 0, 0)[inside])
    np.testing.assert_array_equal(blocks.maps[HIGHEST8][inside], highest(image, 8, 4, 0, 0)[inside])
    np.testing.assert_array_equal(blocks.maps[BETWEEN2], highest(image, 2, 2, 1, 1))


def test_a_part_of_a_row_gives_the_same_as_the_whole():
    rng = np.random.default_rng(2)
    image = rng.integers(0, 255, (64, 99)).astype(np.uint8)
    whole, part = Blocks.of(99, 64), Blocks.of(99, 64)
    rows, columns = whole.maps.shape[1:]
    find_highest_between(image, np.array([[r, 0, columns] for r in range(rows)]), whole.maps, whole.lines[0])
    runs = np.array([[r, first, last] for r in range(rows) for first, last in ((0, 5), (5, 6), (6, columns))])
    find_highest_between(image, runs, part.maps, part.lines[0])
    np.testing.assert_array_equal(whole.maps[BETWEEN2], part.maps[BETWEEN2])
