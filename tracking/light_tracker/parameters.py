"""Parameters of the light tracker and of the hand-over between it and the detector. Times are frames."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LightParameters:
    """Each field with its unit and the reason for its default. All are ours; Zhou (2020) prints none."""

    check_every: int = 5  # frames between two checks by the detector
    smallest_px: float = 8.0  # px: diameters that the detector looks for; it knows no smaller ones
    largest_px: float | None = None  # px; None: the picture's smaller side
    acquire_confidence: float = 0.5  # of a detection that starts a track by itself
    elsewhere_confidence: float = 0.8  # of a detection that replaces a track elsewhere in the picture
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
    detection_sigma: float = 0.015  # of a detected centre, per axis, in diameters
    detection_size_sigma: float = 0.15  # of the logarithm of a detected diameter
    offset_drift: float = 0.006  # per frame, in diameters: motion of the rim's centre in the pattern
    search_after: int = 3  # frames without a measurement after which the detector searches the whole picture
    most_predicted: int = 50  # frames without a measurement after which the drogue is lost
    most_unseen: int = 100  # frames without a detection after which a drogue that is not measured is lost, too
    lost_sigma_diameters: float = 1.0  # 1 sigma of the centre above which the status is lost
    most_unconfirmed: int = 6  # checks in a row without a detection, after each of which the whole picture is searched

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
