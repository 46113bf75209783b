"""The page of a tracked drogue: verdict, key figures, position and diameter over time, confidence, path, events."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.findings import Finding
from geometry.arrays import Array
from lab.light_tracker.options import DrogueOptions
from lab.light_tracker.series import DrogueSeries
from lab.number_format import format_number, format_percent
from lab.report.calibration.calibration_page import PageDrawing, PageTable, Section
from lab.report.plot.series import Band, Line, time_panel
from lab.report.plot.svg import BLUE, SKY, VERMILLION
from lab.target.page import Words, path_section, status_shades, write_target_page
from tracking.light_tracker.frames import Cause, Source
from tracking.statuses import PoseStatus

_WORDS = Words("drogue", "drogues", "several drogues; none is chosen", lambda cause: Cause(cause).meaning)


def write_drogue_page(series: DrogueSeries, findings: Sequence[Finding], options: DrogueOptions, folder: Path) -> Path:
    """Write report.html into a folder. Returns its path."""
    path = path_section(series.size_px, series.circles[:, :2], series.has_status(PoseStatus.PREDICTED))
    sections = [_motion(series), _confidence(series), path, _sources(series)]
    method = f"learned detector, checks every {options.check_every} frames; light tracker between them"
    return write_target_page(series, findings, _WORDS, _key_figures(series), sections, method, folder)


def _key_figures(series: DrogueSeries) -> list[tuple[str, str, str]]:
    measured = series.has_status(PoseStatus.MEASURED)
    if not measured.any():
        return []
    sigma = np.median(series.sigmas[measured], axis=0)
    diameter, confidence = series.circles[measured, 2], series.confidences[measured]
    checks, confirmed = series.checks()
    figures = [
        ("Centre", f"± {format_number(float(np.hypot(*sigma[:2])), 2)} px", "median sigma, both axes together"),
        (
            "Diameter",
            f"{format_number(float(np.median(diameter)))} px",
            f"{diameter.min():.1f} to {diameter.max():.1f} px",
        ),
        ("Confidence", f"{confidence.mean():.2f}", f"mean of the measured frames; smallest {confidence.min():.2f}"),
    ]
    if checks:
        figures.append(("Checks", format_percent(confirmed / checks), f"confirmed by the detector; {checks} checks"))
    return figures


def _motion(series: DrogueSeries) -> Section:
    names = ("u of the centre", "v of the centre", "diameter")
    panels = [
        time_panel(
            series.t_s, name, "px", lines=(Line(series.circles[:, i], BLUE, name),),
            bands=(Band.about(series.circles[:, i], series.sigmas[:, i], 3.0, SKY, "3 sigma", 0.5),),
            shades=status_shades(series), width=1100, height=150, time_name="s",
        )
        for i, name in enumerate(names)
    ]  # fmt: skip
    words = (
        "Centre and diameter of the rim's image, with a band of 3 sigma. Shaded: frames without a measurement"
        " (predicted), and frames in which nothing is known (lost)."
    )
    return Section("Position and diameter", words, [PageDrawing(p, wide=True) for p in panels])


def _confidence(series: DrogueSeries) -> Section:
    confidence: Array = np.where(series.has_status(PoseStatus.LOST), np.nan, series.confidences)
    panel = time_panel(
        series.t_s, "Confidence (blue) and correlation of the match (orange)", "", shades=status_shades(series),
        lines=(Line(confidence, BLUE, "confidence"), Line(series.correlations, VERMILLION, "correlation")),
        y_range=(0.0, 1.05), width=1100, height=170, time_name="s",
    )  # fmt: skip
    words = (
        "The confidence is the probability that the centre is right to a quarter of the diameter. It comes from the"
        " detector's checks of the drogue and was fitted on rendered drogues. Of a predicted frame it falls with the"
        " growing sigma."
    )
    return Section("Confidence", words, [PageDrawing(panel, wide=True)])


def _sources(series: DrogueSeries) -> Section:
    rows = [[Source(name).meaning, count] for name, count in series.sources().items()]
    return Section("What measured the drogue", (), (), PageTable(("measured by", "frames"), rows))
