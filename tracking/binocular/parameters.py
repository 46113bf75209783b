"""Parameters of the binocular measurement, with the reason for each default."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True, slots=True)
class SegmentationParameters:
    """From a picture to marker candidates: Zhou (2020), section 2.

    Raises:
        ValueError: a value is out of its range.
    """

    gamma: float = 0.8  # of the left picture; the paper's value, below 1: brightens low levels
    specify_histogram: bool = True  # right picture to the histogram of the left one
    median_px: int = 0  # side of the median filter of the mask, odd; 0 or 1: none; removes markers of 3 px
    opening_px: int = 0  # side of the opening, removes specks; 0 or 1: none; removes markers of 3 px
    closing_px: int = 0  # side of the closing, fills holes; 0 or 1: none
    min_area_px2: float = 1.0  # smaller regions are noise
    max_area_px2: float = 40000.0  # larger regions are background
    centroid: Literal["coverage", "contour"] = "coverage"  # contour: the paper's
    sigma_floor_px: float = 0.005  # smallest sigma of a centroid: shading and texture of a real marker
    max_markers: int = 40  # per picture, the largest regions first

    def __post_init__(self) -> None:
        if not 0 < self.gamma <= 5:
            raise ValueError(f"gamma: expected a number above 0 and up to 5, got {self.gamma:g}")
        for name in ("median_px", "opening_px", "closing_px"):
            value = getattr(self, name)
            if not 0 <= value <= 51 or (name == "median_px" and value > 1 and value % 2 == 0):
                odd = " and odd" if name == "median_px" else ""
                raise ValueError(f"{name}: expected 0 to 51{odd}, got {value}")
        if not 0 <= self.min_area_px2 < self.max_area_px2:
            raise ValueError("min_area_px2: expected 0 or more and less than max_area_px2")
        if not 0 < self.sigma_floor_px <= 10:
            raise ValueError(f"sigma_floor_px: expected above 0 and up to 10, got {self.sigma_floor_px:g}")
        if not 3 <= self.max_markers <= 200:
            raise ValueError(f"max_markers: expected 3 to 200, got {self.max_markers}")


@dataclass(frozen=True, slots=True)
class MatchParameters:
    """From candidates in two pictures to labelled markers and a pose. Source: ours.

    Raises:
        ValueError: a value is out of its range.
    """

    epipolar_sigmas: float = 5.0  # largest epipolar distance of two images of one marker
    epipolar_floor_px: float = 1.0  # added to it: calibration error and motion between the two exposures
    gate_sigmas: float = 4.5  # largest distance of a candidate from the predicted place of its marker
    area_factor: float = 4.0  # largest ratio of a candidate's area and the predicted one
    outlier_chi2: float = 18.4  # of one image's residual, 2 degrees of freedom: one good image in 10,000 is above
    detection_probability: float = 0.9  # of a marker in view
    lead_nats: float = 7.0  # of the best pose over every other one, and over "all candidates are false": 1 in 1,000
    min_markers: int = 3  # different markers in a measured pose
    max_pose_chi2_p: float = 1e-6  # a pose with a less probable misfit is not measured
    acceleration_m_s2: float = 3.0  # of the target, 1 sigma: predictions for matching
    turn_rad_s2: float = 3.0
    max_predicted_frames: int = 25  # frames without a measurement after which the target is lost

    def __post_init__(self) -> None:
        for name in ("epipolar_sigmas", "gate_sigmas", "outlier_chi2", "acceleration_m_s2", "turn_rad_s2"):
            if not 0 < getattr(self, name) < 1e6:
                raise ValueError(f"{name}: expected a number above 0, got {getattr(self, name):g}")
        if not 0 <= self.epipolar_floor_px <= 100:
            raise ValueError(f"epipolar_floor_px: expected 0 to 100, got {self.epipolar_floor_px:g}")
        if not 1 < self.area_factor <= 100:
            raise ValueError(f"area_factor: expected above 1 and up to 100, got {self.area_factor:g}")
        if not 0.5 <= self.detection_probability < 1:
            raise ValueError(f"detection_probability: expected 0.5 to 1, got {self.detection_probability:g}")
        if not 3 <= self.min_markers <= 100:
            raise ValueError(f"min_markers: expected 3 to 100, got {self.min_markers}")
        if not (0 <= self.lead_nats <= 100 and 0 <= self.max_pose_chi2_p < 1):
            raise ValueError("lead_nats: expected 0 to 100; max_pose_chi2_p: expected 0 to 1")
        if not 0 <= self.max_predicted_frames <= 100000:
            raise ValueError(f"max_predicted_frames: expected 0 to 100000, got {self.max_predicted_frames}")


@dataclass(frozen=True, slots=True)
class BinocularParameters:
    """All parameters of the binocular measurement."""

    segmentation: SegmentationParameters = field(default_factory=SegmentationParameters)
    match: MatchParameters = field(default_factory=MatchParameters)
