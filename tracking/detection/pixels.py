"""Single pixels and small windows of a picture, the noise of pixels, and the order of few values, for compiled code.

A picture is viewed as bytes, so that 8 and 16 bits share the compiled code of all steps but the first pass.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array
from geometry.compilation.jit import compiled, compiled_for_sums

OUTSIDE, CLIPPED, VALID = 0.0, 1.0, 2.0


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
    cell = window.cell
    share = 1.0 / (cell * cell)
    right, bottom = window.left + cell * window.columns, window.top + cell * window.rows
    if image.depth == 1 and window.left >= 0 and window.top >= 0 and right <= image.width and bottom <= image.height:
        _read_inner_window(image, window, share, saturation, values, state)
        return
    for i in range(window.rows):
        top = window.top + i * cell
        for j in range(window.columns):
            left = window.left + j * cell
            k = i * window.columns + j
            values[k], state[k] = 0.0, OUTSIDE
            if left < 0 or top < 0 or left + cell > image.width or top + cell > image.height:
                continue
            if cell == 1:
                total = most = pixel(image, left, top)
            else:
                total = most = 0.0
                for v in range(top, top + cell):
                    for u in range(left, left + cell):
                        x = pixel(image, u, v)
                        total += x
                        most = max(most, x)
            values[k] = total * share
            state[k] = VALID if most < saturation else CLIPPED


@compiled
def _read_inner_window(
    image: Pixels, window: Window, share: float, saturation: float, values: Array, state: Array
) -> None:
    """`read_window` of an 8 bit picture for a window inside it: the same values, in half the time and less."""
    cell, n = window.cell, window.columns
    total, highest = np.empty(n * cell), np.empty(n * cell)  # of the pixels of a column in a row of cells
    for i in range(window.rows):
        top = window.top + i * cell
        line = image.bytes[top, window.left : window.left + n * cell]
        for j in range(line.shape[0]):
            total[j] = highest[j] = line[j]
        for v in range(top + 1, top + cell):
            line = image.bytes[v, window.left : window.left + n * cell]
            for j in range(line.shape[0]):
                x = np.float64(line[j])
                total[j] += x
                highest[j] = x if x > highest[j] else highest[j]
        for j in range(n):
            light, most = total[cell * j], highest[cell * j]
            for u in range(cell * j + 1, cell * j + cell):
                light += total[u]
                most = max(most, highest[u])
            values[i * n + j] = light * share
            state[i * n + j] = VALID if most < saturation else CLIPPED


# Share of the threshold that applies to the sigma of the texture, which has far fewer independent places than pixels.
TEXTURE_SHARE = 5.0 / 6.0
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
