"""Single pixels and small windows of a picture, the noise of pixels, and the order of few values, for compiled code.

A picture is viewed as bytes, so that 8 and 16 bits share the compiled code of all steps but the first pass.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array
from geometry.compilation.jit import compiled, compiled_for_sums

OUTSIDE, CLIPPED, VALID = 0.0, 1.0, 2.0  # states of a cell


class Pixels(NamedTuple):
    """The pixels of a picture."""

    bytes: NDArray[np.uint8]  # (h, w depth)
    depth: int  # bytes per pixel: 1 or 2, little end first
    width: int
    height: int


@compiled
def pixel(image: Pixels, u: int, v: int) -> float:
    """The grey value at column u, row v."""
    if image.depth == 1:
        return np.float64(image.bytes[v, u])
    return image.bytes[v, 2 * u] + 256.0 * image.bytes[v, 2 * u + 1]


@compiled
def mirrored(i: int, size: int) -> int:
    """An index, reflected at the outermost pixels if it lies outside a row or column of that size."""
    i = abs(i)
    if i > size - 1:
        i = 2 * (size - 1) - i
    return min(max(i, 0), size - 1)


@compiled
def clamped(i: int, size: int) -> int:
    """An index, moved to the outermost pixel if it lies outside a row or column of that size."""
    return min(max(i, 0), size - 1)


@compiled
def mean3(image: Pixels, u: int, v: int) -> float:
    """The mean of the 3x3 pixels around a pixel; border pixels are repeated outside the picture."""
    total = 0.0
    if image.depth == 1 and 0 < u < image.width - 1 and 0 < v < image.height - 1:
        for i in range(v - 1, v + 2):
            for j in range(u - 1, u + 2):
                total += image.bytes[i, j]
        return total / 9.0
    for i in range(v - 1, v + 2):
        for j in range(u - 1, u + 2):
            total += pixel(image, clamped(j, image.width), clamped(i, image.height))
    return total / 9.0


@compiled
def mean8(image: Pixels, u: int, v: int, top: float) -> float:
    """The mean of 8x8 pixels, clipped at `top`, starting at (u - 4, v - 4); border pixels are repeated outside."""
    total = 0.0
    if image.depth == 1 and u >= 4 and v >= 4 and u + 4 <= image.width and v + 4 <= image.height:
        for i in range(v - 4, v + 4):
            line = image.bytes[i, u - 4 : u + 4]
            for j in range(8):
                total += min(np.float64(line[j]), top)
        return total / 64.0
    for i in range(v - 4, v + 4):
        for j in range(u - 4, u + 4):
            total += min(pixel(image, clamped(j, image.width), clamped(i, image.height)), top)
    return total / 64.0


class Window(NamedTuple):
    """A rectangle of cells, each the mean of cell x cell pixels, so that wide spots do not need more cells."""

    left: int  # px, first column
    top: int  # px, first row
    columns: int
    rows: int
    cell: int  # px


@compiled
def window_around(u: float, v: float, half_columns: int, half_rows: int, cell: int) -> Window:
    """The window of (2 half + 1) cells in each direction whose centre is nearest to a point, px."""
    columns, rows = 2 * half_columns + 1, 2 * half_rows + 1
    left, top = int(np.rint(u - 0.5 * (columns * cell - 1))), int(np.rint(v - 0.5 * (rows * cell - 1)))
    return Window(left, top, columns, rows, cell)


@compiled
def read_window(image: Pixels, window: Window, saturation: float, values: Array, state: Array) -> None:
    """The cells' values (cells,), DN, and states (cells,): OUTSIDE (at least partly), CLIPPED (any pixel) or VALID."""
    cell, columns = window.cell, window.columns
    first = min(max(-window.left + cell - 1, 0) // cell, columns)  # the first column of cells inside the picture
    n = max(min(max(image.width - window.left, 0) // cell, columns) - first, 0)
    left = window.left + first * cell
    if n < columns or window.top < 0 or window.top + cell * window.rows > image.height:
        for k in range(columns * window.rows):
            values[k], state[k] = 0.0, OUTSIDE
    begin, end = max(-(window.top // cell), 0), min((image.height - window.top) // cell, window.rows)  # rows inside
    if cell > 1 or image.depth > 1:
        _read_cells(image, window, first, n, begin, end, saturation, values, state)
        return
    for i in range(begin, end):
        line = image.bytes[window.top + i, left : left + n]
        cells, states = values[i * columns + first :], state[i * columns + first :]
        for j in range(n):
            cells[j] = line[j]
            states[j] = VALID if line[j] < saturation else CLIPPED


@compiled
def _read_cells(
    image: Pixels, window: Window, first: int, n: int, begin: int, end: int, saturation: float, values: Array,
    state: Array,
) -> None:  # fmt: skip
    """`read_window` for the n columns of cells from `first` on, of the rows from `begin` to `end`."""
    cell, left = window.cell, window.left + first * window.cell
    width, share = n * cell, 1.0 / (cell * cell)
    # Sums and highest values of the pixels of a column in a row of cells, then of two and four columns; workspace.
    total, highest = np.empty(width, np.int32), np.empty(width, np.int32)
    more, higher = np.empty(width, np.int32), np.empty(width, np.int32)
    for i in range(begin, end):
        for j in range(width):
            total[j] = highest[j] = 0
        for v in range(window.top + i * cell, window.top + (i + 1) * cell):
            line = image.bytes[v, image.depth * left : image.depth * (left + width)]
            if image.depth == 1:
                for j in range(width):
                    higher[j] = line[j]
            else:
                for j in range(width):
                    higher[j] = np.int32(line[2 * j]) + 256 * np.int32(line[2 * j + 1])
            for j in range(width):
                total[j] += higher[j]
                highest[j] = higher[j] if higher[j] > highest[j] else highest[j]
        added = width
        while added > n:
            added //= 2
            for j in range(added):
                more[j] = total[2 * j] + total[2 * j + 1]
                higher[j] = highest[2 * j] if highest[2 * j] > highest[2 * j + 1] else highest[2 * j + 1]
            for j in range(added):
                total[j], highest[j] = more[j], higher[j]
        cells, states = values[i * window.columns + first :], state[i * window.columns + first :]
        for j in range(n):
            cells[j] = total[j] * share
            states[j] = VALID if highest[j] < saturation else CLIPPED


# Share of the threshold that applies to the sigma of the texture, which has far fewer independent places than pixels.
TEXTURE_SHARE = 5.0 / 6.0
# Largest contrast of the texture in the search: an even place may lie between objects that have more. The peaks found
# are then compared with the light on circles around them (moments.stands_out).
SEARCHED_TEXTURE = 0.045
_FINER = 9.0 / 4.0  # ratio of the variances of means of 2x2 and 3x3 pixels of a texture finer than a pixel


class Noise(NamedTuple):
    """tracking.noise.NoiseModel for compiled code."""

    floor: float
    slope: float
    black: float
    texture: float
    banding: float
    compression: float


@compiled
def variance(noise: Noise, level: float) -> float:
    """Variance of a pixel with the expected grey value `level`, DN^2."""
    return noise.floor + noise.slope * max(level - noise.black, 0.0)


@compiled
def texture_variance(noise: Noise, level: float) -> float:
    """Variance, DN^2, of the mean of a few background pixels due to fixed structure and rounding."""
    return TEXTURE_SHARE**2 * ((noise.texture * level) ** 2 + noise.banding**2)


@compiled
def with_texture(noise: Noise, texture: float) -> Noise:
    """The noise at a place with this contrast of the texture."""
    return Noise(noise.floor, noise.slope, noise.black, texture, noise.banding, noise.compression)


@compiled
def pair_variance(noise: Noise, level: float) -> float:
    """As `texture_variance`, of the mean of 2x2 pixels: that of fine texture is larger than of 3x3.

    Infinite for compressed pictures: their smallest details are errors of the compression.
    """
    if noise.compression > 0.0:
        return np.inf
    return TEXTURE_SHARE**2 * (_FINER * (noise.texture * level) ** 2 + noise.banding**2)


@compiled
def insertion_sort(values: Array, n: int) -> None:
    """Sort the first n values in place; for small n."""
    for i in range(1, n):
        x, j = values[i], i
        while j > 0 and values[j - 1] > x:
            values[j] = values[j - 1]
            j -= 1
        values[j] = x


@compiled
def nth_smallest(values: Array, n: int, rank: int) -> float:
    """The value of this rank, from 0, among the first n values, whose order changes (Hoare's selection)."""
    first, last = 0, n - 1
    while first < last:
        middle, i, j = values[(first + last) // 2], first, last
        while i <= j:
            while values[i] < middle:
                i += 1
            while values[j] > middle:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        if rank <= j:
            last = j
        elif rank >= i:
            first = i
        else:
            break
    return values[rank]


@compiled
def insert_nearest(near: NDArray, gaps: Array, filled: int, most: int, gap: float, row: int) -> int:
    """Enter a row into the at most `most` nearest ones, sorted by gap; returns their new number."""
    if filled == most and gap >= gaps[most - 1]:
        return filled
    k = min(filled, most - 1)
    while k > 0 and gaps[k - 1] > gap:
        gaps[k], near[k] = gaps[k - 1], near[k - 1]
        k -= 1
    gaps[k], near[k] = gap, row
    return min(filled + 1, most)


@compiled_for_sums
def total_of(values: Array) -> float:
    """The sum of an array."""
    total = 0.0
    for k in range(values.shape[0]):
        total += values[k]
    return total


@compiled_for_sums
def total_of_products(x: Array, y: Array) -> float:
    """The sum of the products of two arrays of one length."""
    total = 0.0
    for k in range(x.shape[0]):
        total += x[k] * y[k]
    return total


@compiled
def maximum_of(values: Array) -> float:
    """The largest of values of at least 0."""
    a = b = 0.0
    for k in range(values.shape[0] // 2):
        x, y = values[2 * k], values[2 * k + 1]
        a, b = (x if x > a else a), (y if y > b else b)
    if values.shape[0] % 2:
        a = max(a, values[-1])
    return max(a, b)
