"""The figures of a report, each from arrays to SVG text."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array
from lab.report.plot import svg
from lab.report.plot.svg import Band, Line, Shade
from lab.report.run.report_data import ReportData
from lab.runs.score.score import normalised_squares
from tracking.statuses import PoseStatus, SpotStatus

U_COLOUR, V_COLOUR = svg.BLUE, svg.VERMILLION


def pose_shades(m: ReportData) -> tuple[Shade, ...]:
    """Where the pose was predicted or lost."""
    return (
        Shade(m.poses.has(PoseStatus.PREDICTED), "predicted", "pose predicted, not measured"),
        Shade(m.poses.has(PoseStatus.LOST), "lost", "pose lost"),
    )


def nees_figure(m: ReportData) -> str:
    """The squared pose error in units of its covariance, over time."""
    delta = m.pose_errors
    if delta is None:
        return ""
    nees = normalised_squares(delta, m.poses.covariance)
    if not np.isfinite(nees).any():
        return ""
    t = m.pose_times
    n = np.ones(len(nees))
    usual = nees[np.isfinite(nees)]
    top = max(25.0, min(float(usual.max()) * 1.08, 2.0 * float(np.percentile(usual, 99))))
    # chi-squared with 6 degrees of freedom lies in 1.237 .. 14.449 in 95 of 100 frames
    return svg.time_panel(
        t,
        "NEES: squared pose error over its covariance; mean 6 where the stated uncertainty is true, band: 95 %",
        "",
        lines=(Line(nees, svg.BLUE, "NEES", 0.8), Line(6.0 * n, svg.GREEN, "6, the mean to expect", 1.4, "6 4")),
        bands=(Band(1.237 * n, 14.449 * n, svg.GREEN, "95 % of a true covariance's frames", 0.15),),
        shades=pose_shades(m),
        y_range=(0.0, top),
        width=1090,
        height=140,
        time_name=m.time_name,
    )


def view_shades(m: ReportData, j: int) -> tuple[Shade, ...]:
    """Where a view's position is not measured."""
    status = (SpotStatus.OUT_OF_VIEW, "outside"), (SpotStatus.OCCLUDED, "predicted"), (SpotStatus.NO_IMAGE, "lost")
    shades = [Shade(m.spots.has(s)[:, j], css, f"{s}: {s.meaning}") for s, css in status]
    return (*shades, Shade(m.spots.has(SpotStatus.LOST)[:, j], "lost", "lost"))


def error_grid(m: ReportData, columns: tuple[tuple[str, Array], ...], at_least_px: float = 0.5) -> str:
    """For each view a row of panels over time with u and v of the given errors (F, V, 2), px; one scale per column."""
    out = []
    shown = [j for j in range(len(m.spots.views)) if any(np.isfinite(e[:, j]).any() for _, e in columns)]
    ranges = [svg.robust_range(e[:, shown], at_least_px) if shown else (-1.0, 1.0) for _, e in columns]
    for j in shown:
        camera, spot = m.spots.views[j]
        last = j == shown[-1]
        for (name, errors), y_range in zip(columns, ranges, strict=True):
            out.append(
                svg.time_panel(
                    m.t_s,
                    f"spot {spot} ({camera}): {name}",
                    "px",
                    lines=(
                        Line(errors[:, j, 0], U_COLOUR, f"spot {spot}, u: {name}", 0.9),
                        Line(errors[:, j, 1], V_COLOUR, f"spot {spot}, v: {name}", 0.9),
                    ),
                    shades=view_shades(m, j),
                    y_range=y_range,
                    height=128 if last else 104,
                    with_time=last,
                    time_name=m.time_name,
                )
            )
    return "".join(out)


def truth_columns(m: ReportData) -> tuple[tuple[str, Array], ...]:
    """Prediction error and tracking error (the paper's Figs. 5 to 7, 9, 12 and 13)."""
    if m.truth is None or m.truth.uv_px is None:
        return ()
    return (
        ("predicted \u2212 true", m.spots.predicted_px - m.truth.uv_px),
        ("estimate \u2212 true", m.spots.uv_px - m.truth.uv_px),
    )


def residual_columns(m: ReportData) -> tuple[tuple[str, Array], ...]:
    """Innovation, and residual where the rig is known."""
    columns: tuple[tuple[str, Array], ...] = (("measured \u2212 predicted", m.innovation_px),)
    if m.residual_px is not None:
        columns += (("measured \u2212 from the pose", m.residual_px),)
    return columns


def rms_figure(m: ReportData) -> str:
    """The pose solution's residual over time, and how the residuals are spread."""
    p = m.poses
    if not np.isfinite(p.rms_px).any():
        return ""
    t = m.pose_times
    top = min(1.08 * float(np.nanmax(p.rms_px)), 4.0 * float(np.nanpercentile(p.rms_px, 99)))
    over_time = svg.time_panel(
        t,
        "residual of the pose, RMS over the spots used",
        "px",
        lines=(Line(p.rms_px, svg.BLUE, "rms_px of attitude.csv", 0.9),),
        shades=pose_shades(m),
        y_range=(0.0, max(top, 1e-6)),
        height=150,
        time_name=m.time_name,
    )
    if m.residual_px is not None:
        return over_time + svg.histogram(
            (m.residual_px / m.spots.sigma_px).ravel(),
            "residual over its stated \u03c3; curve: what the pose leaves of it",
            "\u03c3",
            curve=float(np.sqrt(m.residual_share or 0.0)),
        )
    return over_time + svg.histogram(p.rms_px, "residual of the pose, RMS", "px")
