"""A fast look at all pixels: sums of 2x2 pixels, and what is highest in each block of 8x8 pixels.

All sums are whole numbers below 2^24, exact in float32 for 8 and 16 bits, so a part of a picture gives the same ones as
the whole. `runs` (n, 3) say which blocks are meant: block row, first block column, the column after the last.

The inner loops work on views of rows, counted from 0, and without numpy's max: only so does the compiler use the
processor's vector units (a factor of five).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Ints
from geometry.compiled import compiled

BLOCK = 8  # px
AROUND = 2  # blocks on each side whose median is the background

Sums = NDArray[np.float32]


class Blocks(NamedTuple):
    """Sums over the pixels of a picture of n x m blocks; only those are up to date that were asked for."""

    pairs: Sums  # (4n, 4m) of 2x2 pixels
    quads: Sums  # (2n, 2m) of 4x4 pixels
    sums: Sums  # (n, m) of 8x8 pixels
    highest2: Sums  # (n, m) largest of 2x2 pixels in the block
    highest4: Sums  # (n, m) ... of 4x4 pixels that begins in the block, at every second pixel
    highest8: Sums  # (n, m) ... of 8x8 pixels that begins in the block, at every fourth pixel
    middle: Sums  # (n, m) median over five blocks of a row
    ground: Sums  # (n, m) median of five `middle`: the background, summed over 8x8 pixels
    line: Sums  # (4m,) room to work in

    @staticmethod
    def of(width: int, height: int) -> Blocks:
        """Room for a picture of that size."""
        n, m = -(-height // BLOCK), -(-width // BLOCK)
        shapes = [(4 * n, 4 * m), (2 * n, 2 * m), *[(n, m)] * 6, (4 * m,)]
        return Blocks(*(np.zeros(shape, np.float32) for shape in shapes))


@compiled
def runs_of(boxes: Ints, more_rows: int, more_columns: int, rows: int, columns: int, runs: Ints) -> int:
    """The runs of boxes (n, 4: first row, last, first column, last) of blocks, grown each way; returns their number."""
    count = 0
    for k in range(boxes.shape[0]):
        first, last = max(boxes[k, 2] - more_columns, 0), min(boxes[k, 3] + more_columns + 1, columns)
        for row in range(max(boxes[k, 0] - more_rows, 0), min(boxes[k, 1] + more_rows + 1, rows)):
            if count < runs.shape[0]:
                runs[count, 0], runs[count, 1], runs[count, 2] = row, first, last
            count += 1
    return count


@compiled
def bin_pixels(image: NDArray, runs: Ints, pairs: Sums) -> None:
    """Sums of 2x2 pixels of a picture (h, w), u8 or u16; the border's pixels are repeated outside."""
    height, width = image.shape
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], 4 * runs[k, 1], 4 * runs[k, 2]
        whole = max(min(last, width // 2), first)
        for i in range(4 * row, 4 * row + 4):
            above, below = image[min(2 * i, height - 1)], image[min(2 * i + 1, height - 1)]
            x, y, out = above[2 * first : 2 * whole], below[2 * first : 2 * whole], pairs[i, first:whole]
            for j in range(out.shape[0]):
                out[j] = (np.float32(x[2 * j]) + np.float32(x[2 * j + 1])) + (
                    np.float32(y[2 * j]) + np.float32(y[2 * j + 1])
                )
            for j in range(whole, last):
                left, right = min(2 * j, width - 1), min(2 * j + 1, width - 1)
                pairs[i, j] = (np.float32(above[left]) + np.float32(above[right])) + (
                    np.float32(below[left]) + np.float32(below[right])
                )


@compiled
def fold(fine: Sums, runs: Ints, size: int, coarse: Sums) -> None:
    """Sums of 2x2 entries of `fine`; `size` is the number of entries of `coarse` along a block's side."""
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], size * runs[k, 1], size * runs[k, 2]
        for i in range(size * row, size * row + size):
            x, y, out = fine[2 * i, 2 * first : 2 * last], fine[2 * i + 1, 2 * first : 2 * last], coarse[i, first:last]
            for j in range(out.shape[0]):
                out[j] = (x[2 * j] + x[2 * j + 1]) + (y[2 * j] + y[2 * j + 1])


@compiled
def find_highest(sums: Sums, runs: Ints, size: int, line: Sums, highest: Sums) -> None:
    """The highest entry of each block; `size` entries lie along a block's side."""
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], runs[k, 1], runs[k, 2]
        best = line[: size * (last - first)]
        for j in range(best.shape[0]):
            best[j] = 0.0
        for i in range(size * row, size * row + size):
            x = sums[i, size * first : size * last]
            for j in range(best.shape[0]):
                a, b = x[j], best[j]
                best[j] = a if a > b else b
        _highest_of_groups(best, size, highest[row, first:last])


