"""Frames of a vehicle at rest: which belong together, and what their mean is worth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.terms.spot_term import SpotPixels
from geometry.arrays import Array, Ints
from geometry.pose import Pose

AT_REST = 1e-7  # m and rad, or half the record's sigma: poses that differ less are one position of the stand


@dataclass(frozen=True, slots=True)
class SpotRows:
    """n labelled spots of single frames."""

    frame: Ints  # (n,)
    view: Ints  # (n,) in the order of Rig.views()
    pixels: Array  # (n, 2)
    covariance: Array  # (n, 2, 2)


def positions_at_rest(stand_from_body: Pose, sigmas: Array) -> Ints:
    """Which position of the stand each of n frames belongs to (n,): a new one where the record moves.

    sigmas (n, 6) of each record. Frames of one position share the stand's error, so they are one measurement of it.
    """
    out = np.zeros(len(sigmas), dtype=np.int64)
    start = 0
    for k in range(1, len(out)):
        away = np.abs(stand_from_body[k].minus(stand_from_body[start]))
        moved = bool(np.any(away > np.maximum(AT_REST, 0.5 * sigmas[k])))
        out[k] = out[k - 1] + moved
        start = k if moved else start
    return out


def average(rows: SpotRows, position: Ints) -> SpotPixels:
    """One spot per position and view, of n rows at positions (n,), with a covariance that frames alone do not shrink.

    What scatters between frames averages out, less where neighbours go together. What a frame's own covariance claims
    beyond that scatter (speckle, pixel locking, blooming stand still with the vehicle) is common to all and stays.
    """
    keys, which = np.unique(np.stack([position, rows.view], axis=1), axis=0, return_inverse=True)
    pixels, covariance = np.empty((len(keys), 2)), np.empty((len(keys), 2, 2))
    for k in range(len(keys)):
        here = np.flatnonzero(which.ravel() == k)
        here = here[np.argsort(rows.frame[here], kind="stable")]
        pixels[k], covariance[k] = mean_of_frames(rows.pixels[here], rows.covariance[here])
    return SpotPixels(keys[:, 0], keys[:, 1], pixels, covariance)


def mean_of_frames(pixels: Array, covariance: Array) -> tuple[Array, Array]:
    """The mean (2,) of a spot at rest over n frames (n, 2) in their order, and its covariance (2, 2)."""
    n = len(pixels)
    claimed = covariance.mean(axis=0)
    if n < 3:
        return pixels.mean(axis=0), claimed
    # One wild frame (a passing hand) must not move the mean.
    middle = np.median(pixels, axis=0)
    away = np.linalg.norm(pixels - middle, axis=1)
    good = away <= max(5 * float(np.median(away)), 5 * float(np.sqrt(np.trace(claimed))))
    used = pixels[good]
    n = len(used)
    residual = used - used.mean(axis=0)
    scatter = residual.T @ residual / max(n - 1, 1)
    variance = float(np.trace(scatter))
    together = float(np.sum(residual[1:] * residual[:-1])) / max(float(np.sum(residual**2)), 1e-30)
    rho = float(np.clip(together + 1 / n, 0.0, 0.95))  # the mean's own noise makes the estimate low by 1 / n
    varying = scatter * (1 + rho) / (1 - rho) / n
    common = claimed * max(1.0 - variance / float(np.trace(claimed)), 0.0)
    return used.mean(axis=0), varying + common
