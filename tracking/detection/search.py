"""The search for peaks in boxes of blocks: block sums, bright blocks, peaks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Ints
from geometry.compilation.jit import compiled_for_threads
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

BORDER_BLOCKS = 2  # blocks around a box that its search needs
BLOCK_SHARE, PEAK_SHARE = 0.63, 0.75  # shares of the threshold above which a block is searched and a peak is measured


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
    find_background(blocks, inner)
    find_highest_pairs(blocks, inner)
    least, measured = BLOCK_SHARE * threshold_sigma, PEAK_SHARE * threshold_sigma
    n = find_bright_blocks(blocks, inner, search.noise, least, measured, searched, found)
    return find_peaks(search, found, n, measured, count)