@compiled
def find_highest_overlapping(sums: Sums, runs: Ints, size: int, line: Sums, highest: Sums) -> None:
    """The highest sum of 2x2 entries that begins in each block."""
    rows, columns = sums.shape
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], runs[k, 1], runs[k, 2]
        best = line[: size * (last - first)]
        for j in range(best.shape[0]):
            best[j] = 0.0
        inner = best[: min(size * last, columns - 1) - size * first]
        for i in range(size * row, min(size * row + size, rows - 1)):
            x, y = sums[i, size * first :], sums[i + 1, size * first :]
            for j in range(inner.shape[0]):
                a, b = (x[j] + x[j + 1]) + (y[j] + y[j + 1]), inner[j]
                inner[j] = a if a > b else b
        _highest_of_groups(best, size, highest[row, first:last])


@compiled
def _highest_of_groups(line: Sums, size: int, out: Sums) -> None:
    for j in range(out.shape[0]):
        best = line[size * j]
        for i in range(size * j + 1, size * j + size):
            best = line[i] if line[i] > best else best
        out[j] = best


@compiled
def median5(a: float, b: float, c: float, d: float, e: float) -> float:
    """The median of five."""
    a, b = (a, b) if a < b else (b, a)
    c, d = (c, d) if c < d else (d, c)
    low, high = (c if a < c else a), (b if b < d else d)  # the smallest and the largest of the four are not it
    low, high = (low, high) if low < high else (high, low)
    return low if e < low else (high if e > high else e)


@compiled
def find_middle(blocks: Blocks, runs: Ints) -> None:
    """The median of each block and two on each side of it; at the border the outermost blocks are repeated."""
    columns = blocks.sums.shape[1]
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], runs[k, 1], runs[k, 2]
        x, out = blocks.sums[row], blocks.middle[row]
        for j in range(first, last):
            if j < AROUND or j >= columns - AROUND:
                left, right = max(j - 1, 0), min(j + 1, columns - 1)
                out[j] = median5(x[max(j - 2, 0)], x[left], x[j], x[right], x[min(j + 2, columns - 1)])
        begin = max(first, AROUND)
        inner = out[begin : max(min(last, columns - AROUND), begin)]
        x = x[begin - AROUND :]
        for j in range(inner.shape[0]):
            inner[j] = median5(x[j], x[j + 1], x[j + 2], x[j + 3], x[j + 4])


@compiled
def find_ground(blocks: Blocks, runs: Ints) -> None:
    """The background of each block: the median of five medians of five blocks (`find_middle`).

    Nearly as good as the median of all 25, and ten times as fast.
    """
    rows = blocks.sums.shape[0]
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], runs[k, 1], runs[k, 2]
        a, b = blocks.middle[max(row - 2, 0), first:last], blocks.middle[max(row - 1, 0), first:last]
        d, e = blocks.middle[min(row + 1, rows - 1), first:last], blocks.middle[min(row + 2, rows - 1), first:last]
        c, out = blocks.middle[row, first:last], blocks.ground[row, first:last]
        for j in range(out.shape[0]):
            out[j] = median5(a[j], b[j], c[j], d[j], e[j])


@compiled
def find_standing_out(
    blocks: Blocks, runs: Ints, floor: float, slope: float, black: float, least_sigmas: float, searched: NDArray[np.uint8],
    found: Ints,
) -> int:  # fmt: skip
    """Blocks with a sum of 2x2, 4x4 or 8x8 pixels so many sigmas over the background.

    Those marked in searched (n, m) are passed over, the others become marked. found (most, 3): row, column, and 1 where
    it was only the 8x8 pixels. Returns how many.
    """
    count = 0
    least = least_sigmas**2
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], runs[k, 1], runs[k, 2]
        for j in range(first, last):
            if searched[row, j]:
                continue
            searched[row, j] = 1
            level = blocks.ground[row, j] / 64.0
            variance = floor + slope * max(level - black, 0.0)
            d2 = max(blocks.highest2[row, j] - 4.0 * level, 0.0)
            d4 = max(blocks.highest4[row, j] - 16.0 * level, 0.0)
            d8 = max(blocks.highest8[row, j] - 64.0 * level, 0.0)
            fine = max(4.0 * d2 * d2, d4 * d4)
            if max(4.0 * fine, d8 * d8) > least * 64.0 * variance:
                found[count, 0], found[count, 1] = row, j
                found[count, 2] = 0 if fine > least * 16.0 * variance else 1
                count += 1
    return count
