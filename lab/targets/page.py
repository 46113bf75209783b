"""report.html of a target in one camera: what all kinds of targets show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geometry.arrays import Array
from lab.findings.finding import Finding, verdict
from lab.number_format import format_number, format_percent
from lab.report.page import Page, PageDrawing, PageTable, Section, made_with, write_page
from lab.report.plot import svg
from lab.report.plot.series import Band, Line, Shade, time_panel
from lab.targets.target import F, Target, Track
from tracking.statuses import PoseStatus

_EVENTS = {
    "acquired": "found in the whole picture",
    "reacquired": "found again",
    "lost": "lost: the prediction is too uncertain",
}
_MOST_EVENTS = 60  # rows of the table
_MOST_DOTS = 6000


def write_target_page(target: Target[F], track: Track[F], findings: Sequence[Finding], folder: Path) -> Path:
    """Write the page of a target in one camera into a folder. Returns its path."""
    sentence = (
        f"The {target.subject} was followed.",
        f"The {target.subject} was followed; note the warnings below.",
        "The results must not be used as they are.",
    )[verdict(findings)]
    own = target.key_figures(track) if track.measured.any() else []
    sections = [_motion(target, track), *target.sections(track), *_path(track), *_events(target, track)]
    recording = track.recording
    made = ("method", target.method()), made_with("numpy", "opencv-python-headless")
    page = Page(
        f"tracked {target.subject}", recording.name, str(recording.path), sections,
        [*_key_figures(target, track), *own], recording.notes, made, findings, sentence,
    )  # fmt: skip
    return write_page(page, folder)


def _key_figures(target: Target[F], track: Track[F]) -> list[tuple[str, str, str]]:
    """The share of measured frames, and the sigma and the size in them."""
    counts, n, measured = track.statuses(), len(track.frames), track.measured
    of = f"{counts['measured']} of {n} frames; {counts['predicted']} predicted, {counts['lost']} lost"
    out = [("Measured", format_percent(counts["measured"] / n), of)]
    if measured.any():
        sigma = np.median(track.sigmas[measured], axis=0)
        centre = f"± {format_number(float(np.hypot(*sigma[:2])), 2)} px"
        out.append(("Centre", centre, "median sigma, both axes together"))
        if target.size_name:
            size = track.places[measured, 2]
            span = f"{size.min():.1f} to {size.max():.1f} px"
            out.append((target.size_name.capitalize(), f"{format_number(float(np.median(size)))} px", span))
    return out


@dataclass(frozen=True, slots=True)
class TimeAxis:
    """The time axis of the n frames of a page; frames without a measurement are shaded in its plots."""

    t: Array  # (n,)
    name: str
    statuses: Sequence[PoseStatus]

    @classmethod
    def of(cls, track: Track[F]) -> TimeAxis:
        """Times, or frame numbers where the rate is not known."""
        t_s, statuses = track.recording.t_s, [f.status for f in track.frames]
        if t_s is None:
            return cls(track.recording.numbers.astype(float), "frame", statuses)
        return cls(t_s, "time (s)", statuses)

    def panel(
        self,
        title: str,
        unit: str,
        *lines: Line,
        bands: tuple[Band, ...] = (),
        y_range: tuple[float, float] | None = None,
        wide: bool = True,
        height: int = 140,
        caption: str = "",
    ) -> PageDrawing:
        """Lines (n,) over time. wide: as the page; else half as wide."""
        at = {s: np.array([status is s for status in self.statuses]) for s in (PoseStatus.PREDICTED, PoseStatus.LOST)}
        drawing = time_panel(
            self.t, title, unit, lines=lines, bands=bands, y_range=y_range, width=1100 if wide else 540, height=height,
            shades=tuple(Shade(where, status.value, status.value) for status, where in at.items() if where.any()),
            time_name=self.name,
        )  # fmt: skip
        return PageDrawing(drawing, caption, wide)


def _motion(target: Target[F], track: Track[F]) -> Section:
    names = ["u of the centre", "v of the centre", *([target.size_name] if target.size_name else [])]
    panels, axis = [], TimeAxis.of(track)
    for i, name in enumerate(names):
        values = track.places[:, i]
        band = Band.about(values, track.sigmas[:, i], 3.0, svg.SKY, "3 sigma", 0.5)
        panels.append(axis.panel(name, "px", Line(values, svg.BLUE, name), bands=(band,), height=150))
    words = (
        "Place after each frame, with a band of 3 sigma. Shaded: frames without a measurement (predicted), and frames"
        " in which nothing is known (lost)."
    )
    return Section(f"Position{f' and {target.size_name}' if target.size_name else ''}", words, panels)


def _path(track: Track[F]) -> list[Section]:
    """The path of the centre in the picture, with the predicted frames as dots."""
    uv, predicted = track.places[:, :2], track.has_status(PoseStatus.PREDICTED)
    known = np.isfinite(uv[:, 0])
    if not known.any():
        return []
    if track.recording.size_px is not None:
        p = svg.image_area(track.recording.size_px)
    else:
        ranges = [svg.padded_range(uv[known, i]) for i in range(2)]
        half = 0.5 * max(*(high - low for low, high in ranges), 1.0)
        (u0, u1), (v0, v1) = ((low + high) / 2 + np.array([-half, half]) for low, high in ranges)
        p = svg.plot_area((u0, u1), (v0, v1), equal=True, y_down=True)
    out = svg.axes(p, "Path of the centre", "u (px)", "v (px)", grid=False)
    at = p.at(uv)
    out.append(f'<path d="{svg.line_path(at[:, 0], at[:, 1])}" fill="none" stroke="{svg.BLUE}" stroke-width="1.1"/>')
    if predicted.any():
        some = at[predicted][:: 1 + int(predicted.sum()) // _MOST_DOTS]
        out.append(f'<path d="{svg.dots(some, 1.8)}" fill="{svg.VERMILLION}"/>')
    out.append(svg.note(p, "line: all frames; dots: predicted ones"))
    return [Section("Path", (), [PageDrawing(svg.svg_of(p, "Path of the centre", [*out, svg.frame(p)]))])]


def _events(target: Target[F], track: Track[F]) -> list[Section]:
    """Tables of the events and of the causes of frames without a measurement."""
    sections = []
    meanings = {**_EVENTS, "ambiguous": f"{target.several}; none is chosen"}
    rows = [(number, meanings[f.event], f.found or None) for number, f in track.events()]
    if rows:
        more = f"The first {_MOST_EVENTS} of {len(rows)}." if len(rows) > _MOST_EVENTS else ()
        table = PageTable(("frame", "event", f"{target.subject}s in the picture"), rows[:_MOST_EVENTS])
        sections.append(Section("Events", more, (), table))
    causes = [(cause.value, count, cause.meaning) for cause, count in track.causes().items()]
    if causes:
        table = PageTable(("cause", "frames", "meaning"), causes)
        sections.append(Section("Frames without a measurement", (), (), table))
    return sections
