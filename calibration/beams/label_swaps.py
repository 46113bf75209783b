"""Detection of exchanged labels in single pictures: each of two spots is at the place of the other."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from calibration.terms.spot_term import SpotPixels
from geometry.arrays import Array, Bools, Ints

_OF_THEIR_DISTANCE = 0.15  # tolerance of the other's place, as a share of the distance between the two
_SIGMAS = 10.0  # the same in sigmas, if the two are close together


def swapped_pairs(spots: SpotPixels, kept: Bools, residuals_px: Array, camera_of: Ints) -> list[tuple[int, int]]:
    """Pairs of excluded rows that fit with exchanged labels.

    kept (N,): rows that are not excluded; residuals_px (N, 2): measured minus predicted; camera_of (N,). Only spots of
    the same position and camera can be exchanged.
    """
    predicted = spots.pixels - residuals_px
    wrong = np.flatnonzero(~kept)
    out = []
    for i, j in combinations(wrong.tolist(), 2):
        if spots.position[i] != spots.position[j] or camera_of[i] != camera_of[j]:
            continue
        sigma = float(np.sqrt(max(np.trace(spots.covariance[i]), np.trace(spots.covariance[j])) / 2))
        near = max(_OF_THEIR_DISTANCE * float(np.linalg.norm(spots.pixels[i] - spots.pixels[j])), _SIGMAS * sigma)
        distances = [np.linalg.norm(spots.pixels[a] - predicted[b]) for a, b in ((i, j), (j, i))]
        if max(distances) < near:
            out.append((i, j))
    return out
