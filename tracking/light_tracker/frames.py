"""Parameters, frames and confidence of the light tracker."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array
from tracking.statuses import Cause, PoseStatus, Word

# Parameters of the light tracker and of the hand-over between it and the detector. Times are frames.


@dataclass(frozen=True, slots=True)
class LightParameters:
    """Each field with its unit and the reason for its default. All are ours; Zhou (2020) prints none."""

    check_every: int = 5  # frames between two checks by the detector
    smallest_px: float = 8.0  # px: diameters that the detector looks for; it knows no smaller ones
    largest_px: float | None = None  # px; None: the picture's smaller side
    acquire_confidence: float = 0.5  # of a detection that starts a track by itself
    elsewhere_confidence: float = 0.8  # of a detection that replaces a track elsewhere in the picture
    sure_logit: float = 1.5  # of a detection that competes with a track: its log odds over those of the track's checks
    picture_every: int = 2  # checks, of which the last one is of the whole picture
    confirm_confidence: float = 0.15  # of a detection where the tracker is: two independent ones agree
    ambiguous_logit: float = 2.5  # a second detection whose log odds are less than this below the best: ambiguous
    measured_confidence: float = 0.5  # with less, the frame is predicted
    hand_back_confidence: float = 0.9  # with less, the detector is asked at once
    window_diameters: float = 1.0  # largest distance of a checking detection, in diameters, beyond 3 sigma
    agree_diameters: float = 0.3  # a detection nearer to the tracked centre confirms it
    size_ratio: float = 1.7  # largest ratio of the diameters of a detection and of the tracked drogue
    least_correlation: float = 0.5  # with less there is no match
    update_rate: float = 0.08  # of the pattern per frame: it follows tilt and light
    update_correlation: float = 0.8  # least correlation of a frame that updates the pattern
    sigma_a_diameters: float = 0.03  # diameters/frame^2: 1-sigma acceleration ...
    sigma_a_px: float = 0.3  # ... and this much in px: motion of the camera
    sigma_growth: float = 0.02  # 1 sigma of the relative change of the diameter per frame
    detection_sigma: float = 0.007  # of a detected centre, per axis, in diameters ...
    detection_sigma_px: float = 0.1  # ... and this much in px: .7 % at 100 px, 1.3 % at 9 px
    detection_size_sigma: float = 0.1  # of the logarithm of a detected diameter
    offset_drift: float = 0.004  # per frame, in diameters: motion of the rim's centre in the pattern
    search_after: int = 3  # frames without a measurement after which the detector searches the whole picture
    most_predicted: int = 50  # frames without a measurement after which the drogue is lost
    most_unseen: int = 100  # frames without a detection after which a drogue that is not measured is lost, too
    lost_sigma_diameters: float = 1.0  # 1 sigma of the centre above which the status is lost
    most_unconfirmed: int = 2  # checks in a row without a detection, after each of which the whole picture is searched

    def __post_init__(self) -> None:
        if self.check_every < 1:
            raise ValueError(f"check_every: expected 1 or more, got {self.check_every}")
        if not self.smallest_px >= 8:
            raise ValueError(f"smallest_px: expected 8 px or more, got {self.smallest_px:g}")
        if self.largest_px is not None and not self.largest_px > self.smallest_px:
            raise ValueError(
                f"largest_px: expected more than smallest_px ({self.smallest_px:g}), got {self.largest_px:g}"
            )


USUAL = LightParameters()


# The drogue in one frame: status, cause, place, size, confidence and who measured it.


class MeasuredBy(Word):
    """What measured the drogue."""

    NONE = "", "nothing"
    DETECTOR = "detector", "the detector alone: an acquisition"
    LIGHT = "light", "the light tracker"
    BOTH = "both", "the light tracker, and the detector confirms it"


@dataclass(frozen=True, slots=True)
class DrogueFrame:
    """The drogue in one frame. Numbers that are not known are nan."""

    status: PoseStatus
    cause: Cause
    source: MeasuredBy
    centre_px: Array  # (2,) of the rim's image
    rate_px: Array  # (2,) px/frame
    diameter_px: float
    covariance: Array  # (2, 2) of the centre, px^2
    sigma_diameter_px: float
    confidence: float  # probability that the centre is within a quarter of the diameter of the drogue's
    correlation: float  # of the match; nan without one
    searched: str = ""  # what the detector searched in this frame: window, picture, or both
    found: int = 0  # drogues that it found
    event: str = ""  # acquired, reacquired, lost, ambiguous

    @property
    def place(self) -> Array:
        """u, v, diameter (3,), px."""
        return np.array([*self.centre_px, self.diameter_px])

    @property
    def sigmas(self) -> Array:
        """Standard deviations (3,) of `place`."""
        return np.array([*np.sqrt(np.diag(self.covariance)), self.sigma_diameter_px])


def nothing_known(cause: Cause, event: str = "", searched: str = "", found: int = 0) -> DrogueFrame:
    """A lost frame."""
    nan = float("nan")
    return DrogueFrame(
        PoseStatus.LOST, cause, MeasuredBy.NONE, np.full(2, nan), np.full(2, nan), nan, np.full((2, 2), nan), nan, 0.0,
        nan, searched, found, event,
    )  # fmt: skip


# The probability that the tracked place is right, from the checks by the detector.
#
# A logistic curve whose coefficients were fitted on rendered sequences with `python -m
# bench.related_measurements.light_tracker --calibrate` (maximum likelihood; Platt 1999). "Right" is a centre within
# RIGHT_SHARE of the diameter of the drogue's. The correlation of the match, its lead over the next best place and the
# time since the last check were inputs too; their coefficients were zero, since a match with a low correlation is
# none.


RIGHT_SHARE = 0.25  # of the diameter
# Of 1, support, confirmed, size, size times support, gap: more of a good sign never lowers the confidence.
COEFFICIENTS = (1.3, 1.5, 0.42, -5.57, 0.17, -0.66)
ABSENT_LOGIT = -2.0  # of a check without a detection, in the running mean of the checks
_CAP = 0.995  # of correlations: above it, noise decides
_MOST_CONFIRMED = 10  # checks in a row that count: further ones say nothing new
# The detector is sure of a drogue of many pixels, but not of one of few: what is larger, and doubtful in check after
# check, is another object. From 16 px on the size says no more (minus log likelihood 2200; 14, 20 px: 2278, 2260).
_SIZES_PX = 9.0, 16.0


def fisher(correlation: float) -> float:
    """Fisher's transformation: its scatter does not depend on the correlation."""
    return float(np.arctanh(np.clip(correlation, 0.0, _CAP)))


