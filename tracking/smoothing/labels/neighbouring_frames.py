"""Masks over the frames of a run by what the frames next to them show."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Bools, Ints
from tracking.rigid_body.hypotheses.hypothesis_set import MIN_CONFIRMING_SPOTS

# Of the frames at most AROUND away from a label: in so many at most the spot is seen, in so many at least missed.
AROUND, BRIEF_FRAMES, ABSENT_FRAMES = 3, 2, 4


def connected(measured: Bools, confirmed: Bools) -> Bools:
    """(T,): measured frames that are confirmed, or that an unbroken row of measured frames connects to one."""
    out = measured & confirmed
    for order in (range(1, len(out)), range(len(out) - 2, -1, -1)):
        for k in order:
            out[k] |= measured[k] and out[k - order.step]
    return out


def next_to(mask: Bools) -> Bools:
    """(T,): frames next to one of the mask."""
    out = np.zeros_like(mask)
    out[1:] |= mask[:-1]
    out[:-1] |= mask[1:]
    return out


def brief(labelled: Bools, missed: Bools) -> Bools:
    """(T, n): labels of a spot that is seen in at most BRIEF_FRAMES frames around, and missed in ABSENT_FRAMES or more.

    labelled, missed (T, n): the spot has a label; it should be in the picture and has none. An occluded spot seldom
    reappears for so short a time, and a false point at its place is not rare in a long occlusion.
    """
    seen, absent = (_count_around(mask) for mask in (labelled, missed))
    return labelled & (seen <= BRIEF_FRAMES) & (absent >= ABSENT_FRAMES)


def _count_around(mask: Bools) -> Ints:
    """(T, n): frames of a mask (T, n) at most AROUND frames away, the frame itself included."""
    total = np.concatenate([np.zeros((1, mask.shape[1]), dtype=np.int64), np.cumsum(mask, axis=0)])
    k = np.arange(len(mask))
    return total[np.minimum(k + AROUND + 1, len(mask))] - total[np.maximum(k - AROUND, 0)]


def isolated(count: Ints) -> Bools:
    """(T,): frames with one or two spots next to a frame without any, that the other neighbour does not support.

    count (T,): labelled spots per frame. The other neighbour supports them unless it has none either, or many more.
    Such labels are rather false points than the last or first visible spots: all of some ten that were measured in
    recordings with blackouts were wrong.
    """
    before, after = np.concatenate([[-1], count[:-1]]), np.concatenate([count[1:], [-1]])
    supported = ((before > 0) & (before < count + 2)) | ((after > 0) & (after < count + 2))
    return (count > 0) & (count < MIN_CONFIRMING_SPOTS) & ((before == 0) | (after == 0)) & ~supported
