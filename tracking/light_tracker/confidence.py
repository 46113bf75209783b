"""The probability that the tracked place is right, from the match and the checks by the detector.

Logistic curves whose coefficients were fitted on rendered sequences with `python -m
bench.related_measurements.light_tracker --calibrate` (maximum likelihood; Platt 1999). "Right" is a centre within
RIGHT_SHARE of the diameter of the drogue's.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array

RIGHT_SHARE = 0.25  # of the diameter
FEATURES = ("1", "correlation", "drop", "lead", "support", "confirmed", "unconfirmed", "age", "misses")
SIGNS = (0, 1, -1, 1, 1, 1, -1, -1, -1)  # of the coefficients: more of a good sign never lowers the confidence
COEFFICIENTS = (-0.38, 0.0, 0.0, 0.0, 0.57, 1.3, -0.19, 0.0, 0.0)
ABSENT_LOGIT = -2.0  # of a check without a detection, in the running mean of the checks
_CAP = 0.995  # of correlations: above it, noise decides
_OLDEST = 30.0  # frames
_MOST_CONFIRMED = 10


def fisher(correlation: float) -> float:
    """Fisher's transformation: its scatter does not depend on the correlation."""
    return float(np.arctanh(np.clip(correlation, 0.0, _CAP)))


def features(
    correlation: float,
    usual: float,
    second: float,
    support: float,
    confirmed: int,
    unconfirmed: int,
    age: float,
    misses: int,
) -> Array:
    """The inputs (9,) of the curve.

    correlation: of the match; usual: `fisher` of the matches before, running mean; second: correlation of the next best
    place of the window. support: running mean of the log odds of the checks. confirmed: detections of this track;
    unconfirmed: checks in a row without one; age: frames since the last one.
    misses: frames without a measurement before this one.
    """
    best = fisher(correlation)
    return np.array(
        [1.0, best, max(usual - best, 0.0), max(best - fisher(second), 0.0), support,
         np.log(min(max(confirmed, 1), _MOST_CONFIRMED)), np.log1p(unconfirmed), np.log1p(min(age, _OLDEST)),
         np.log1p(misses)]
    )  # fmt: skip


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
