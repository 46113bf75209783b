"""The fast first pass over all pixels: sums over 2x2 to 8x8 pixels, their maxima and the background per 8x8 block.

All sums are integers below 2^24 and therefore exact in float32 for 8 and 16 bits, so a part of a picture gives the same
sums as the whole. `runs` (n, 3) select the blocks: block row, first block column, the column after the last.

The inner loops use views of rows, indexed from 0, and no numpy max: otherwise the compiler does not use the processor's
vector units (a factor of five).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Ints
from geometry.compilation.jit import compiled, compiled_for_threads
from tracking.detection.pixels import SEARCHED_TEXTURE, TEXTURE_SHARE, Noise
from tracking.noise import BLOCK

BACKGROUND_REACH = 2  # blocks on each side that contribute to the median for the background

_CLIPPED, _BRIGHT = 0.97, 0.7  # of the saturation: compressed pictures leave no flat top; least level beside it

Sums = NDArray[np.float32]


SUMS, HIGHEST2, HIGHEST4, HIGHEST8, ROW_MEDIAN, BACKGROUND, TEXTURE, BETWEEN2 = range(8)


class Blocks(NamedTuple):
    """Sums over the pixels of a picture of n x m blocks. Only the blocks of the last runs are up to date."""

    pairs: Sums  # (4n, 4m) of 2x2 pixels
    quads: Sums  # (2n, 2m) of 4x4 pixels
    # (8, n, m). SUMS: sums of 8x8 pixels. HIGHEST2: the largest sum of 2x2 pixels in the block; BETWEEN2: of 2x2 pixels
    # around the corners of those, also at the block's edges: a spot narrower than a pixel may lie on a corner.
    # HIGHEST4, HIGHEST8: the largest sum of 4x4 and 8x8 pixels that begin in the block, at every second and fourth
    # pixel. ROW_MEDIAN: median of SUMS over five blocks of a row. BACKGROUND: median of ROW_MEDIAN over five rows.
    # TEXTURE: its contrast (see tracking.noise.NoiseModel), which does not depend on the picture
    maps: Sums
    lines: Sums  # (2, 4m) workspace

    @staticmethod
    def of(width: int, height: int) -> Blocks:
        """Arrays for a picture of that size, px."""
        n, m = -(-height // BLOCK), -(-width // BLOCK)
        shapes = [(4 * n, 4 * m), (2 * n, 2 * m), (8, n, m), (2, 4 * m)]
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
    """Sums of 2x2 pixels of a picture (h, w), uint8 or uint16; border pixels are repeated outside the picture."""
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


@compiled_for_threads
def find_highest_between(image: NDArray, runs: Ints, maps: Sums, line: Sums) -> None:
    """Compute BETWEEN2 of a picture (h, w), uint8 or uint16; line (4m,) is workspace."""
    height, width = image.shape
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], runs[k, 1], runs[k, 2]
        begin, left = BLOCK * first + 1, np.float32(0.0)
        own = line[: 4 * (last - first)]
        for j in range(own.shape[0]):
            own[j] = 0.0
        inner = min(own.shape[0], max((width - begin) // 2, 0))
        begin_rows, end_rows = max(4 * row - 1, 0), min(4 * row + 4, (height - 1) // 2)
        for i in range(begin_rows, end_rows):
            x, y = image[2 * i + 1, begin : begin + 2 * inner], image[2 * i + 2, begin : begin + 2 * inner]
            for j in range(inner):
                a = (np.float32(x[2 * j]) + np.float32(x[2 * j + 1])) + (
                    np.float32(y[2 * j]) + np.float32(y[2 * j + 1])
                )
                b = own[j]
                own[j] = a if a > b else b
        for i in range(2 * begin_rows + 1, 2 * end_rows + 1 if first > 0 else 0, 2):
            a = (np.float32(image[i, begin - 2]) + np.float32(image[i, begin - 1])) + (
                np.float32(image[i + 1, begin - 2]) + np.float32(image[i + 1, begin - 1])
            )
            left = a if a > left else left
        out = maps[BETWEEN2, row, first:last]
        for j in range(out.shape[0]):
            a, b, c, d = own[4 * j], own[4 * j + 1], own[4 * j + 2], own[4 * j + 3]
            e = own[4 * j - 1] if j > 0 else left
            a, b = (a if a > b else b), (c if c > d else d)
            a = a if a > b else b
            out[j] = a if a > e else e


@compiled
def sum_2x2(fine: Sums, runs: Ints, size: int, coarse: Sums) -> None:
    """Sums of 2x2 entries of `fine`; `size` is the number of entries of `coarse` along a block's side."""
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], size * runs[k, 1], size * runs[k, 2]
        for i in range(size * row, size * row + size):
            x, y, out = fine[2 * i, 2 * first : 2 * last], fine[2 * i + 1, 2 * first : 2 * last], coarse[i, first:last]
            for j in range(out.shape[0]):
                out[j] = (x[2 * j] + x[2 * j + 1]) + (y[2 * j] + y[2 * j + 1])


