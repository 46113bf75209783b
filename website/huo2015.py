"""The table of docs/huo2015.md: the figures of the paper beside ours, as `python -m website.figures` keeps them."""

from __future__ import annotations

import csv
from pathlib import Path

from website.text import cell, table

MARKER = "<!-- table of the study -->"  # in the page, where the table belongs
_FIGURES = Path(__file__).resolve().parents[1] / "docs" / "images" / "huo2015" / "figures.csv"
_HEAD = ("quantity", "unit", "paper", "conventional filter", "curve switching", "beampose", "note")
_COLUMNS = ("paper", "conventional", "curve_switching", "beampose")


def with_table(markdown: str) -> str:
    """A page with the table in place of the marker, if it has one."""
    return markdown.replace(MARKER, study_table()) if MARKER in markdown else markdown


def study_table() -> str:
    """The table as Markdown."""
    with _FIGURES.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    cells = ((cell(r["quantity"]), r["unit"], *(_number(r[c]) for c in _COLUMNS), cell(r["note"])) for r in rows)
    return "\n".join(table(_HEAD, cells))


def _number(text: str) -> str:
    if not text:
        return ""
    value = float(text)
    return "below 1e-9" if 0 < value < 1e-9 else f"{value:.4g}"
