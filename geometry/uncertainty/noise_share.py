"""Covariance of a smoother whose measurements have errors that do not change from frame to frame."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array

# Share of the measurements' noise in the variance of an optimal estimate of a motion with white jerk; the rest comes
# from the jerk. The variance grows as R^(5/6) q^(1/6) with the variances R of the noise and q of the jerk.
NOISE_OF_ESTIMATE = 5 / 6


def share_without_calibration(J: Array, noise: Array, calibration: Array) -> float:
    """Share of an estimate's covariance that is left without the calibration's errors, which its weights include.

    A smoother that weights m points with noise and calibration errors takes both for noise. The calibration's errors,
    which no averaging reduces, are stated separately, so that they would count twice. J (m, 2, 6): Jacobians of the
    points; noise, calibration (m, 2, 2), px^2: their covariances. 1 where the points do not determine the pose.
    Source: ours.
    """
    W = np.linalg.inv(noise + calibration)
    JW = np.swapaxes(J, 1, 2) @ W  # (m, 6, 2)
    H = np.sum(JW @ J, axis=0)
    if not np.linalg.cond(H) < 1 / np.finfo(float).eps:
        return 1.0
    own = float(np.trace(np.linalg.solve(H, np.sum(JW @ noise @ np.swapaxes(JW, 1, 2), axis=0)))) / 6
    return 1 - NOISE_OF_ESTIMATE * (1 - own)
