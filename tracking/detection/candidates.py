"""Candidate positions of spots: the peaks in bright blocks.

A candidate is a maximum of the mean of 3x3 pixels. Its significance is tested with the means of 2x2, 3x3, 5x5 and 7x7
pixels, which approximate the matched filters of spots of 0.5 to 3 px sigma with a loss of an eighth of the
signal-to-noise ratio. Wide faint spots that only a mean of 8x8 pixels detects are found by `_wide_peak`.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compilation.jit import compiled
from tracking.detection.block_search import BACKGROUND, HIGHEST8, TEXTURE, Blocks, Sums
from tracking.detection.pixels import (
    SEARCHED_TEXTURE,
    Noise,
    Pixels,
    insertion_sort,
    mean8,
    mirrored,
    pair_variance,
    pixel,
    texture_variance,
    variance,
    with_texture,
)
from tracking.detection.table import Peaks
from tracking.noise import BLOCK

# Mean light of the four neighbours relative to the pixel's: 0.15 for the sharpest spot (1 px wide), 0 for a hot pixel.
HOT_SHARE = 0.08
HOT_SIGMAS = 4.0  # least excess of a hot pixel over its surroundings
_BESIDE_HOT = 2.0  # sigmas above a hot pixel's neighbours at which other pixels are clipped: hot pixels occur in pairs
_REACH = 4  # px around a block that its search uses: 2 for maxima, 2 for the means
_SIDE = BLOCK + 2 * _REACH
_LINES, _SUMS, _PAIRS, _MARKS = 1, 4, 7, 9  # in the workspace of a block, see `block_workspace`
_WEAK = 20.0  # sigmas: a weaker peak must also exceed the background's curvature ...
_WEAK_SHARE = 0.7  # ... by this share of the threshold
_WIDE_CLIP = 4.0  # sigmas above the background at which pixels are clipped in the search for wide faint spots


def block_workspace() -> Sums:
    """Workspace for one block, (_MARKS + 1, _SIDE^2): pixels; sums of 3, 5 and 7 in a line; of 3x3, 5x5 and 7x7; of 2x2
    to the right and below, and the highest of the four that contain a pixel; marks. All are integers below 2^24.
    """
    return np.zeros((_MARKS + 1, _SIDE * _SIDE), np.float32)


class PeakSearch(NamedTuple):
    """The arrays of the search for peaks in one picture."""

    image: Pixels
    noise: Noise
    saturation: float  # DN
    blocks: Blocks
    workspace: Sums  # see `block_workspace`
    scratch: Array  # (16,)
    peaks: Peaks  # (most,), the peaks found


@compiled
def find_peaks(search: PeakSearch, found: Ints, found_count: int, min_sigmas: float, count: int) -> int:
    """Append the peaks of the blocks `found` to the first `count` peaks; returns the new number of peaks."""
    blocks = search.blocks
    for k in range(found_count):
        row, column = found[k, 0], found[k, 1]
        if not found[k, 2]:
            count = _peaks_of_block(search, row, column, min_sigmas, count)
        elif _is_highest_block(blocks, row, column):
            count = _wide_peak(search, row, column, min_sigmas, count)
    return count


@compiled
def _peaks_of_block(search: PeakSearch, row: int, column: int, min_sigmas: float, count: int) -> int:
    """Append the significant maxima, among 5x5 neighbours, of the mean of 3x3 pixels in one block."""
    image, peaks, flat, scratch = search.image, search.peaks, search.workspace, search.scratch
    left, top, level = BLOCK * column, BLOCK * row, search.blocks.maps[BACKGROUND, row, column] / 64.0
    contrast = np.float64(search.blocks.maps[TEXTURE, row, column])
    noise = with_texture(search.noise, min(contrast, SEARCHED_TEXTURE))
    # Mirrored at the border: with repeated pixels the maximum of a spot at the edge would lie outside the picture.
    _read_block(image, left - _REACH, top - _REACH, flat)
    _sum_squares(flat)
    noise2, texture2 = variance(noise, level), texture_variance(noise, level)
    sigma = sqrt(noise2)
    least2 = 2 * min_sigmas * sqrt(noise2 + 4.0 * pair_variance(noise, level))
    least3 = 3 * min_sigmas * sqrt(noise2 + 9.0 * texture2)
    least5 = 5 * min_sigmas * sqrt(noise2 + 25.0 * texture2)
    least7 = 7 * min_sigmas * sqrt(noise2 + 49.0 * texture2)
    if not _mark_significant(flat, 4 * level + least2, 9 * level + least3, 25 * level + least5, 49 * level + least7):
        return count
    values, sum3, marks = flat[0], flat[_SUMS], flat[_MARKS]
    for i in range(_REACH, min(_REACH + BLOCK, image.height - top + _REACH)):
        for j in range(_REACH, min(_REACH + BLOCK, image.width - left + _REACH)):
            k = i * _SIDE + j
            if marks[k] == 0.0 or sum3[k] < max(sum3[k - 1], sum3[k + 1], sum3[k - _SIDE], sum3[k + _SIDE]):
                continue
            height3 = sum3[k] - 9 * level
            u, v = left + j - _REACH, top + i - _REACH
            if height3 <= 0 or not _is_maximum(sum3, k, u, v):
                continue
            height2 = flat[_PAIRS + 1, k] - 4 * level
            height5, height7 = flat[_SUMS + 1, k] - 25 * level, flat[_SUMS + 2, k] - 49 * level
            limit = _hot_pixel_limit(image, u, v, noise, level + height3 / 9, scratch)
            if limit < np.inf:
                height2 = _clipped_pairs(values, k, limit) - 4 * level
                height3 = _clipped_sum(values, k, 1, limit) - 9 * level
                height5 = _clipped_sum(values, k, 2, limit) - 25 * level
                height7 = _clipped_sum(values, k, 3, limit) - 49 * level
            if height2 < least2 and height3 < least3 and height5 < least5 and height7 < least7:
                continue
            if height3 <= 0 or count >= peaks.shape[0]:
                continue
            # A weak one may be the top of a diffuse reflection.
            if max(height2 / 2, height3 / 3, height5 / 5, height7 / 7) < _WEAK * sigma:
                more = _background_around(image, u, v, level + _WIDE_CLIP * sigma, scratch) - level
                higher = max(
                    height2 / 2 - 2 * more, height3 / 3 - 3 * more, height5 / 5 - 5 * more, height7 / 7 - 7 * more
                )
                if higher < _WEAK_SHARE * min_sigmas * sigma:
                    continue
            _store_peak(peaks, count, u, v, height3 / 9, level, 0.0, contrast)
            count += 1
    return count


@compiled
def _read_block(image: Pixels, left: int, top: int, flat: Sums) -> None:
    """The pixels of a square (_SIDE, _SIDE) that begins at (left, top); mirrored at the picture's border."""
    inside = left >= 0 and top >= 0 and left + _SIDE <= image.width and top + _SIDE <= image.height
    for i in range(_SIDE):
        out = flat[0, i * _SIDE : (i + 1) * _SIDE]
        if inside and image.depth == 1:
            line = image.bytes[top + i, left : left + _SIDE]
            for j in range(_SIDE):
                out[j] = line[j]
            continue
        if inside:
            line = image.bytes[top + i, 2 * left : 2 * (left + _SIDE)]
            for j in range(_SIDE):
                out[j] = np.float32(line[2 * j]) + np.float32(256.0) * np.float32(line[2 * j + 1])
            continue
        v = mirrored(top + i, image.height)
        for j in range(_SIDE):
            out[j] = pixel(image, mirrored(left + j, image.width), v)


