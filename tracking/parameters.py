"""Every number that a user may want to change, with its unit, its meaning and the reason for its default."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class DetectParameters:
    """Finding and measuring points of light in one picture (tracking/detect.py, tracking/centroid.py)."""

    threshold_sigma: float = 6.0  # detection threshold over the local background, in sigmas of its noise
    max_detections: int = 400  # keep the brightest so many of one picture
    saturation_dn: float | None = None  # grey value at which the sensor clips; None: the largest of the picture's type
