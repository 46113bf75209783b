"""A report in one self-contained HTML file: verdict, findings, key figures, and sections with drawings and tables.

Calibrations, plans, tracked targets, comparisons and detections are shown by it; the report of a run has its own page.
The environment of all HTML templates: kept compiled, with a security policy that loads nothing.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, TypeAlias

import jinja2
import numpy as np
from jinja2.bccache import Bucket
from markupsafe import Markup, escape

from geometry.compilation.compile_cache import private_folder
from lab.errors import RunError
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.error_text import printable
from lab.findings.finding import Finding, entries, verdict, worst_first
from lab.number_format import format_number
from lab.packages import versions

# The content security policy of the reports: they load nothing, and run only the scripts of their own template.

_INCLUDE = re.compile(r"{%-?\s*include\s+[\"']([^\"']+)[\"']\s*-?%}")
_END = "//end"  # Jinja drops a line break at the end of a template, which is not the end of a script
_SCRIPT = re.compile(r"<script>(.*?)</script>", re.DOTALL | re.IGNORECASE)


def content_policy(environment: jinja2.Environment, template: str, served: bool = False) -> str:
    """The policy of one template, for its `<meta http-equiv="Content-Security-Policy">`.

    served: the page may load from the server that it comes from.

    The inline scripts are allowed by their hashes, computed from the template and not from the page: a script that
    gets into the page by its data does not run. Scripts of templates therefore have no Jinja expressions: data is
    in attributes, or in `<script type="application/json">`, which does not run.
    """
    hashes = [
        f"'sha256-{_hash(environment.from_string(text + _END).render().removesuffix(_END))}'"
        for text in scripts(environment, template)
    ]
    return "; ".join(
        (
            "default-src 'none'",
            "style-src 'unsafe-inline'",
            "img-src data:",
            f"script-src {' '.join(hashes) or chr(39) + 'none' + chr(39)}",
            *(("connect-src 'self'",) if served else ()),
            "base-uri 'none'",
            "form-action 'none'",
        )
    )


def scripts(environment: jinja2.Environment, template: str) -> list[str]:
    """The inline scripts of a template and of those that it includes, as written there."""
    assert environment.loader is not None
    source = environment.loader.get_source(environment, template)[0]
    inner = [n for n in _INCLUDE.findall(_SCRIPT.sub("", source)) if n.endswith(".j2")]
    return _SCRIPT.findall(source) + [text for name in inner for text in scripts(environment, name)]


def _hash(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")


# Compiled templates kept on disk: to compile those of one report takes 0.05 s.


class _TemplateCache(jinja2.FileSystemBytecodeCache):
    """Jinja's cache, for which a file that cannot be read or written is a missing one."""

    def load_bytecode(self, bucket: Bucket) -> None:
        try:
            super().load_bytecode(bucket)
        except Exception:  # unpickling a truncated file raises almost anything
            bucket.reset()

    def dump_bytecode(self, bucket: Bucket) -> None:
        with contextlib.suppress(OSError):  # for instance a full disk
            super().dump_bytecode(bucket)


def template_cache(sources: tuple[Path, ...]) -> jinja2.BytecodeCache | None:
    """Where templates are kept that were compiled from these files; None where no folder can be written safely."""
    folder = private_folder(sources)
    if folder is None:
        return None
    return _TemplateCache(str(folder), f"%s-{metadata.version('jinja2')}.template")


# The template engine of all reports: each is one self-contained HTML file.


TEMPLATES = Path(__file__).parent / "templates"


@cache
def environment() -> jinja2.Environment:
    """The templates in lab/report/templates/; text that is not marked as HTML is escaped."""
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        bytecode_cache=template_cache((Path(__file__), *sorted(TEMPLATES.iterdir()))),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["words"] = words
    made.globals["content_policy"] = lambda template, served=False: content_policy(made, template, served)
    return made


def words(text: str) -> Markup:
    """A message as HTML: what the command line shows between backticks is code here."""
    return Markup(re.sub(r"`([^`\n]+)`", r"<code>\1</code>", str(escape(text))))


def as_script(data: object) -> Markup:
    """Data for a script element of type application/json."""
    return Markup(json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"))


FILE_NAME = "report.html"
KeyFigure: TypeAlias = tuple[str, str, str]  # label, value with unit (px and mm), note
LARGEST_BYTES = 5_000_000  # limit for e-mail, and for a browser to open the report without delay
_LONG_TABLE = 40  # number of rows above which a table is collapsed


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
class Page:
    """Content of a report."""

    maker: str  # what the results are, such as "tracked circle"
    name: str
    line: str  # below the name: the source, or the date
    sections: Sequence[Section]
    key_figures: Sequence[KeyFigure] = ()
    notes: Sequence[str] = ()
    made: Sequence[tuple[str, str]] = ()  # with what the results were made: name and value
    findings: Sequence[Finding] = ()
    sentence: str = ""  # what the page says at its top about the results as a whole; empty: nothing is judged
    words: tuple[str, str, str] = ("PASS", "CHECK", "FAIL")  # of the verdict and of the findings, by level


def made_with(*libraries: str) -> tuple[str, str]:
    """A line of `made`: the versions of the program and of these libraries."""
    own = versions()
    shown = [f"{name.removesuffix('-python-headless').replace('opencv', 'OpenCV')} {own[name]}" for name in libraries]
    return "beampose", ", ".join([own["beampose"], *shown])


def write_page(page: Page, folder: Path) -> Path:
    """Write report.html into a folder atomically; return its path.

    If it would exceed 5 MB, its largest pictures are each replaced by a note.
    """
    path = Path(folder) / FILE_NAME
    atomic_write_text(html_of(page), path)
    return path


def html_of(page: Page) -> str:
    """HTML text of a report, at most 5 MB unless its tables alone are larger."""
    drawn = [[d if isinstance(d, PageDrawing) else PageDrawing(d) for d in s.drawings] for s in page.sections]
    html = _rendered(page, drawn)
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
    return _rendered(page, drawn)


def _rendered(page: Page, drawn: list[list[PageDrawing]]) -> str:
    level = verdict(page.findings) if page.sentence else None
    sections = [_section(s, d) for s, d in zip(page.sections, drawn, strict=True)]
    template = environment().get_template("page.html.j2")
    return template.render(page=page, level=level, findings=worst_first(page.findings), sections=sections)


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


# The report of a run that ended with an error: it says so, and why, instead of figures.


@dataclass(frozen=True, slots=True)
class Failure:
    """What is known of a run that ended with an error."""

    name: str
    message: str  # the error as the command line shows it: one plain line
    run_folder: str = ""
    code: str = RunError.code  # its explanation is shown
    exit_status: int = RunError.exit_status
    log: Sequence[str] = ()  # lines up to the error
    files: Sequence[str] = ()  # in the folder of the results: of an earlier attempt, or incomplete
    traceback: str = ""  # address of its file, relative to the report
    earlier: bool = False  # the results of an earlier, successful processing were kept elsewhere


def files_beside(report: Path) -> list[str]:
    """The names of the files in the folder of a report, so that they are not taken for results of this attempt."""
    return sorted(p.name for p in report.parent.iterdir() if p.is_file() and p.name != report.name)


def write_failure_report(path: Path, failure: Failure) -> Path:
    """Write the report of a failure as the HTML file `path`; returns the path. Raises InputError."""
    text = environment().get_template("failure.html.j2").render(
        f=failure, explanation=entries()[failure.code], log=[printable(line) for line in failure.log]
    )  # fmt: skip
    atomic_write_text(text, path)
    return path