@compiled
def _sum_squares(flat: Sums) -> None:
    """Sums over squares of pixels, in flat arrays (_MARKS + 1, _SIDE^2): the sum of 2 r + 1 lines of 2 r + 1 pixels.

    Flat, since one long loop is vectorised and several short ones are not. Sums that reach over the end of a line are
    wrong, and not used.
    """
    x, three, five, seven = flat[0], flat[_LINES], flat[_LINES + 1], flat[_LINES + 2]
    sum3, sum5, sum7 = flat[_SUMS], flat[_SUMS + 1], flat[_SUMS + 2]
    n = _SIDE * _SIDE
    for k in range(n - 2):
        three[k] = x[k] + x[k + 1] + x[k + 2]
    for k in range(n - 4):
        five[k] = three[k] + x[k + 3] + x[k + 4]
    for k in range(n - 6):
        seven[k] = five[k] + x[k + 5] + x[k + 6]
    for k in range(n - 2 * (_SIDE + 1)):
        sum3[k + _SIDE + 1] = three[k] + three[k + _SIDE] + three[k + 2 * _SIDE]
    for k in range(n - 4 * (_SIDE + 1)):
        total = five[k] + five[k + _SIDE] + five[k + 2 * _SIDE]
        sum5[k + 2 * (_SIDE + 1)] = total + five[k + 3 * _SIDE] + five[k + 4 * _SIDE]
    for k in range(n - 6 * (_SIDE + 1)):
        total = seven[k] + seven[k + _SIDE] + seven[k + 2 * _SIDE] + seven[k + 3 * _SIDE]
        sum7[k + 3 * (_SIDE + 1)] = total + seven[k + 4 * _SIDE] + seven[k + 5 * _SIDE] + seven[k + 6 * _SIDE]
    below, highest = flat[_PAIRS], flat[_PAIRS + 1]
    for k in range(n - _SIDE - 1):
        below[k] = (x[k] + x[k + 1]) + (x[k + _SIDE] + x[k + _SIDE + 1])
    for k in range(n - 2 * (_SIDE + 1)):
        a, b, c, d = below[k], below[k + 1], below[k + _SIDE], below[k + _SIDE + 1]
        a, b = (a if a > b else b), (c if c > d else d)
        highest[k + _SIDE + 1] = a if a > b else b


