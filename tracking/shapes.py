"""How much the shape of a point of light says for a spot, against a false point.

Spots are round or nearly so, and a Gaussian explains them. Of the bright objects of a scene it explains few, so a
person distinguishes them at a glance. Of lamps and reflections it explains as many as of spots: how frequent such
points are, the other points of the same picture show.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array
from tracking.detections import Detections

# Share of its width by which developed speckle moves a centre, at least: 0.06 to 0.3. Texture moves it by up to 0.04,
# pixels by less, so above this narrow spots show it, too.
DEVELOPED_SPECKLE = 0.06
# Classes of points by the rms of what the Gaussian leaves, over its height: below the first limit, below the second,
# and all others, with those less round than this (ratio of the half axes). In front of photographs 70, 21 and 9 % of
# the spots and 1, 3 and 96 % of the objects are in these classes; speckle and structure in real light leave more.
_ROUND, _UNEXPLAINED = 0.5, (0.02, 0.04)
_OF_SPOTS = np.array([0.4, 0.15, 0.45])


def log_shape_ratio(found: Detections, spots: int) -> Array:
    """Log ratio (n,), nats, of the probabilities of each point's shape: if it is a spot, and if it is a false point.

    found (n,): points of one picture; spots: how many of them may be spots. 0 where the shapes are not known, or none
    is clear. The shares of the classes among false points have Jeffreys' prior, and are those of the points which are
    left if the ones in a class are spots, as far as these may be (a Dirichlet-multinomial model; source: ours). Where
    false points are as clear as spots, as lamps are, the shape says nothing.
    """
    if found.unexplained is None or not found.unexplained.all():
        return np.zeros(len(found))
    of = np.searchsorted(_UNEXPLAINED, found.unexplained, side="right")
    of[found.minor_px < _ROUND * found.major_px] = len(_UNEXPLAINED)
    counts = np.bincount(of, minlength=len(_OF_SPOTS))
    if not counts[:-1].any():
        return np.zeros(len(found))
    false, of_spots, left = np.zeros(len(counts)), np.ones(len(counts)), 1.0
    for k, count in enumerate(counts):
        taken = min(spots, count)
        more = np.arange(max(taken, 1))
        shares = (count - taken + more + 0.5) / (len(found) - taken + more + 0.5 * len(counts))
        false[k] = np.exp(np.mean(np.log(shares)))
    false /= false.sum()
    for k in range(len(counts)):  # at least as frequent as among the false points that are not clearer
        of_spots[k] = left * max(x[k] / x[k:].sum() for x in (_OF_SPOTS, false))
        left -= of_spots[k]
    return np.asarray(np.log(of_spots / false)[of])