@compiled
def find_highest_pairs(blocks: Blocks, runs: Ints) -> None:
    """Compute HIGHEST2 and HIGHEST4."""
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
            x, out = blocks.lines[line], blocks.maps[HIGHEST2 if line == 0 else HIGHEST4, row, runs[k, 1] : runs[k, 2]]
            for j in range(out.shape[0]):
                a, b, c, d = x[4 * j], x[4 * j + 1], x[4 * j + 2], x[4 * j + 3]
                a, b = (a if a > b else b), (c if c > d else d)
                out[j] = a if a > b else b


@compiled
def find_highest_quads(blocks: Blocks, runs: Ints) -> None:
    """Compute HIGHEST8."""
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
    """The median of five numbers."""
    a, b = (a, b) if a < b else (b, a)
    c, d = (c, d) if c < d else (d, c)
    low, high = (c if a < c else a), (b if b < d else d)  # drops the smallest and the largest of the four
    low, high = (low, high) if low < high else (high, low)
    return low if e < low else (high if e > high else e)


@compiled
def _median_at_border(x: Sums, j: int) -> float:
    """The median of the five values about one of them, where the outermost ones are repeated."""
    last = x.shape[0] - 1
    return median5(x[max(j - 2, 0)], x[max(j - 1, 0)], x[j], x[min(j + 1, last)], x[min(j + 2, last)])


@compiled
def find_row_medians(blocks: Blocks, runs: Ints) -> None:
    """Compute ROW_MEDIAN, over each block and two on each side; the outermost blocks are repeated at the border."""
    columns = blocks.maps.shape[2]
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], runs[k, 1], runs[k, 2]
        x, out = blocks.maps[SUMS, row], blocks.maps[ROW_MEDIAN, row]
        for j in range(first, min(last, BACKGROUND_REACH)):
            out[j] = _median_at_border(x, j)
        for j in range(max(first, BACKGROUND_REACH, columns - BACKGROUND_REACH), last):
            out[j] = _median_at_border(x, j)
        begin = max(first, BACKGROUND_REACH)
        inner = out[begin : max(min(last, columns - BACKGROUND_REACH), begin)]
        x = x[begin - BACKGROUND_REACH :]
        for j in range(inner.shape[0]):
            inner[j] = median5(x[j], x[j + 1], x[j + 2], x[j + 3], x[j + 4])


