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
from geometry.compilation.jit import compiled, compiled_for_threads

BLOCK = 8  # px
AROUND = 2  # blocks on each side whose median is the background

Sums = NDArray[np.float32]


SUMS, HIGHEST2, HIGHEST4, HIGHEST8, MIDDLE, GROUND = range(6)


class Blocks(NamedTuple):
    """Sums over the pixels of a picture of n x m blocks; only those are up to date that were asked for."""

    pairs: Sums  # (4n, 4m) of 2x2 pixels
    quads: Sums  # (2n, 2m) of 4x4 pixels
    # (6, n, m). SUMS: of 8x8 pixels. HIGHEST2: the largest of 2x2 pixels in the block. HIGHEST4, HIGHEST8: of 4x4 and
    # 8x8 pixels that begin in the block, at every second and fourth pixel. MIDDLE: median of SUMS over five blocks of a
    # row. GROUND: median of MIDDLE over five rows, the background
    maps: Sums
    lines: Sums  # (2, 4m) room to work in

    @staticmethod
    def of(width: int, height: int) -> Blocks:
        """Room for a picture of that size."""
        n, m = -(-height // BLOCK), -(-width // BLOCK)
        shapes = [(4 * n, 4 * m), (2 * n, 2 * m), (6, n, m), (2, 4 * m)]
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


@compiled_for_threads
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
def find_highest_pairs(blocks: Blocks, runs: Ints) -> None:
    """HIGHEST2 and HIGHEST4."""
    rows, columns = blocks.pairs.shape
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], 4 * runs[k, 1], 4 * runs[k, 2]
        own, over = blocks.lines[0, : last - first], blocks.lines[1, : last - first]
        for j in range(own.shape[0]):
            own[j] = 0.0
            over[j] = 0.0
        inner = min(last, columns - 1) - first
        for i in range(4 * row, 4 * row + 4):
            x, y = blocks.pairs[i, first:], blocks.pairs[min(i + 1, rows - 1), first:]
            for j in range(inner):
                a, b = x[j], own[j]
                own[j] = a if a > b else b
                a, b = (x[j] + x[j + 1]) + (y[j] + y[j + 1]), over[j]
                over[j] = a if a > b else b
            if inner < own.shape[0]:
                own[inner] = max(own[inner], x[inner])
        for line in range(2):
            x, out = blocks.lines[line], blocks.maps[HIGHEST2 + line, row, runs[k, 1] : runs[k, 2]]
            for j in range(out.shape[0]):
                a, b, c, d = x[4 * j], x[4 * j + 1], x[4 * j + 2], x[4 * j + 3]
                a, b = (a if a > b else b), (c if c > d else d)
                out[j] = a if a > b else b


@compiled
def find_highest_quads(blocks: Blocks, runs: Ints) -> None:
    """HIGHEST8."""
    rows, columns = blocks.quads.shape
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], 2 * runs[k, 1], 2 * runs[k, 2]
        over = blocks.lines[0, : last - first]
        for j in range(over.shape[0]):
            over[j] = 0.0
        inner = min(last, columns - 1) - first
        for i in range(2 * row, 2 * row + 2):
            x, y = blocks.quads[i, first:], blocks.quads[min(i + 1, rows - 1), first:]
            for j in range(inner):
                a, b = (x[j] + x[j + 1]) + (y[j] + y[j + 1]), over[j]
                over[j] = a if a > b else b
        out = blocks.maps[HIGHEST8, row, runs[k, 1] : runs[k, 2]]
        for j in range(out.shape[0]):
            a, b = over[2 * j], over[2 * j + 1]
            out[j] = a if a > b else b


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
    columns = blocks.maps.shape[2]
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], runs[k, 1], runs[k, 2]
        x, out = blocks.maps[SUMS, row], blocks.maps[MIDDLE, row]
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
    rows = blocks.maps.shape[1]
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], runs[k, 1], runs[k, 2]
        a, b = blocks.maps[MIDDLE, max(row - 2, 0), first:last], blocks.maps[MIDDLE, max(row - 1, 0), first:last]
        below, last_row = min(row + 1, rows - 1), min(row + 2, rows - 1)
        d, e = blocks.maps[MIDDLE, below, first:last], blocks.maps[MIDDLE, last_row, first:last]
        c, out = blocks.maps[MIDDLE, row, first:last], blocks.maps[GROUND, row, first:last]
        for j in range(out.shape[0]):
            out[j] = median5(a[j], b[j], c[j], d[j], e[j])


@compiled
def find_standing_out(
    blocks: Blocks, runs: Ints, floor: float, slope: float, black: float, texture: float, banding: float,
    least_sigmas: float, least_wide: float, searched: NDArray[np.uint8], found: Ints,
) -> int:  # fmt: skip
    """Blocks with a sum of 2x2 or 4x4 pixels `least_sigmas` over the background, or of 8x8 pixels `least_wide`.

    texture, banding: sigma of means over a few pixels by the background's structure, share of its level and DN.

    Those marked in searched (n, m) are passed over, the others become marked. found (most, 3): row, column, and 1 where
    it was only the 8x8 pixels. Returns how many.
    """
    count = 0
    fine, wide, texture2 = 16.0 * least_sigmas**2, 64.0 * least_wide**2, texture**2
    banding2 = banding**2
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], runs[k, 1], runs[k, 2]
        ground, highest2 = blocks.maps[GROUND, row, first:last], blocks.maps[HIGHEST2, row, first:last]
        highest4, highest8 = blocks.maps[HIGHEST4, row, first:last], blocks.maps[HIGHEST8, row, first:last]
        excess, excess8 = blocks.lines[0, : last - first], blocks.lines[1, : last - first]
        for j in range(ground.shape[0]):  # squares over the variance, over their thresholds
            level = ground[j] / 64.0
            lit = level - black
            variance, rough = floor + slope * (lit if lit > 0.0 else 0.0), texture2 * level * level + banding2
            a, b, c = 2.0 * (highest2[j] - 4.0 * level), highest4[j] - 16.0 * level, highest8[j] - 64.0 * level
            a, b, c = (a if a > 0.0 else 0.0), (b if b > 0.0 else 0.0), (c if c > 0.0 else 0.0)
            a, b = a * a / (fine * (variance + 4.0 * rough)), b * b / (fine * (variance + 16.0 * rough))
            excess[j] = a if a > b else b
            excess8[j] = c * c / (wide * (variance + 64.0 * rough))
        for j in range(ground.shape[0]):
            if searched[row, first + j]:
                continue
            searched[row, first + j] = 1
            if excess[j] > 1.0 or excess8[j] > 1.0:
                found[count, 0], found[count, 1] = row, first + j
                found[count, 2] = 0 if excess[j] > 1.0 else 1
                count += 1
    return count
