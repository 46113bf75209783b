"""Tables of studies in pages: the figures of a paper beside ours, as `python -m docs.website.figures` keeps them."""

from __future__ import annotations

import csv
import re
from pathlib import Path

from docs.website.text import cell, table

IMAGES = Path(__file__).resolve().parents[1] / "images"
MARKER = re.compile(r"<!-- table of study (\w+) -->")  # in a page, where the table belongs


def with_tables(markdown: str) -> str:
    """A page with each marker replaced by the table of docs/images/NAME/figures.csv.

    Raises:
        FileNotFoundError: there is no such table.
    """
    return MARKER.sub(lambda match: study_table(IMAGES / match[1] / "figures.csv"), markdown)


def study_table(path: Path) -> str:
    """The table of figures.csv of `beampose study` as Markdown; the columns of numbers depend on the study."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    head, *body = rows
    words = {0, head.index("unit"), head.index("note")}
    cells = ([cell(v) if i in words else _number(v) for i, v in enumerate(row)] for row in body)
    return "\n".join(table([name.replace("_", " ") for name in head], cells))


def _number(text: str) -> str:
    if not text:
        return ""
    value = float(text)
    return "below 1e-9" if 0 < value < 1e-9 else f"{value:.4g}"