@compiled
def _mark_significant(flat: Sums, least2: float, least3: float, least5: float, least7: float) -> bool:
    """Mark the pixels where a sum of 2x2, 3x3, 5x5 or 7x7 pixels reaches its threshold; whether there may be any.

    In most bright blocks there is none. Marks between the block's lines, where the sums are wrong, are not used.
    """
    first, n = _REACH * _SIDE + _REACH, (BLOCK - 1) * _SIDE + BLOCK
    sum2, sum3 = flat[_PAIRS + 1, first : first + n], flat[_SUMS, first : first + n]
    sum5, sum7 = flat[_SUMS + 1, first : first + n], flat[_SUMS + 2, first : first + n]
    marks, found = flat[_MARKS, first : first + n], 0
    # The sums are integers, for which the comparison with the next integer is the same; it is exact in float32.
    low2, low3 = np.float32(np.ceil(least2)), np.float32(np.ceil(least3))
    low5, low7 = np.float32(np.ceil(least5)), np.float32(np.ceil(least7))
    for k in range(n):
        mark = ((sum2[k] >= low2) | (sum3[k] >= low3)) | ((sum5[k] >= low5) | (sum7[k] >= low7))
        marks[k] = np.float32(1.0) if mark else np.float32(0.0)
        found += 1 if mark else 0
    return found > 0


@compiled
def _is_maximum(values: Sums, k: int, u: int, v: int) -> bool:
    """Whether no value among the 5x5 neighbours is larger, and no earlier one in the picture is equal.

    u, v: the pixel of k. Outside the picture lies its mirror image, which is equal.
    """
    here, higher = values[k], 0
    for a in range(-2, 3):
        for b in range(-2, 3):
            other, earlier = values[k + a * _SIDE + b], a < 0 or (a == 0 and b < 0)
            higher += 1 if other > here or (other == here and earlier and v + a >= 0 and u + b >= 0) else 0
    return higher == 0


@compiled
def _clipped_sum(values: Sums, k: int, reach: int, limit: float) -> float:
    """The sum of the values within `reach` of one, each clipped at the limit."""
    total = 0.0
    for a in range(-reach, reach + 1):
        for b in range(-reach, reach + 1):
            total += min(values[k + a * _SIDE + b], limit)
    return total


@compiled
def _clipped_pairs(values: Sums, k: int, limit: float) -> float:
    """The highest sum of 2x2 values that contain one, each clipped at the limit."""
    best = -np.inf
    for a in range(-1, 1):
        for b in range(-1, 1):
            m = k + a * _SIDE + b
            above = min(values[m], limit) + min(values[m + 1], limit)
            best = max(best, above + min(values[m + _SIDE], limit) + min(values[m + _SIDE + 1], limit))
    return best


