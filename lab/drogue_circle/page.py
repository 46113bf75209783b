"""The page of a tracked circle: verdict, key figures, position, radius and their sigmas over time, occlusion, path."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.findings import Finding
from lab.drogue_circle.options import CircleOptions
from lab.drogue_circle.series import CircleSeries
from lab.number_format import format_number, format_percent
from lab.report.calibration.calibration_page import PageDrawing, Section
from lab.report.plot.series import Band, Line, time_panel
from lab.report.plot.svg import BLUE, SKY, VERMILLION
from lab.target.page import Words, path_section, status_shades, write_target_page
from tracking.drogue_circle.frames import Cause
from tracking.statuses import PoseStatus

_WORDS = Words(
    "circle", "circles", "several circles fit equally well; none is chosen", lambda cause: Cause(cause).meaning
)


def write_circle_page(series: CircleSeries, findings: Sequence[Finding], options: CircleOptions, folder: Path) -> Path:
    """Write report.html into a folder. Returns its path."""
    path = path_section(series.size_px, series.states[:, :2], series.has_status(PoseStatus.PREDICTED))
    sections = [_motion(series), _quality(series), path]
    form = "corrected equations, rim fit" if options.form == "sound" else "equations as printed, whole pixels"
    method = f"Zhou et al. (2014): {form}; detector {options.detector}"
    return write_target_page(series, findings, _WORDS, _key_figures(series), sections, method, folder)


def _key_figures(series: CircleSeries) -> list[tuple[str, str, str]]:
    figures: list[tuple[str, str, str]] = []
    measured = series.has_status(PoseStatus.MEASURED)
    if measured.any():
        sigma = np.median(series.sigmas[measured], axis=0)
        radius = series.states[measured, 2]
        quality = series.quality()[measured]
        figures += [
            ("Centre", f"± {format_number(float(np.hypot(*sigma[:2])), 2)} px", "median sigma, both axes together"),
            ("Radius", f"{format_number(float(np.median(radius)))} px", f"{radius.min():.1f} to {radius.max():.1f} px"),
            ("Occlusion", format_percent(float(np.nanmax(quality[:, 0]))), "largest of a measured frame"),
        ]
        if np.isfinite(quality[:, 2]).any():
            rms = float(np.nanmedian(quality[:, 2]))
            figures.append(("Rim", f"{format_number(rms, 2)} px", "residuals of its edge points, RMS, median"))
    return figures


def _motion(series: CircleSeries) -> Section:
    t, x, sigma = series.t_s, series.states, series.sigmas
    panels = []
    for i, (title, colour) in enumerate((("u of the centre", BLUE), ("v of the centre", BLUE), ("radius", BLUE))):
        panels.append(
            time_panel(
                t, title, "px", lines=(Line(x[:, i], colour, title),),
                bands=(Band.about(x[:, i], sigma[:, i], 3.0, SKY, "3 sigma", 0.5),),
                shades=status_shades(series), width=1100, height=150, time_name="s",
            )
        )  # fmt: skip
    words = (
        "State of the filter after each frame, with a band of 3 sigma. Shaded: frames without a measurement"
        " (predicted), and frames in which nothing is known (lost)."
    )
    return Section("Position and radius", words, [PageDrawing(p, wide=True) for p in panels])


def _quality(series: CircleSeries) -> Section:
    t, quality = series.t_s, series.quality()
    shades = status_shades(series)
    away = series.fits - np.array([f.predicted for f in series.frames])
    top = float(np.nanmax(quality[:, 2])) if np.isfinite(quality[:, 2]).any() else 1.0
    panels = [
        time_panel(
            t, "Occlusion coefficient (blue) and share of the rim with edge points (orange)", "", shades=shades,
            lines=(Line(quality[:, 0], BLUE, "occlusion"), Line(quality[:, 1], VERMILLION, "coverage")),
            y_range=(0.0, 1.05), width=1100, height=140, time_name="s",
        ),
        time_panel(
            t, "Residuals of the rim, RMS", "px", shades=shades, lines=(Line(quality[:, 2], BLUE, "RMS"),),
            y_range=(0.0, max(1.1 * top, 0.1)), width=1100, height=120, time_name="s",
        ),
        time_panel(
            t, "Measured minus predicted centre: u (blue), v (orange)", "px", shades=shades,
            lines=(Line(away[:, 0], BLUE, "u"), Line(away[:, 1], VERMILLION, "v")),
            width=1100, height=140, time_name="s",
        ),
    ]  # fmt: skip
    words = (
        "The occlusion coefficient is the hidden share of the target's area. From 0.5 on, the circle is only predicted;"
        " below, the covariance of the fit grows by 1 / (1 - coefficient)²."
    )
    return Section("Measurements", words, [PageDrawing(p, wide=True) for p in panels])
