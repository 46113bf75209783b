"""Frames of a vehicle at rest: grouping by stand position, and mean with covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.terms.spot_term import SpotPixels
from geometry.arrays import Array, Ints
from geometry.pose import Pose

AT_REST = 1e-7  # m and rad: poses that differ by less than this, or by less than half their sigma, are one position


@dataclass(frozen=True, slots=True)
class SpotRows:
    """n labelled spots, each from one frame."""

    frame: Ints  # (n,)
    view: Ints  # (n,) in the order of Rig.views()
    pixels: Array  # (n, 2)
    covariance: Array  # (n, 2, 2)


def positions_at_rest(stand_from_body: Pose, sigmas: Array) -> Ints:
    """Index (n,) of the stand position of each of n frames; a new position starts where the recorded pose changes.

    sigmas: (n, 6), m and rad, of each recorded pose. Frames of one position share the stand's error and count as one
    measurement of the stand.
    """
    out = np.zeros(len(sigmas), dtype=np.int64)
    start = 0
    for k in range(1, len(out)):
        change = np.abs(stand_from_body[k].minus(stand_from_body[start]))
        moved = bool(np.any(change > np.maximum(AT_REST, 0.5 * sigmas[k])))
        out[k] = out[k - 1] + moved
        start = k if moved else start
    return out


def average(rows: SpotRows, position: Ints) -> SpotPixels:
    """Average the rows of each stand position and view.

    rows: n rows; position: (n,) index of the stand position of each row. Averaging reduces only the part of the noise
    that varies between frames, and less so where successive frames are correlated. The rest of the stated covariance
    (speckle, pixel locking, blooming, which are constant while the vehicle is at rest) remains.
    """
    keys, which = np.unique(np.stack([position, rows.view], axis=1), axis=0, return_inverse=True)
    pixels, covariance = np.empty((len(keys), 2)), np.empty((len(keys), 2, 2))
    for k in range(len(keys)):
        here = np.flatnonzero(which.ravel() == k)
        here = here[np.argsort(rows.frame[here], kind="stable")]
        pixels[k], covariance[k] = mean_of_frames(rows.pixels[here], rows.covariance[here])
    return SpotPixels(keys[:, 0], keys[:, 1], pixels, covariance)


def mean_of_frames(pixels: Array, covariance: Array) -> tuple[Array, Array]:
    """Mean (2,) of a spot at rest and its covariance (2, 2).

    pixels: (n, 2) in the order of the frames; covariance: (n, 2, 2), stated for each frame. Ours.
    """
    n = len(pixels)
    stated = covariance.mean(axis=0)
    if n < 3:
        return pixels.mean(axis=0), stated
    # Exclude single outliers, such as a hand in front of the camera.
    distance = np.linalg.norm(pixels - np.median(pixels, axis=0), axis=1)
    inlier = distance <= max(5 * float(np.median(distance)), 5 * float(np.sqrt(np.trace(stated))))
    used = pixels[inlier]
    n = len(used)
    residual = used - used.mean(axis=0)
    scatter = residual.T @ residual / max(n - 1, 1)
    variance = float(np.trace(scatter))
    lag_one = float(np.sum(residual[1:] * residual[:-1])) / max(float(np.sum(residual**2)), 1e-30)
    rho = float(np.clip(lag_one + 1 / n, 0.0, 0.95))  # subtracting the mean biases the autocorrelation by -1 / n
    varying = scatter * (1 + rho) / (1 - rho) / n
    common = stated * max(1.0 - variance / float(np.trace(stated)), 0.0)
    return used.mean(axis=0), varying + common
