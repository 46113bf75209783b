"""report.html of a tracked target: what the pages of all trackers have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibration.findings import Finding, Level, verdict
from geometry.arrays import Array, Bools
from lab.files.text.atomic_write import atomic_write_text
from lab.number_format import format_percent
from lab.report.calibration.calibration_page import PageDrawing, PageTable, Section, section_context
from lab.report.html import environment
from lab.report.plot.axes import BLUE, VERMILLION, axes, dots, frame, image_area, line_path, note, svg_of
from lab.report.plot.series import Shade
from lab.targets.series import WORDS, F, FrameSeries
from lab.versions import versions
from tracking.statuses import PoseStatus

_EVENTS = {
    "acquired": "found in the whole picture",
    "reacquired": "found again",
    "lost": "lost: the prediction is too uncertain",
}
_MOST_EVENTS = 60  # rows of the table


@dataclass(frozen=True, slots=True)
class Words:
    """What the target is called."""

    subject: str  # such as "circle"
    targets: str  # name of the number of targets of an event
    ambiguous: str  # meaning of that event
    cause: Callable[[str], str]  # meaning of a cause


def write_target_page(
    series: FrameSeries[F],
    findings: Sequence[Finding],
    words: Words,
    key_figures: Sequence[tuple[str, str, str]],
    sections: Sequence[Section],
    method: str,
    folder: Path,
) -> Path:
    """Write report.html into a folder. Returns its path."""
    level = verdict(findings)
    own = versions()
    sentences = {
        Level.PASS: f"The {words.subject} was followed.",
        Level.WARN: f"The {words.subject} was followed; note the warnings below.",
        Level.FAIL: "The results must not be used as they are.",
    }
    context: dict[str, Any] = {
        "subject": words.subject,
        "name": series.name,
        "source": series.source,
        "word": WORDS[level].upper(),
        "status": WORDS[level],
        "sentence": sentences[level],
        "findings": [
            {"status": WORDS[f.level], "what": f.what, "why": f.why, "remedy": f.remedy, "code": f.code}
            for f in findings
        ],
        "key_figures": [measured_figure(series), *key_figures],
        "notes": series.notes,
        "sections": [section_context(s) for s in (*sections, *event_sections(series, words))],
        "made": [
            ("method", method),
            ("beampose", f"{own['beampose']}, numpy {own['numpy']}, OpenCV {own['opencv-python-headless']}"),
        ],
    }
    path = folder / "report.html"
    atomic_write_text(environment().get_template("target.html.j2").render(context), path)
    return path


def measured_figure(series: FrameSeries[F]) -> tuple[str, str, str]:
    """The share of measured frames."""
    counts, n = series.statuses(), len(series.frames)
    of = f"{counts['measured']} of {n} frames; {counts['predicted']} predicted, {counts['lost']} lost"
    return "Measured", format_percent(counts["measured"] / n), of


def status_shades(series: FrameSeries[F]) -> tuple[Shade, ...]:
    """Shades of the frames that are not measured."""
    return tuple(
        Shade(series.has_status(status), status.value, status.value)
        for status in (PoseStatus.PREDICTED, PoseStatus.LOST)
        if series.has_status(status).any()
    )


def path_section(size_px: tuple[int, int] | None, uv_px: Array, predicted: Bools) -> Section:
    """The path (n, 2) of a centre in the picture, with the predicted frames (n,) as dots."""
    assert size_px is not None  # there is a usable picture
    p = image_area(size_px)
    out = axes(p, "Path of the centre", "u (px)", "v (px)", grid=False)
    at = p.at(uv_px)
    out.append(f'<path d="{line_path(at[:, 0], at[:, 1])}" fill="none" stroke="{BLUE}" stroke-width="1.1"/>')
    if predicted.any():
        out.append(f'<path d="{dots(p.at(uv_px[predicted]), 1.8)}" fill="{VERMILLION}"/>')
    out.append(note(p, "line: all frames; dots: predicted ones"))
    return Section("Path", (), [PageDrawing(svg_of(p, "Path of the centre", [*out, frame(p)]))])


def event_sections(series: FrameSeries[F], words: Words) -> list[Section]:
    """Tables of the events and of the causes of frames without a measurement."""
    sections = []
    meanings = {**_EVENTS, "ambiguous": words.ambiguous}
    rows = [
        [e["frame"], meanings.get(str(e["kind"]), str(e["kind"])), e[words.targets] or None]
        for e in series.events(words.targets)
    ]
    if rows:
        more = f"The first {_MOST_EVENTS} of {len(rows)}." if len(rows) > _MOST_EVENTS else ()
        table = PageTable(("frame", "event", f"{words.subject}s in the picture"), rows[:_MOST_EVENTS])
        sections.append(Section("Events", more, (), table))
    causes = series.causes()
    if causes:
        table = PageTable(("cause", "frames", "meaning"), [[c, n, words.cause(c)] for c, n in causes.items()])
        sections.append(Section("Frames without a measurement", (), (), table))
    return sections