def features(support: float, confirmed: int, diameter_px: float, gap: int = 0) -> Array:
    """The inputs (6,) of the curve.

    support: running mean of the log odds of the checks. confirmed: detections of this track. gap: frames without a
    match since the last one.
    """
    size = np.log(np.clip(diameter_px, *_SIZES_PX) / _SIZES_PX[0])
    known = np.log(min(max(confirmed, 1), _MOST_CONFIRMED))
    return np.array([1.0, support, known, size, size * support, np.log1p(gap)])


def probability(inputs: Array) -> float:
    """The probability that a match is right. A match says that the object is the one detected, not what it is: what was
    detected once is never surer than that detection.
    """
    log_odds = float(np.dot(COEFFICIENTS, inputs))
    return float(1 / (1 + np.exp(-(min(log_odds, inputs[1]) if inputs[2] == 0 else log_odds))))


def against(p: float, other: float) -> float:
    """The probability of a drogue where another one has these log odds: one of the two is it, or none."""
    return float(p / (p + (1 - p) * (1 + np.exp(other))))


def within(sigma_px: float, diameter_px: float) -> float:
    """The probability that a predicted centre is right: that of a normal distribution, the same in both axes."""
    return float(1 - np.exp(-0.5 * (RIGHT_SHARE * diameter_px / max(sigma_px, 1e-9)) ** 2))


def logit(p: float) -> float:
    """Log odds of a probability."""
    q = float(np.clip(p, 1e-3, 1 - 1e-3))
    return float(np.log(q / (1 - q)))
