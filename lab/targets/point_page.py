"""report.html of `beampose track point`: verdict, path, position and velocity over time, innovations, events."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from geometry.arrays import Array
from lab.files.text.atomic_write import atomic_write_text
from lab.number_format import format_number, format_percent
from lab.report.calibration.calibration_page import PageDrawing, PageTable, Section, section_context
from lab.report.html import environment
from lab.report.plot.axes import (
    BLUE,
    GREEN,
    ORANGE,
    VERMILLION,
    axes,
    dots,
    frame,
    histogram,
    image_area,
    line_path,
    note,
    padded_range,
    plot_area,
    svg_of,
)
from lab.report.plot.series import Band, Line, Shade, time_panel
from lab.targets.point_recording import TABLE, PointRecording
from lab.targets.point_results import PointOutcome
from lab.versions import versions
from tracking.single_target.parameters import TargetStatus
from tracking.single_target.point_tracker import PointEstimate

_MOST_DOTS = 6000
_SENTENCES = {
    "PASS": "The target is tracked.",
    "CHECK": "The target is tracked; check the following.",
    "FAIL": "This track must not be used.",
}


def write_point_page(outcome: PointOutcome, folder: Path) -> Path:
    """Write report.html into a folder. Returns its path."""
    recording, track = outcome.recording, outcome.track
    context: dict[str, Any] = {
        "name": recording.name,
        "source": str(recording.path),
        "verdict": {"word": outcome.verdict, "sentence": _SENTENCES[outcome.verdict]},
        "reasons": outcome.reasons,
        "key_figures": _key_figures(outcome),
        "notes": recording.notes,
        "sections": [
            section_context(s)
            for s in (_path(recording, track), _curves(recording, track), _innovations(track), _events(outcome))
        ],
        "made": _made(recording),
    }
    path = folder / "report.html"
    atomic_write_text(environment().get_template("point.html.j2").render(context), path)
    return path


def _key_figures(outcome: PointOutcome) -> list[tuple[str, str, str]]:
    recording, s = outcome.recording, outcome.statistics
    rate = recording.rate_hz
    duration = f"{format_number(s.frames / rate)} s at {format_number(rate)} Hz" if rate else "frame rate not known"
    out = [
        ("Frames", str(s.frames), duration),
        (
            "Measured",
            format_percent(s.share(TargetStatus.MEASURED)),
            f"{s.counts['predicted']} predicted, {s.counts['lost']} lost",
        ),
        ("Longest interval predicted", f"{s.longest_miss}", "frames"),
    ]
    sigma = np.array([np.sqrt(np.diagonal(e.P)[:2]) for e in outcome.track if e.status is TargetStatus.MEASURED])
    if len(sigma):
        out.append(("Sigma", f"{format_number(float(np.median(sigma)))} px", "of a measured coordinate, median"))
        nis = format_number(float(np.sqrt(s.nis_mean)))
        out.append(("Innovations", nis, "RMS in sigmas; 1 for a correct model"))
    return out


def _path(recording: PointRecording, track: tuple[PointEstimate, ...]) -> Section:
    x, measured = _states(track), _of(track, TargetStatus.MEASURED)
    known = np.isfinite(x[:, 0])
    if not known.any():
        return Section("Path", "There is no position.")
    if recording.size_px is not None:
        p = image_area(recording.size_px, width=760)
    else:
        (u0, u1), (v0, v1) = padded_range(x[known, 0]), padded_range(x[known, 1])
        half = 0.5 * max(u1 - u0, v1 - v0, 1.0)
        u, v = (u0 + u1) / 2, (v0 + v1) / 2
        p = plot_area((u - half, u + half), (v - half, v + half), equal=True, y_down=True, width=760)
    out = axes(p, "Path of the target", "u (px)", "v (px)", grid=False)
    places = p.at(x[:, :2])
    out.append(f'<path class="line" d="{line_path(places[:, 0], places[:, 1])}" stroke="{BLUE}" stroke-width="1.1"/>')
    for which, colour in ((measured, GREEN), (_of(track, TargetStatus.PREDICTED), ORANGE)):
        some = places[which]
        some = some[:: max(1, -(-len(some) // _MOST_DOTS))]
        out.append(f'<path d="{dots(some, 1.7)}" fill="{colour}" fill-opacity="0.7"/>')
    out.append(note(p, "green: measured; orange: predicted"))
    return Section("Path", (), [PageDrawing(svg_of(p, "path of the target", [*out, frame(p)]), wide=True)])


def _curves(recording: PointRecording, track: tuple[PointEstimate, ...]) -> Section:
    x = _states(track)
    if not np.isfinite(x[:, 0]).any():
        return Section("Position and velocity", "There is no position.")
    sigma = np.array([np.sqrt(np.diagonal(e.P)) for e in track])
    seconds = recording.t_s is not None
    t: Array = recording.frames.astype(float) if recording.t_s is None else recording.t_s
    name = "time (s)" if seconds else "frame"
    shades = (
        Shade(_of(track, TargetStatus.PREDICTED), "predicted", "predicted"),
        Shade(_of(track, TargetStatus.LOST), "lost", "lost"),
    )
    per = recording.rate_hz or 1.0
    drawings = []
    for i, axis in enumerate("uv"):
        band = Band.about(x[:, i], sigma[:, i], 3.0, BLUE, "3 sigma")
        line = Line(x[:, i], BLUE, axis)
        y_range = padded_range(x[:, i])
        drawings.append(
            time_panel(t, axis, "px", lines=(line,), bands=(band,), shades=shades, time_name=name, y_range=y_range)
        )
    for i, axis in enumerate("uv"):
        speed = per * x[:, 2 + i]
        unit = "px/s" if seconds else "px/frame"
        line = Line(speed, VERMILLION, f"velocity {axis}")
        drawings.append(time_panel(t, f"velocity {axis}", unit, lines=(line,), shades=shades, time_name=name))
    words = "Filtered position with its 3-sigma band, and velocity. Shaded: predicted (yellow) and lost (grey)."
    return Section("Position and velocity", words, [PageDrawing(d) for d in drawings])


def _innovations(track: tuple[PointEstimate, ...]) -> Section:
    nis = np.array([e.nis for e in track if e.status is TargetStatus.MEASURED])
    nis = nis[np.isfinite(nis)]
    if not len(nis):
        return Section("Innovations", "No detection was compared with a prediction.")
    drawing = histogram(
        nis, (0.0, max(12.0, float(np.percentile(nis, 99)))), "Normalised innovation squared", "nis",
        footnote=f"mean {np.mean(nis):.2f}; 2 for a correct model",
    )  # fmt: skip
    words = (
        "Squared distance of each detection from the prediction, in sigmas. A mean far above 2 shows a motion or a"
        " scatter that the filter does not assume."
    )
    return Section("Innovations", words, [drawing])


def _events(outcome: PointOutcome) -> Section:
    rows = [(e["frame"], e["kind"]) for e in outcome.statistics.events]
    words = [f"{s.value}: {s.meaning}." for s in TargetStatus]
    return Section("Events and statuses", words, (), PageTable(("frame", "event"), rows) if rows else None)


def _states(track: tuple[PointEstimate, ...]) -> Array:
    return np.array([e.x for e in track])


def _of(track: tuple[PointEstimate, ...], status: TargetStatus) -> np.ndarray:
    return np.array([e.status is status for e in track])


def _made(recording: PointRecording) -> list[tuple[str, str]]:
    own = versions()
    how = "points of a table" if recording.detector == TABLE else f"detector {recording.detector}"
    return [
        ("input", how),
        ("beampose", f"{own['beampose']}, numpy {own['numpy']}, OpenCV {own['opencv-python-headless']}"),
    ]
