"""The page of a tracked circle: verdict, key figures, position, radius and their sigmas over time, occlusion, path."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from calibration.findings import Finding, Level, verdict
from geometry.arrays import Array, Bools
from lab.drogue_circle.options import CircleOptions
from lab.drogue_circle.series import CircleSeries
from lab.drogue_circle.verdict import WORDS
from lab.files.text.atomic_write import atomic_write_text
from lab.number_format import format_number, format_percent
from lab.report.calibration.calibration_page import PageDrawing, PageTable, Section, section_context
from lab.report.html import environment
from lab.report.plot.axes import axes, frame, image_area, note, svg_of
from lab.report.plot.series import Band, Line, Shade, time_panel
from lab.report.plot.svg import BLUE, SKY, VERMILLION, dots, line_path
from lab.versions import versions
from tracking.drogue_circle.frames import Cause
from tracking.statuses import PoseStatus


class StatusSeries(Protocol):
    """Frames with a status."""

    def has_status(self, status: PoseStatus) -> Bools:
        """Which frames (n,) have a status."""


_SENTENCES = {
    Level.PASS: "The circle was followed.",
    Level.WARN: "The circle was followed; note the warnings below.",
    Level.FAIL: "The results must not be used as they are.",
}
_EVENTS = {
    "acquired": "found in the whole picture",
    "reacquired": "found again in the whole picture",
    "lost": "lost: the prediction is too uncertain",
    "ambiguous": "several circles fit equally well; none is chosen",
}
_MOST_EVENTS = 60  # rows of the table


def write_circle_page(series: CircleSeries, findings: Sequence[Finding], options: CircleOptions, folder: Path) -> Path:
    """Write report.html into a folder. Returns its path."""
    level = verdict(findings)
    sections = [_motion(series), _quality(series), _path(series), *_events(series)]
    context: dict[str, Any] = {
        "subject": "circle",
        "name": series.name,
        "source": series.source,
        "word": WORDS[level].upper(),
        "status": WORDS[level],
        "sentence": _SENTENCES[level],
        "findings": [
            {"status": WORDS[f.level], "what": f.what, "why": f.why, "remedy": f.remedy, "code": f.code}
            for f in findings
        ],
        "key_figures": _key_figures(series),
        "notes": series.notes,
        "sections": [section_context(section) for section in sections],
        "made": _made(options),
    }
    path = folder / "report.html"
    atomic_write_text(environment().get_template("circle.html.j2").render(context), path)
    return path


def _key_figures(series: CircleSeries) -> list[tuple[str, str, str]]:
    counts = series.statuses()
    figures = [
        ("Measured", format_percent(counts["measured"] / len(series.frames)), f"{counts['measured']} of"
         f" {len(series.frames)} frames; {counts['predicted']} predicted, {counts['lost']} lost"),
    ]  # fmt: skip
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


def _path(series: CircleSeries) -> Section:
    assert series.size_px is not None  # there is a usable picture
    return path_section(series.size_px, series.states[:, :2], series.has_status(PoseStatus.PREDICTED))


def path_section(size_px: tuple[int, int], uv_px: Array, predicted: Bools) -> Section:
    """The path (n, 2) of a centre in the picture, with the predicted frames (n,) as dots."""
    p = image_area(size_px)
    out = axes(p, "Path of the centre", "u (px)", "v (px)", grid=False)
    at = p.at(uv_px)
    out.append(f'<path d="{line_path(at[:, 0], at[:, 1])}" fill="none" stroke="{BLUE}" stroke-width="1.1"/>')
    if predicted.any():
        out.append(f'<path d="{dots(p.at(uv_px[predicted]), 1.8)}" fill="{VERMILLION}"/>')
    out.append(note(p, "line: all frames; dots: predicted ones"))
    return Section("Path", (), [PageDrawing(svg_of(p, "Path of the centre", [*out, frame(p)]))])


def _events(series: CircleSeries) -> list[Section]:
    sections = []
    events = series.events()
    if events:
        rows = [[e["frame"], _EVENTS.get(str(e["kind"]), str(e["kind"])), e["circles"] or None] for e in events]
        more = f"The first {_MOST_EVENTS} of {len(rows)}." if len(rows) > _MOST_EVENTS else ()
        table = PageTable(("frame", "event", "circles in the picture"), rows[:_MOST_EVENTS])
        sections.append(Section("Events", more, (), table))
    causes = series.causes()
    if causes:
        table = PageTable(("cause", "frames", "meaning"), [[c, n, Cause(c).meaning] for c, n in causes.items()])
        sections.append(Section("Frames without a measurement", (), (), table))
    return sections


def status_shades(series: StatusSeries) -> tuple[Shade, ...]:
    """Shades of the frames that are not measured."""
    return tuple(
        Shade(series.has_status(status), status.value, status.value)
        for status in (PoseStatus.PREDICTED, PoseStatus.LOST)
        if series.has_status(status).any()
    )


def _made(options: CircleOptions) -> list[tuple[str, str]]:
    own = versions()
    form = "corrected equations, rim fit" if options.form == "sound" else "equations as printed, whole pixels"
    return [
        ("method", f"Zhou et al. (2014): {form}; detector {options.detector}"),
        ("beampose", f"{own['beampose']}, numpy {own['numpy']}, OpenCV {own['opencv-python-headless']}"),
    ]
