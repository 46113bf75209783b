"""Report of a calibration: verdict, findings, key figures and drawings in one self-contained HTML file."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from importlib import metadata
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from markupsafe import Markup

from geometry.arrays import Array
from lab.errors import InputError
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.json_text import bytes_of_file
from lab.findings.finding import Finding, Level, worst_first
from lab.number_format import format_number
from lab.report.html import environment

FILE_NAME = "report.html"
KINDS = ("Camera", "Pair", "Board", "Screens", "Beams", "Rig", "Drift check", "Plan")
KeyFigure: TypeAlias = tuple[str, str, str]  # label, value with unit (px and mm), note
LARGEST_BYTES = 5_000_000  # limit for e-mail, and for a browser to open the report without delay
_LONG_TABLE = 40  # number of rows above which a table is collapsed
_SENTENCE = {
    Level.PASS: "The result may be used.",
    Level.WARN: "The result may be used; note the warnings below.",
    Level.FAIL: "The result must not be used.",
}
_PLAN_SENTENCE = {
    Level.PASS: "This rig suits the range of poses.",
    Level.WARN: "This rig can be built; note the warnings below.",
    Level.FAIL: "This rig does not suit the range of poses.",
}


@dataclass(frozen=True, slots=True)
class PageTable:
    """A table. Cells are text or numbers; numbers are shown with four significant digits, nan as a dash."""

    heads: Sequence[str]  # with units: "drift (px)"
    rows: Sequence[Sequence[object]]  # each as long as heads

    def __post_init__(self) -> None:
        for i, row in enumerate(self.rows):
            if len(row) != len(self.heads):
                raise ValueError(f"row {i} has {len(row)} cells, the table {len(self.heads)} heads")


@dataclass(frozen=True, slots=True)
class PageDrawing:
    """A drawing as SVG or HTML text, which is not escaped, with its caption."""

    picture: str
    caption: str = ""
    wide: bool = False  # full width of the page instead of half


@dataclass(frozen=True, slots=True)
class Section:
    """One section of a report: text, then drawings, then a table."""

    title: str
    words: str | Sequence[str] = ()  # one paragraph or several; plain text
    drawings: Sequence[PageDrawing | str] = ()
    table: PageTable | None = None


@dataclass(frozen=True, slots=True)
class Provenance:
    """Date, program version and input files of a calibration."""

    date: str  # ISO
    version: str
    inputs: tuple[str, ...] = ()  # one line per file: name and checksum


@dataclass(frozen=True, slots=True)
class CalibrationReport:
    """Content of a calibration's report."""

    kind: str  # one of KINDS
    name: str
    verdict: Level
    findings: Sequence[Finding]
    key_figures: Sequence[KeyFigure]
    sections: Sequence[Section]
    made: Provenance = field(default_factory=lambda: provenance())

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"expected a kind of report out of {', '.join(KINDS)}, got {self.kind!r}")


def provenance(inputs: Iterable[Path] = (), made: date | None = None) -> Provenance:
    """The given date (default: today), the version of the program and the SHA-256 of the input files.

    Raises:
        InputError: for an input that cannot be read.
    """
    try:
        version = metadata.version("beampose")
    except metadata.PackageNotFoundError:  # run from a checkout that is not installed
        version = "not installed as a package"
    lines = []
    for path in inputs:
        try:
            digest = hashlib.sha256(bytes_of_file(Path(path))).hexdigest()
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from None
        lines.append(f"{Path(path).name}  sha256 {digest[:16]}")
    return Provenance((made or date.today()).isoformat(), version, tuple(lines))


