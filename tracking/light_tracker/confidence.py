"""The probability that the tracked place is right, from the checks by the detector.

A logistic curve whose coefficients were fitted on rendered sequences with `python -m
bench.related_measurements.light_tracker --calibrate` (maximum likelihood; Platt 1999). "Right" is a centre within
RIGHT_SHARE of the diameter of the drogue's. The correlation of the match, its lead over the next best place and the
time since the last check were inputs too; their coefficients were zero, since a match with a low correlation is none.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array

RIGHT_SHARE = 0.25  # of the diameter
FEATURES = ("1", "support", "confirmed", "unconfirmed")
SIGNS = (0, 1, 1, -1)  # of the coefficients: more of a good sign never lowers the confidence
COEFFICIENTS = (-0.29, 0.83, 1.62, -1.3)
ABSENT_LOGIT = -2.0  # of a check without a detection, in the running mean of the checks
_CAP = 0.995  # of correlations: above it, noise decides
_MOST_CONFIRMED = 10


def fisher(correlation: float) -> float:
    """Fisher's transformation: its scatter does not depend on the correlation."""
    return float(np.arctanh(np.clip(correlation, 0.0, _CAP)))


def features(support: float, confirmed: int, unconfirmed: int) -> Array:
    """The inputs (4,) of the curve.

    support: running mean of the log odds of the checks. confirmed: detections of this track; unconfirmed: checks in a
    row without one.
    """
    return np.array([1.0, support, np.log(min(max(confirmed, 1), _MOST_CONFIRMED)), np.log1p(unconfirmed)])


def probability(inputs: Array) -> float:
    """The probability that a match is right."""
    return float(1 / (1 + np.exp(-float(np.dot(COEFFICIENTS, inputs)))))


def within(sigma_px: float, diameter_px: float) -> float:
    """The probability that a predicted centre is right: that of a normal distribution, the same in both axes."""
    return float(1 - np.exp(-0.5 * (RIGHT_SHARE * diameter_px / max(sigma_px, 1e-9)) ** 2))


def logit(p: float) -> float:
    """Log odds of a probability."""
    q = float(np.clip(p, 1e-3, 1 - 1e-3))
    return float(np.log(q / (1 - q)))
