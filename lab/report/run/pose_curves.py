"""Pose, velocity and angular rate over time: value on the left, uncertainty on the right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools
from geometry.pose import Pose
from lab.files.run.results import PoseTrack
from lab.report.plot.axes import BLUE, GREY, SKY, VERMILLION, padded_range, robust_range
from lab.report.plot.series import Band, Line, ZoomData, time_panel
from lab.report.run.figures import pose_shades
from lab.report.run.report_data import ReportData
from lab.runs.score.motion_score import differenced
from tracking.statuses import PoseStatus

_CAUSAL_WIDTH = 0.6


@dataclass(frozen=True, slots=True)
class _Curve:
    """One component of pose or motion over F frames."""

    name: str
    unit: str
    small_unit: str  # a thousandth of `unit`, used for uncertainties up to ...
    large: float  # ... this value, in `unit`
    value: Array  # (F,)
    sigma: Array  # (F,)
    error: Array | None  # (F,) estimate minus truth
    causal: Array | None  # (F,) error of the causal filter, or its difference to `value` where there is no truth


def pose_figure(m: ReportData, zoom: ZoomData | None = None) -> str:
    """Attitude and position over time beside their uncertainty; empty where no pose is known."""
    p = m.poses
    if not p.known.any():
        return ""
    true = None if m.truth is None else m.truth.world_from_body
    errors, causal = _minus(p, true), _causal(m, true)
    angles = np.degrees(np.unwrap(np.radians(p.yaw_pitch_roll_deg), axis=0)) if p.known.all() else p.yaw_pitch_roll_deg
    values = np.concatenate([angles, p.world_from_body.translation], axis=1)
    sigmas = np.concatenate([p.sigma_ypr_deg, p.sigma_position_m], axis=1)
    return _rows(
        m,
        zoom,
        [
            _Curve(
                name,
                *(("deg", "mdeg", 1.0) if i < 3 else ("m", "mm", 0.1)),
                values[:, i],
                sigmas[:, i],
                None if errors is None else errors[:, i],
                None if causal is None else causal[:, i],
            )
            for i, name in enumerate(("yaw", "pitch", "roll", "x", "y", "z"))
        ],
    )


def motion_figure(m: ReportData, zoom: ZoomData | None = None) -> str:
    """Velocity and angular rate beside their uncertainty; empty where neither is known.

    Truth: differences of the true poses.
    """
    values, sigmas = _motion(m.poses)
    if not np.isfinite(values).any():
        return ""
    errors = None
    if m.truth is not None and m.truth.world_from_body is not None:
        errors = values - differenced(m.truth.world_from_body, m.poses.t_s)[0]
    names = [f"{what} {axis}" for what in ("velocity", "rate") for axis in "xyz"]
    return _rows(
        m,
        zoom,
        [
            _Curve(
                name,
                *(("m/s", "mm/s", 1.0) if i < 3 else ("rad/s", "mrad/s", 1.0)),
                values[:, i],
                sigmas[:, i],
                None if errors is None else errors[:, i],
                None,  # ten times as uncertain: it would cover the other curves
            )
            for i, name in enumerate(names)
        ],
    )


def _motion(p: PoseTrack) -> tuple[Array, Array]:
    """Velocity (m/s) and rate (rad/s) side by side, (F, 6), and their sigmas."""
    both = [p.velocity_m_s, p.rate_rad_s], [p.sigma_velocity_m_s, p.sigma_rate_rad_s]
    return np.concatenate(both[0], axis=1), np.concatenate(both[1], axis=1)


def _causal(m: ReportData, true: Pose | None) -> Array | None:
    """(F, 6) as `_minus`: causal minus true poses (smoothed ones without truth); None without causal poses."""
    return None if m.causal is None else _minus(m.causal, m.poses.world_from_body if true is None else true)


def _minus(poses: PoseTrack, true: Pose | None) -> Array | None:
    """(F, 6): yaw, pitch, roll (deg, wrapped) and x, y, z (m), estimate minus truth; None without truth."""
    if true is None:
        return None
    ypr = poses.yaw_pitch_roll_deg - np.degrees(rotations.ypr_from_matrix(true.rotation))
    ypr = (ypr + 180.0) % 360.0 - 180.0
    shift = poses.world_from_body.translation - true.translation
    return np.concatenate([np.where(np.isfinite(shift[:, :1]), ypr, np.nan), shift], axis=1)


def _rows(m: ReportData, zoom: ZoomData | None, curves: list[_Curve]) -> str:
    measured = m.poses.has(PoseStatus.MEASURED)
    return "".join(_row(m, zoom, curve, measured, curve is curves[-1]) for curve in curves)


def _row(m: ReportData, zoom: ZoomData | None, c: _Curve, measured: Bools, last: bool) -> str:
    """Two panels: the value with its band, and the uncertainty with the known errors."""
    t, shades, height = m.pose_times, pose_shades(m), 128 if last else 104
    value = time_panel(
        t,
        c.name,
        c.unit,
        lines=(Line(c.value, BLUE, c.name, 1.3),),
        bands=(Band.about(c.value, c.sigma, 3.0, SKY, "\u00b13\u03c3", 0.45),),
        shades=shades,
        # Only the bands of measured poses set the range: that of a long prediction would flatten the rest.
        y_range=padded_range(
            np.concatenate([c.value, (c.value - 3 * c.sigma)[measured], (c.value + 3 * c.sigma)[measured]])
        ),
        height=height,
        with_time=last,
        time_name=m.time_name,
        zoom=zoom,
        row=0,
        fit=True,
    )
    shown = c.sigma[measured] if measured.any() else c.sigma
    unit, factor = (c.unit, 1.0) if np.nanmax(shown, initial=0.0) > c.large else (c.small_unit, 1000.0)
    limit = 1.25 * robust_range(3 * factor * shown)[1]
    lines: list[Line] = []
    reference = "truth" if c.error is not None else "smoothed"
    for errors, colour, width, name in (
        (c.causal, GREY, _CAUSAL_WIDTH, f"{c.name}: causal minus {reference}"),
        (c.error, VERMILLION, 0.9, f"{c.name}: estimate minus truth"),
    ):
        if errors is not None:
            lines.append(Line(factor * errors, colour, name, width))
            if np.isfinite(errors[measured]).any():
                limit = max(limit, robust_range(factor * errors[measured])[1])
    uncertainty = time_panel(
        t,
        f"{c.name}: \u00b1\u03c3, \u00b13\u03c3" + (" and error" if c.error is not None else ""),
        unit,
        lines=tuple(lines),
        bands=(
            Band.about(0.0, c.sigma, 3 * factor, SKY, "\u00b13\u03c3", 0.35),
            Band.about(0.0, c.sigma, factor, BLUE, "\u00b1\u03c3", 0.35),
        ),
        shades=shades,
        y_range=(-limit, limit),
        height=height,
        with_time=last,
        time_name=m.time_name,
        zoom=zoom,
        row=0,
    )
    return value + uncertainty