def representative_views(rms_px: Array, worst: int = 4) -> list[tuple[int, str]]:
    """Indices of the views to show as pictures, each with its rank: the worst ones, the median and the best.

    rms_px (n,): nan for an unused view, which is never shown. worst: number of the worst views.
    """
    rms = np.asarray(rms_px, dtype=float)
    order = [int(i) for i in np.argsort(rms, kind="stable") if np.isfinite(rms[i])]
    named = [(i, "worst" if k == 0 else f"{k + 1}. worst") for k, i in enumerate(order[::-1][:worst])]
    if order:
        named += [(order[len(order) // 2], "median"), (order[0], "best")]
    shown: dict[int, str] = {}
    for i, word in named:
        shown.setdefault(i, word)
    return list(shown.items())


def write_calibration_report(report: CalibrationReport, folder: Path) -> Path:
    """Write report.html into a folder atomically; return its path.

    If it would exceed 5 MB, its largest pictures are each replaced by a note.
    """
    path = Path(folder) / FILE_NAME
    atomic_write_text(page(report), path)
    return path


def page(report: CalibrationReport) -> str:
    """HTML text of a report, at most 5 MB unless its tables alone are larger."""
    drawn = [[_drawing(d) for d in s.drawings] for s in report.sections]
    html = _rendered(report, drawn)
    by_size = sorted(
        ((len(d.picture.encode()), i, k) for i, section in enumerate(drawn) for k, d in enumerate(section)),
        reverse=True,
    )
    excess = len(html.encode("utf-8", "replace")) - LARGEST_BYTES
    if excess <= 0:
        return html
    for size, i, k in by_size:
        if excess <= 0:
            break
        note = '<p class="empty">Picture omitted: the report would have exceeded 5 MB.</p>'
        drawn[i][k] = replace(drawn[i][k], picture=note)
        excess -= size - len(note)
    return _rendered(report, drawn)


def _drawing(drawing: PageDrawing | str) -> PageDrawing:
    return drawing if isinstance(drawing, PageDrawing) else PageDrawing(drawing)


def _rendered(report: CalibrationReport, drawn: list[list[PageDrawing]]) -> str:
    context: dict[str, Any] = {
        "kind": report.kind,
        "name": report.name,
        "word": report.verdict.name,
        "css": report.verdict.word,
        "sentence": (_PLAN_SENTENCE if report.kind == "Plan" else _SENTENCE)[report.verdict],
        "made": report.made,
        "made_line": f"{report.made.date} · {_counted(report.findings)}",
        "findings": [
            {
                "css": f.level.word,
                "word": f.level.name,
                "what": f.what,
                "why": f.why,
                "remedy": f.remedy,
                "code": f.code if f.level > Level.PASS else "",
            }
            for f in worst_first(report.findings)
        ],
        "key_figures": report.key_figures,
        "sections": [_section(s, d) for s, d in zip(report.sections, drawn, strict=True)],
    }
    return environment().get_template("calibration.html.j2").render(context)


def section_context(section: Section) -> dict[str, Any]:
    """A section as context of the template sections.html.j2."""
    return _section(section, [_drawing(d) for d in section.drawings])


def _section(section: Section, drawings: list[PageDrawing]) -> dict[str, Any]:
    table = section.table
    return {
        "title": section.title,
        "words": [section.words] if isinstance(section.words, str) else list(section.words),
        "drawings": [{"picture": Markup(d.picture), "caption": d.caption, "wide": d.wide} for d in drawings],
        "table": None if table is None else {"heads": table.heads, "rows": [[cell(c) for c in r] for r in table.rows]},
        "numeric": [] if table is None else _numeric(table),
        "long": table is not None and len(table.rows) > _LONG_TABLE,
    }


def _counted(findings: Sequence[Finding]) -> str:
    """`2 failed, 1 warning, 5 passed`."""
    count = {level: sum(f.level == level for f in findings) for level in Level}
    warnings = f"{count[Level.WARN]} warning{'s' if count[Level.WARN] != 1 else ''}"
    return f"{count[Level.FAIL]} failed, {warnings}, {count[Level.PASS]} passed"


def cell(value: object) -> str:
    """A cell as text: numbers with four significant digits, None and nan as a dash."""
    if value is None:
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return str(value)
    if isinstance(value, float | np.floating):
        return format_number(float(value), 4) if math.isfinite(value) else "–" if math.isnan(value) else "∞"
    return str(value)


_NUMBER_TEXT = re.compile(r"^[-+−±]?[\d.,]+(\s*[×%°].*)?(\s*±.*)?$|^[–∞]?$")


def _numeric(table: PageTable) -> list[bool]:
    """Whether each column holds only numbers, which are aligned to the right."""
    return [
        bool(table.rows) and all(_NUMBER_TEXT.match(cell(row[k])) is not None for row in table.rows)
        for k in range(len(table.heads))
    ]
