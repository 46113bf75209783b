"""The search for peaks in boxes of blocks (block sums, bright blocks, peaks), and the separate ones among them."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled, compiled_for_threads
from tracking.detection.block_search import (
    BACKGROUND_REACH,
    SUMS,
    find_background,
    find_bright_blocks,
    find_highest_pairs,
    find_highest_quads,
    find_row_medians,
    runs_of,
    sum_2x2,
)
from tracking.detection.candidates import PeakSearch, find_peaks
from tracking.detection.moments import MOST_ON_RING, PEAK_SHARE, is_round, is_sharp, stands_out
from tracking.detection.pixels import (
    Noise,
    Pixels,
    clamped,
    insert_nearest,
    insertion_sort,
    mean3,
    pixel,
    variance,
)
from tracking.detection.table import Peak, Peaks

BORDER_BLOCKS = 2  # blocks around a box that its search needs
RADIUS = 48  # px: peaks farther apart than this are never parts of one spot of the largest size
MAX_COMPARED = 4  # number of brighter peaks that a peak is compared with
DIP = 0.12  # share of the fainter peak by which the light must fall between two spots: the top of a spot falls by less
_HIGHER = 0.4  # share of the light of a square by which it exceeds that around a peak that is no part of the same spot
HALO_SHARE = 0.012  # ... and of the brighter peak: rings and halos of real beams have up to 0.009
# Half sides, px, of the squares that are tried for the scale of a light, each with the one of half its size.
_HALF_SIDES, _HALVED = (3, 4, 6, 8, 12, 16, 24), (2, 2, 3, 4, 6, 8, 12)
# Least ratio of the two means: that of a Gaussian with a square of 0.83 sigmas to each side.
_FILLED = (0.88, 0.85, 0.85, 0.85, 0.85, 0.85, 0.85)
_LEAST_FILLED = 0.5  # least ratio of the mean of the square to the peak: that of a narrow spot is mostly empty
# A narrow spot on the light of a reflection: its height in sigmas of the means of 3x3 pixels in the square; and the
# light of small squares above the background from the search, which contains the reflection, relative to the peak's.
_OUTLIER, _LEAST_BESIDE = 4.0, 0.2
_FIRST_SURROUNDINGS = 40  # px: distance of the background from a peak; of a wide one ...
_SURROUNDINGS = 4  # ... this many half sides, 3.3 sigmas
_LEVEL_HALF_SIDE = 4  # px: half side of the squares of the background
_NARROW = 2.5  # half side, px, below which means of 3x3 pixels are compared
_ROUND = 0.35  # least share of the light around a peak that a round Gaussian explains: others cost the most to fit
BLOCK_SHARE = 0.63  # share of the threshold above which a block is searched


@compiled_for_threads
def find_peaks_in(
    boxes: Ints,
    search: PeakSearch,
    threshold_sigma: float,
    searched: NDArray[np.uint8],
    found: Ints,
    runs: Ints,
    count: int,
) -> int:
    """Append the peaks in boxes (n, 4) of blocks to the first `count` peaks; returns the new number of peaks.

    blocks.pairs must contain the sums of the boxes and of BORDER_BLOCKS blocks around them. Blocks marked in `searched`
    are skipped, all others become marked.
    """
    blocks = search.blocks
    rows, columns = blocks.maps.shape[1:]
    wide = runs[: runs_of(boxes, BORDER_BLOCKS, BORDER_BLOCKS, rows, columns, runs)]
    sum_2x2(blocks.pairs, wide, 2, blocks.quads)
    sum_2x2(blocks.quads, wide, 1, blocks.maps[SUMS])
    find_highest_quads(blocks, runs[: runs_of(boxes, 1, 1, rows, columns, runs)])
    find_row_medians(blocks, runs[: runs_of(boxes, BACKGROUND_REACH, 0, rows, columns, runs)])
    inner = runs[: runs_of(boxes, 0, 0, rows, columns, runs)]
    find_background(blocks, inner, search.saturation)
    find_highest_pairs(blocks, inner)
    least, measured = BLOCK_SHARE * threshold_sigma, PEAK_SHARE * threshold_sigma
    n = find_bright_blocks(blocks, inner, search.noise, least, measured, searched, found)
    return find_peaks(search, found, n, measured, count)


@compiled
def find_separate_peaks(
    image: Pixels, peaks: Peaks, order: Ints, wanted: Bools, noise: Noise, threshold_sigma: float, separate: Ints,
    near: Ints, gaps: Array,
) -> int:  # fmt: skip
    """The rows of separate spots among the wanted peaks (n,), into `separate`; returns their number.

    order: the rows of all peaks that these are compared with, brightest first.

    Between a peak and each of the nearest brighter ones the light must fall by `DIP` of the fainter peak, and by four
    sigmas of the difference of two means of nine pixels. Speckle makes deeper dips within a wide spot, so there the
    means of squares as large as the light around the peak must fall as well. A wide faint peak must have no other peak
    within 16 px. Fills the scale of the separate peaks. `near`, `gaps` (MAX_COMPARED,) are workspace. Source: ours.
    """
    count, border, ring = 0, np.zeros(8), np.zeros(MOST_ON_RING)
    for place in range(order.shape[0]):
        i = order[place]
        if not wanted[i]:
            continue
        if peaks[i]["wide"]:
            alone = not _has_neighbour(peaks, order, i)
        else:
            alone = True
            needed = max(DIP * peaks[i]["height"], 4.0 / 3.0 * sqrt(2.0) * sqrt(variance(noise, peaks[i]["level"])))
            for k in range(_nearest(peaks, i, order, place, near, gaps)):
                lowest = _lowest_between(image, peaks, i, near[k], 1) - peaks[i]["level"]
                least = max(needed, HALO_SHARE * peaks[near[k]]["height"])
                alone = alone and peaks[i]["height"] - lowest >= least
            if alone and stands_out(image, peaks[i], noise, threshold_sigma, ring):
                sigma2 = variance(noise, peaks[i]["level"])
                alone = is_round(image, int(peaks[i]["u"]), int(peaks[i]["v"]), sigma2, _ROUND)
            elif alone:
                alone = is_sharp(image, peaks[i], noise, threshold_sigma)
            if alone:
                level = _find_scale(image, peaks[i], border)
                for k in range(_nearest(peaks, i, separate, count, near, gaps)):
                    half = int(min(peaks[i]["scale"], peaks[near[k]]["scale"]))
                    if half < _NARROW:
                        continue
                    if not alone:
                        break
                    j = near[k]
                    here = _mean_of_square(image, peaks[i]["u"], peaks[i]["v"], half)
                    there = _mean_of_square(image, peaks[j]["u"], peaks[j]["v"], half)
                    if here - there > _HIGHER * (here - level):
                        continue  # the other one is part of a brighter background
                    height = min(here, there) - level
                    lowest = _lowest_between(image, peaks, i, j, half) - level
                    alone = height - lowest >= DIP * height
        if alone:
            separate[count] = i
            count += 1
    return count


@compiled
def _find_scale(image: Pixels, peak: Peak, border: Array) -> float:
    """Fill the scale of a peak: half side, px, of the largest square that its light fills; returns the background, DN.

    The highest of nine neighbouring squares is taken, from small to large: a peak of speckle is far higher than the
    light around it and may be far from its middle. The background from the search, a median over 40 px, contains the
    light of a spot wider than that, so the lower one of it and the median of eight squares around the light is used.
    border (8,) is workspace.
    """
    level, top, away = peak["level"], peak["height"] + peak["level"], _FIRST_SURROUNDINGS
    u, v = peak["u"], peak["v"]
    for _ in range(2):
        level = min(level, _level_around(image, u, v, away, border))
        scale = 1
        for k in range(len(_HALF_SIDES)):
            mean, u, v = _highest_square(image, peak["u"], peak["v"], _HALF_SIDES[k])
            if mean - level < _LEAST_FILLED * (top - level):
                break
            beside = 4 <= _HALF_SIDES[k] <= 8 and mean - peak["level"] < _LEAST_BESIDE * peak["height"]
            if beside or top - mean > _OUTLIER * _scatter_of_means(image, u, v, _HALF_SIDES[k]):
                scale = 1
                break
            halved, _, _ = _highest_square(image, u, v, _HALVED[k])
            if mean - level >= _FILLED[k] * (halved - level):
                scale = _HALF_SIDES[k]
        peak["scale"], away = scale, _SURROUNDINGS * scale
        if away <= _FIRST_SURROUNDINGS:
            break
    return level


@compiled
def _level_around(image: Pixels, u: float, v: float, away: int, border: Array) -> float:
    """The median of the means of eight squares at a distance from a point, DN. border (8,) is workspace."""
    n = 0
    for i in range(-1, 2):
        for j in range(-1, 2):
            if i != 0 or j != 0:
                border[n] = _mean_of_square(image, u + j * away, v + i * away, _LEVEL_HALF_SIDE)
                n += 1
    insertion_sort(border, 8)
    return 0.5 * (border[3] + border[4])


@compiled
def _highest_square(image: Pixels, u: float, v: float, half: int) -> tuple[float, float, float]:
    """The mean, DN, and the centre of the brightest of nine squares: one at a point, the others half a side away."""
    best, at_u, at_v = -1.0, u, v
    step = half // 2
    for i in range(-1, 2):
        for j in range(-1, 2):
            mean = _mean_of_square(image, u + j * step, v + i * step, half)
            if mean > best:
                best, at_u, at_v = mean, u + j * step, v + i * step
    return best, at_u, at_v


@compiled
def _scatter_of_means(image: Pixels, u: float, v: float, half: int) -> float:
    """The standard deviation, DN, of the means of 3x3 pixels in the square of (2 half + 1)^2 pixels about a point."""
    total, squares, n = 0.0, 0.0, 0
    column, row, step = int(np.rint(u)), int(np.rint(v)), max(half // 4, 1)
    for i in range(row - half, row + half + 1, step):
        for j in range(column - half, column + half + 1, step):
            mean = mean3(image, clamped(j, image.width), clamped(i, image.height))
            total, squares, n = total + mean, squares + mean * mean, n + 1
    return sqrt(max(squares / n - (total / n) ** 2, 0.0))


@compiled
def _mean_of_square(image: Pixels, u: float, v: float, half: int) -> float:
    """The mean of about 9x9 evenly spaced pixels, at most, of the square of (2 half + 1)^2 pixels about a point, DN.

    Border pixels are repeated outside the picture.
    """
    total, n = 0.0, 0
    column, row, step = int(np.rint(u)), int(np.rint(v)), max(half // 4, 1)
    inside = half <= column < image.width - half and half <= row < image.height - half
    for i in range(row - half, row + half + 1, step):
        if inside and image.depth == 1:
            for j in range(column - half, column + half + 1, step):
                total += image.bytes[i, j]
                n += 1
            continue
        for j in range(column - half, column + half + 1, step):
            total += pixel(image, clamped(j, image.width), clamped(i, image.height))
            n += 1
    return total / n


@compiled
def _has_neighbour(peaks: Peaks, order: Ints, i: int) -> bool:
    for place in range(order.shape[0]):
        j = order[place]
        if not peaks[j]["wide"] and abs(peaks[i]["u"] - peaks[j]["u"]) < 16 and abs(peaks[i]["v"] - peaks[j]["v"]) < 16:
            return True
    return False


@compiled
def _nearest(peaks: Peaks, i: int, rows: Ints, count: int, near: Ints, gaps: Array) -> int:
    """The peaks nearest to peak i among the first `count` rows, at most MAX_COMPARED, into `near`; their number."""
    filled = 0
    for k in range(count):
        j = rows[k]
        du, dv = peaks[i]["u"] - peaks[j]["u"], peaks[i]["v"] - peaks[j]["v"]
        gap = du * du + dv * dv
        if not peaks[j]["wide"] and gap < RADIUS**2:
            filled = insert_nearest(near, gaps, filled, MAX_COMPARED, gap, j)
    return filled


@compiled
def _lowest_between(image: Pixels, peaks: Peaks, i: int, j: int, half: int) -> float:
    """The lowest mean of (2 half + 1)^2 pixels at eleven points on the line between two peaks, DN."""
    lowest = np.inf
    for k in range(1, 12):
        share = k / 12.0
        u = peaks[i]["u"] * (1 - share) + peaks[j]["u"] * share
        v = peaks[i]["v"] * (1 - share) + peaks[j]["v"] * share
        if half == 1:
            lowest = min(lowest, mean3(image, int(np.rint(u)), int(np.rint(v))))
        else:
            lowest = min(lowest, _mean_of_square(image, u, v, half))
    return lowest