@compiled
def find_background(blocks: Blocks, runs: Ints, saturation: float) -> None:
    """Compute BACKGROUND: the median of five ROW_MEDIANs.

    Nearly as accurate as the median of all 25 blocks, and ten times as fast. In a block that is clipped at
    `saturation`, DN, it is the light of a wide spot if it is nearly as bright; then the lowest block counts.
    """
    rows, columns = blocks.maps.shape[1:]
    bright, clipped = np.float32(_BRIGHT * 64.0 * saturation), np.float32(_CLIPPED * 64.0 * saturation)
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], runs[k, 1], runs[k, 2]
        a, b = (
            blocks.maps[ROW_MEDIAN, max(row - 2, 0), first:last],
            blocks.maps[ROW_MEDIAN, max(row - 1, 0), first:last],
        )
        below, last_row = min(row + 1, rows - 1), min(row + 2, rows - 1)
        d, e = blocks.maps[ROW_MEDIAN, below, first:last], blocks.maps[ROW_MEDIAN, last_row, first:last]
        c, out = blocks.maps[ROW_MEDIAN, row, first:last], blocks.maps[BACKGROUND, row, first:last]
        own = blocks.maps[SUMS, row, first:last]
        for j in range(out.shape[0]):
            out[j] = median5(a[j], b[j], c[j], d[j], e[j])
        for j in range(out.shape[0]):
            if own[j] >= clipped and out[j] >= bright:
                for i in range(max(row - 2, 0), min(row + 3, rows)):
                    for m in range(max(first + j - 2, 0), min(first + j + 3, columns)):
                        out[j] = min(out[j], blocks.maps[SUMS, i, m])


@compiled
def find_bright_blocks(
    blocks: Blocks,
    runs: Ints,
    noise: Noise,
    min_sigmas: float,
    min_sigmas_wide: float,
    searched: NDArray[np.uint8],
    found: Ints,
) -> int:
    """Find blocks with a sum of 2x2 or 4x4 pixels `min_sigmas` above the background, or of 8x8 `min_sigmas_wide`.

    Blocks marked in searched (n, m) are skipped, all others become marked. found (most, 3): row, column, and 1 if only
    the sum of 8x8 pixels is above its threshold. Returns the number of blocks found.
    """
    floor, slope, black = noise.floor, noise.slope, noise.black
    count = 0
    fine, wide = 16.0 * min_sigmas**2, 64.0 * min_sigmas_wide**2
    most = np.float32(SEARCHED_TEXTURE)
    share2, banding2 = np.float64(TEXTURE_SHARE**2), (TEXTURE_SHARE * noise.banding) ** 2
    for k in range(runs.shape[0]):
        row, first, last = runs[k, 0], runs[k, 1], runs[k, 2]
        background, highest2 = blocks.maps[BACKGROUND, row, first:last], blocks.maps[HIGHEST2, row, first:last]
        between2 = blocks.maps[BETWEEN2, row, first:last]
        highest4, highest8 = blocks.maps[HIGHEST4, row, first:last], blocks.maps[HIGHEST8, row, first:last]
        excess, excess8 = blocks.lines[0, : last - first], blocks.lines[1, : last - first]
        texture = blocks.maps[TEXTURE, row, first:last]
        for j in range(background.shape[0]):
            level = background[j] / 64.0
            above_black = level - black
            variance, structure = (
                floor + slope * (above_black if above_black > 0.0 else 0.0),
                share2 * ((texture[j] if texture[j] < most else most) * level) ** 2 + banding2,
            )
            pair = highest2[j] if highest2[j] > between2[j] else between2[j]
            a, b, c = 2.0 * (pair - 4.0 * level), highest4[j] - 16.0 * level, highest8[j] - 64.0 * level
            a, b, c = (a if a > 0.0 else 0.0), (b if b > 0.0 else 0.0), (c if c > 0.0 else 0.0)
            few = (a * a > fine * (variance + 4.0 * structure)) | (b * b > fine * (variance + 16.0 * structure))
            excess[j] = 1.0 if few else 0.0
            excess8[j] = 1.0 if few | (c * c > wide * (variance + 64.0 * structure)) else 0.0
        for j in range(background.shape[0]):
            if excess8[j] > 0.0 and not searched[row, first + j]:
                found[count, 0], found[count, 1] = row, first + j
                found[count, 2] = 0 if excess[j] > 0.0 else 1
                count += 1
        searched[row, first:last] = 1
    return count
