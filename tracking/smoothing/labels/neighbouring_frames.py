"""Masks over the frames of a run by what the frames next to them show."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Bools, Ints
from tracking.rigid_body.hypotheses.prediction_checks import MIN_CONFIRMING_SPOTS

BRIEF_FRAMES, ABSENT_FRAMES = 2, 2  # a spot is seen for so many frames at most, and missed for so many on both sides


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
    """(T, n): labels of a spot that is seen in at most BRIEF_FRAMES frames between two stretches of being missed.

    labelled, missed (T, n): the spot has a label; it should be in the picture and has none. An occluded spot seldom
    reappears for so short a time, and a false point at its place is not rare in a long occlusion.
    """
    out = np.zeros_like(labelled)
    for view in range(labelled.shape[1]):
        edges = np.diff(np.concatenate([[0], labelled[:, view].astype(np.int8), [0]]))
        for first, end in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
            before, after = missed[max(first - ABSENT_FRAMES, 0) : first, view], missed[end : end + ABSENT_FRAMES, view]
            if end - first <= BRIEF_FRAMES and min(before.sum(), after.sum()) == ABSENT_FRAMES:
                out[first:end, view] = True
    return out


def isolated(count: Ints) -> Bools:
    """(T,): frames with one or two spots next to a frame without any, that the other neighbour does not support.

    count (T,): labelled spots per frame. The other neighbour supports them unless it has none either, or many more.
    Such labels are rather false points than the last or first visible spots: all of some ten that were measured in
    recordings with blackouts were wrong.
    """
    before, after = np.concatenate([[-1], count[:-1]]), np.concatenate([count[1:], [-1]])
    supported = ((before > 0) & (before < count + 2)) | ((after > 0) & (after < count + 2))
    return (count > 0) & (count < MIN_CONFIRMING_SPOTS) & ((before == 0) | (after == 0)) & ~supported
