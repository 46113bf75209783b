"""The parameters of the tracker of one target and of the detector of blobs, with the reasons for their defaults."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class PointParameters:
    """Tracking of one target. Units: px and frames, as in the paper (time step 1)."""

    sigma_a_px: float = 1.0  # px/frame^2: 1-sigma white acceleration; the initial value if estimated
    learn_sigma_a: bool = True  # estimate it from the innovations
    sigma_model_px: float = 0.1  # px: added to every detection's own sigma, for a target that changes its shape
    p_gate: float = 1e-4  # probability that the target's own detection lies outside the gate
    max_speed_px: float = 60.0  # px/frame: largest first vector of an acquisition
    confirm: int = 3  # consecutive detections that agree with one motion before a track starts; the paper: 2
    most_candidates: int = 12  # detections per picture from which tracks may start; the brightest
    max_size_ratio: float = 4.0  # a track that was lost is found again only with a brightness within this ratio
    max_predicted: int = 50  # frames without a detection after which the track is lost ...
    lost_sigma_px: float = 40.0  # px: ... or as soon as the position's sigma exceeds this
    start_px: tuple[float, float] | None = None  # u, v: the target that is nearest to this place at the start
    start_within_px: float = 50.0  # px: largest distance from it

    def __post_init__(self) -> None:
        for name in ("sigma_a_px", "max_speed_px", "lost_sigma_px", "start_within_px"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a number above 0, got {getattr(self, name)}")
        if not (self.sigma_model_px >= 0 and self.max_size_ratio > 1):
            raise ValueError("sigma_model_px: expected 0 or more; max_size_ratio: expected more than 1")
        if not 0 < self.p_gate < 1:
            raise ValueError(f"p_gate: expected a number between 0 and 1, got {self.p_gate}")
        if not (self.confirm >= 2 and self.most_candidates >= 1 and self.max_predicted >= 0):
            raise ValueError("confirm: expected 2 or more; most_candidates: 1 or more; max_predicted: 0 or more")


USUAL = PointParameters()


@dataclass(frozen=True, slots=True)
class BlobParameters:
    """Detection of a blob that is darker or brighter than its surroundings (blobs.py)."""

    polarity: Literal["darker", "brighter"] = "darker"
    background_px: int = 61  # px: side of the square whose mean is the background; larger than the target
    close_px: int = 5  # px: gaps up to this width join parts of a blob; 0: none
    threshold_sigma: float = 8.0  # least contrast in sigmas of the background's noise ...
    threshold_share: float = 0.3  # ... and as a share of the picture's largest contrast: shadows are fainter
    min_size_px: float = 3.0  # px: longest side of the blob's box; below it is noise
    max_size_px: float = 250.0  # px: above it is an edge of the scene
