"""Figures of errors and residuals in a run report."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array
from lab.report.plot.axes import BLUE, GREEN, VERMILLION, histogram, robust_range
from lab.report.plot.series import Band, Line, Shade, ZoomData, time_panel
from lab.report.run.report_data import ReportData
from lab.runs.score.score import normalised_squares
from tracking.statuses import PoseStatus, SpotStatus

U_COLOUR, V_COLOUR = BLUE, VERMILLION
_RMS_HEIGHT = 180


def pose_shades(m: ReportData) -> tuple[Shade, ...]:
    """The frames with a predicted or lost pose."""
    return (
        Shade(m.poses.has(PoseStatus.PREDICTED), "predicted", "pose predicted, not measured"),
        Shade(m.poses.has(PoseStatus.LOST), "lost", "pose lost"),
    )


def nees_figure(m: ReportData, zoom: ZoomData | None = None) -> str:
    """The normalised estimation error squared over time; empty without truth."""
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
    # Chi-squared with 6 degrees of freedom lies in 1.237 .. 14.449 with a probability of 95 %.
    return time_panel(
        t,
        "NEES: squared pose error over its covariance; mean 6 if the stated uncertainty is correct, band: 95 %",
        "",
        lines=(Line(nees, BLUE, "NEES", 0.8), Line(6.0 * n, GREEN, "6, the expected mean", 1.4, "6 4")),
        bands=(Band(1.237 * n, 14.449 * n, GREEN, "95 % of the frames if the covariance is correct", 0.15),),
        shades=pose_shades(m),
        y_range=(0.0, top),
        width=1090,
        height=140,
        time_name=m.time_name,
        zoom=zoom,
        row=0,
    )


def view_shades(m: ReportData, j: int) -> tuple[Shade, ...]:
    """The frames in which the position of view j is not measured."""
    status = (SpotStatus.OUT_OF_VIEW, "outside"), (SpotStatus.OCCLUDED, "predicted"), (SpotStatus.NO_IMAGE, "lost")
    shades = [Shade(m.spots.has(s)[:, j], css, f"{s}: {s.meaning_for(m.summary.method)}") for s, css in status]
    return (*shades, Shade(m.spots.has(SpotStatus.LOST)[:, j], "lost", "lost"))


def error_grid(
    m: ReportData, columns: tuple[tuple[str, Array], ...], at_least_px: float = 0.5, zoom: ZoomData | None = None
) -> str:
    """A row of panels for each view: u and v of the named errors (F, V, 2), px, over time; one y scale per column."""
    out = []
    shown = [j for j in range(len(m.spots.views)) if any(np.isfinite(e[:, j]).any() for _, e in columns)]
    ranges = [robust_range(e[:, shown], at_least_px) if shown else (-1.0, 1.0) for _, e in columns]
    for j in shown:
        camera, spot = m.spots.views[j]
        last = j == shown[-1]
        for (name, errors), y_range in zip(columns, ranges, strict=True):
            out.append(
                time_panel(
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
                    zoom=zoom,
                    row=1 + j,
                )
            )
    return "".join(out)


def truth_columns(m: ReportData) -> tuple[tuple[str, Array], ...]:
    """Prediction error and tracking error (Huo 2015, Figs. 5 to 7, 9, 12 and 13)."""
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


def rms_figure(m: ReportData, zoom: ZoomData | None = None) -> str:
    """The residual RMS of the pose over time, and a histogram of the residuals."""
    p = m.poses
    if not np.isfinite(p.rms_px).any():
        return ""
    t = m.pose_times
    top = min(1.08 * float(np.nanmax(p.rms_px)), 4.0 * float(np.nanpercentile(p.rms_px, 99)))
    over_time = time_panel(
        t,
        "residual of the pose, RMS over the spots used",
        "px",
        lines=(Line(p.rms_px, BLUE, "rms_px of attitude.csv", 0.9),),
        shades=pose_shades(m),
        y_range=(0.0, max(top, 1e-6)),
        height=_RMS_HEIGHT,
        time_name=m.time_name,
        zoom=zoom,
        row=0,
    )
    if m.residual_px is None:
        limits = 0.0, max(float(np.nanpercentile(p.rms_px, 99.5)) * 1.2, 1e-9)
        return over_time + _counts(p.rms_px, limits, "residual of the pose, RMS", "RMS (px)", 0.0)
    sigma = float(np.sqrt(m.residual_share or 0.0))
    title = "residual over the stated \u03c3; curve: expected after the fit of the pose"
    return over_time + _counts(m.residual_px / m.spots.sigma_px, (-5.0, 5.0), title, "residual (\u03c3)", sigma)


def _counts(values: Array, limits: tuple[float, float], title: str, x_name: str, sigma: float) -> str:
    """A histogram with the number of values within and beyond its limits."""
    finite = values[np.isfinite(values)]
    beyond = int(((finite < limits[0]) | (finite > limits[1])).sum())
    words = f"{finite.size} values, {beyond} of them beyond the axis"
    return histogram(values, limits, title, x_name, sigma=sigma, footnote=words, bins=50, height=_RMS_HEIGHT)
