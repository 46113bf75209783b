"""Masks over the frames of a run by what the frames next to them show."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Bools, Ints
from tracking.rigid_body.hypotheses.prediction_checks import MIN_CONFIRMING_SPOTS


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


def isolated(count: Ints) -> Bools:
    """(T,): frames with one or two spots next to a frame without any, that the other neighbour does not support.

    count (T,): labelled spots per frame. The other neighbour supports them unless it has none either, or many more.
    Such labels are rather false points than the last or first visible spots: all of some ten that were measured in
    recordings with blackouts were wrong.
    """
    before, after = np.concatenate([[-1], count[:-1]]), np.concatenate([count[1:], [-1]])
    supported = ((before > 0) & (before < count + 2)) | ((after > 0) & (after < count + 2))
    return (count > 0) & (count < MIN_CONFIRMING_SPOTS) & ((before == 0) | (after == 0)) & ~supported
