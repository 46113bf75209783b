"""The errors of a run against truth as a typed value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lab.report.run.summary import valid


@dataclass(frozen=True, slots=True)
class Spread:
    """The distribution of errors: in the picture (px) per axis and of the distance, or of another magnitude."""

    rms: float
    p99: float
    max: float
    rms_u: float | None = None
    rms_v: float | None = None
    rows: int | None = None


@dataclass(frozen=True, slots=True)
class Returns:
    """Spots that come into view again, and how many of them are found under their own name."""

    total: int = 0
    kept: int = 0
    max_delay_frames: int | None = None


@dataclass(frozen=True, slots=True)
class ViewErrors:
    """The errors of one spot in one camera."""

    camera: str
    spot: str
    identity: float | None = None
    wrong_labels: int | None = None
    out_of_view_error_px: Spread | None = None


@dataclass(frozen=True, slots=True)
class SpotErrors:
    """The errors of all spots. prediction_px: smooth, straight, turned, bends and start."""

    in_view_identity: float | None = None
    wrong_labels: int | None = None
    wrong_label_share: float | None = None
    prediction_px: dict[str, Spread | None] = field(default_factory=dict)
    measured_px: Spread | None = None
    out_of_view_px: Spread | None = None
    occluded_px: Spread | None = None
    re_entries: Returns = Returns()
    after_hiding: Returns = Returns()
    recognition_rate_eq15: dict[str, float | None] = field(default_factory=dict)
    per_spot: tuple[ViewErrors, ...] = ()


@dataclass(frozen=True, slots=True)
class PoseSpread:
    """The errors of poses: per axis and of the magnitude, and NEES with the 95 % interval of its mean."""

    rows: int
    position_rms_m: dict[str, float]
    position_m: Spread
    rotation_rms_deg: dict[str, float]
    rotation_deg: Spread
    nees_mean: float | None = None
    nees_mean_95: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """The errors of measured and of predicted poses."""

    measured: PoseSpread | None = None
    predicted: PoseSpread | None = None


@dataclass(frozen=True, slots=True)
class AxisSpread:
    """The errors of a velocity or rate: RMS per axis, and the largest magnitude."""

    rms_axes: dict[str, float]
    max: float


@dataclass(frozen=True, slots=True)
class MotionErrors:
    """The errors of velocity and rate against differences of the true poses."""

    velocity_m_s: AxisSpread | None = None
    rate_rad_s: AxisSpread | None = None
    rows_at_bends_left_out: int = 0


@dataclass(frozen=True, slots=True)
class TruthErrors:
    """The score of a run; None for what it lacks."""

    spots: SpotErrors | None = None
    pose: PoseErrors | None = None
    pose_causal: PoseErrors | None = None
    motion_vs_differences: MotionErrors | None = None
    motion_causal_vs_differences: MotionErrors | None = None


def errors_of(score: Mapping[str, Any] | None) -> TruthErrors | None:
    """The typed form of what `score_against` of lab/runs/score/score.py returns; None where there is no score."""
    return valid(TruthErrors, score)