@compiled
def _hot_pixel_limit(image: Pixels, u: int, v: int, noise: Noise, level: float, scratch: Array) -> float:
    """The clipping limit, DN, for the neighbours of the brightest of 3x3 pixels if that one is hot; else inf.

    A hot pixel is isolated, unlike light that passed through a lens. `level`, DN, sets the noise: at the flat top of a
    wide spot the value of the highest pixel itself is biased upwards.
    """
    best, bu, bv = -1.0, u, v
    for i in range(max(v - 1, 0), min(v + 2, image.height)):
        for j in range(max(u - 1, 0), min(u + 2, image.width)):
            x = pixel(image, j, i)
            if x > best:
                best, bu, bv = x, j, i
    cross, n = 0.0, 0
    for i in range(-2, 3):
        row = mirrored(bv + i, image.height)
        for j in range(-2, 3):
            if max(abs(i), abs(j)) == 2:
                scratch[n] = pixel(image, mirrored(bu + j, image.width), row)
                n += 1
            elif abs(i) + abs(j) == 1:
                cross += 0.25 * pixel(image, mirrored(bu + j, image.width), row)
    insertion_sort(scratch, 16)
    ring = 0.5 * (scratch[7] + scratch[8])
    above = best - ring
    if cross - ring < HOT_SHARE * above and above > HOT_SIGMAS * sqrt(variance(noise, level)):
        return cross + _BESIDE_HOT * sqrt(variance(noise, cross))
    return np.inf


@compiled
def _is_highest_block(blocks: Blocks, row: int, column: int) -> bool:
    rows, columns = blocks.maps.shape[1:]
    here = blocks.maps[HIGHEST8, row, column]
    for i in range(max(row - 1, 0), min(row + 2, rows)):
        for j in range(max(column - 1, 0), min(column + 2, columns)):
            other = blocks.maps[HIGHEST8, i, j]
            if other > here or (other == here and (i < row or (i == row and j < column))):
                return False
    return True


@compiled
def _wide_peak(search: PeakSearch, row: int, column: int, min_sigmas: float, count: int) -> int:
    """Append a peak where the mean of 8x8 pixels exceeds the background by more than the background's curvature.

    Bright pixels are clipped, so that a hot pixel does not become a wide spot.
    """
    image, blocks, peaks = search.image, search.blocks, search.peaks
    noise = with_texture(search.noise, blocks.maps[TEXTURE, row, column])
    rows, columns = blocks.quads.shape
    bi, bj, best = 2 * row, 2 * column, -1.0
    for i in range(2 * row, min(2 * row + 2, rows - 1)):
        for j in range(2 * column, min(2 * column + 2, columns - 1)):
            four = (blocks.quads[i, j] + blocks.quads[i, j + 1]) + (blocks.quads[i + 1, j] + blocks.quads[i + 1, j + 1])
            if four > best:
                best, bi, bj = four, i, j
    u, v = 4 * bj + 4, 4 * bi + 4
    if u >= image.width or v >= image.height:
        return count
    scratch = search.scratch
    level = blocks.maps[BACKGROUND, row, column] / 64.0
    sigma2 = variance(noise, level)
    top = level + _WIDE_CLIP * sqrt(sigma2)
    here = mean8(image, u, v, top)
    height = here - _background_around(image, u, v, top, scratch)
    # A median of eight has 1.4 times the variance of their mean.
    scatter = sqrt((sigma2 / 64.0 + texture_variance(noise, level)) * (1 + 1.4 / 8 * 17.0 / 9.0))
    if height < min_sigmas * scatter or count >= peaks.shape[0]:
        return count
    _store_peak(peaks, count, u, v, height, level, 1.0, noise.texture)
    return count + 1


@compiled
def _store_peak(
    peaks: Peaks, row: int, u: int, v: int, height: float, level: float, wide: float, contrast: float
) -> None:
    peak = peaks[row]
    peak["u"], peak["v"], peak["height"], peak["level"], peak["wide"], peak["scale"] = u, v, height, level, wide, 1.0
    peak["contrast"] = contrast


@compiled
def _background_around(image: Pixels, u: int, v: int, top: float, scratch: Array) -> float:
    """The background at a point from its surroundings, DN: correct for a plane and for a paraboloid.

    It is 4/3 r - 1/3 R with r and R the medians of eight means of 8x8 pixels, clipped at `top`, 16 and 32 px away,
    which cancels the curvature of a diffuse reflection. Source: ours.
    """
    level = 0.0
    for k in range(2):
        away, n = 16 * (k + 1), 0
        for i in range(-1, 2):
            for j in range(-1, 2):
                if i != 0 or j != 0:
                    scratch[n] = mean8(image, u + j * away, v + i * away, top)
                    n += 1
        insertion_sort(scratch, 8)
        level += (4.0 / 3.0 if k == 0 else -1.0 / 3.0) * 0.5 * (scratch[3] + scratch[4])
    return level
