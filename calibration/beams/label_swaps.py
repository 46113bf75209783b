"""Spots whose labels were exchanged in single pictures: each lies where the other should be."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from calibration.terms.spot_term import SpotPixels
from geometry.arrays import Array, Bools, Ints

_OF_THEIR_DISTANCE = 0.15  # nearer to the other's place than so much of the way between them is there
_SIGMAS = 10.0  # or nearer than so many sigmas, where the two are close together


def exchanged_pairs(spots: SpotPixels, kept: Bools, residuals_px: Array, camera_of: Ints) -> list[tuple[int, int]]:
    """Pairs of rows that were left out and fit with each other's label.

    kept (N,): those that took part; residuals_px (N, 2): found minus predicted; camera_of (N,). Only the spots of one
    position and camera can be exchanged.
    """
    predicted = spots.pixels - residuals_px
    wrong = np.flatnonzero(~kept)
    out = []
    for i, j in combinations(wrong.tolist(), 2):
        if spots.position[i] != spots.position[j] or camera_of[i] != camera_of[j]:
            continue
        sigma = float(np.sqrt(max(np.trace(spots.covariance[i]), np.trace(spots.covariance[j])) / 2))
        near = max(_OF_THEIR_DISTANCE * float(np.linalg.norm(spots.pixels[i] - spots.pixels[j])), _SIGMAS * sigma)
        away = [np.linalg.norm(spots.pixels[a] - predicted[b]) for a, b in ((i, j), (j, i))]
        if max(away) < near:
            out.append((i, j))
    return out
