"""The search for peaks in boxes of blocks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Ints
from geometry.compilation.jit import compiled_for_threads
from tracking.detection.block_search import (
    AROUND,
    SUMS,
    Blocks,
    find_ground,
    find_highest_pairs,
    find_highest_quads,
    find_middle,
    find_standing_out,
    fold,
    runs_of,
)
from tracking.detection.candidates import TEXTURE_SHARE, Noise, find_peaks
from tracking.detection.pixels import Pixels

HALO = 2  # blocks around a box that its search needs
BLOCK_SHARE, PEAK_SHARE = 0.63, 0.75  # of the threshold: to look closer at a block; to measure a peak


@compiled_for_threads
def find_peaks_in(
    boxes: Ints, image: Pixels, blocks: Blocks, noise: Noise, threshold_sigma: float, searched: NDArray[np.uint8],
    found: Ints, runs: Ints, room: Array, peaks: Array, count: int,
) -> int:  # fmt: skip
    """Add the peaks in boxes (n, 4) of blocks to the first `count` ones; their number then.

    The pixels of the boxes and of HALO blocks around them are binned into blocks.pairs already. Blocks that are marked
    in `searched` are passed over, the others become marked.
    """
    rows, columns = blocks.maps.shape[1:]
    wide = runs[: runs_of(boxes, HALO, HALO, rows, columns, runs)]
    fold(blocks.pairs, wide, 2, blocks.quads)
    fold(blocks.quads, wide, 1, blocks.maps[SUMS])
    find_highest_quads(blocks, runs[: runs_of(boxes, 1, 1, rows, columns, runs)])
    find_middle(blocks, runs[: runs_of(boxes, AROUND, 0, rows, columns, runs)])
    inner = runs[: runs_of(boxes, 0, 0, rows, columns, runs)]
    find_ground(blocks, inner)
    find_highest_pairs(blocks, inner)
    least, measured = BLOCK_SHARE * threshold_sigma, PEAK_SHARE * threshold_sigma
    n = find_standing_out(
        blocks, inner, noise.floor, noise.slope, noise.black, TEXTURE_SHARE * noise.texture,
        TEXTURE_SHARE * noise.banding, least,
        measured, searched, found,
    )  # fmt: skip
    return find_peaks(image, blocks, noise, found, n, measured, room, peaks, count)
