"""Real data and simulations side by side, in docs/validation.md, from validation.csv beside this file.

Every row quotes the figures of docs/accuracy.md that it shows; a test compares them.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from html import escape
from pathlib import Path

from docs.website.text import cell, table

TABLE = Path(__file__).with_name("validation.csv")
MARKER = "<!-- comparisons -->"  # in docs/validation.md, where the plot and the table belong
_COLOURS = {"simulated": "#3f7fd0", "simulated light in real photographs": "#2f9e7a", "real": "#d9822b"}
_LOW, _HIGH = 0.18, 3.0
_LEFT, _RIGHT, _ROW, _TOP = 330, 640, 24, 34  # px


@dataclass(frozen=True, slots=True)
class Row:
    """One comparison: the range of found over stated."""

    subject: str
    what: str
    data: str
    seeds: str
    lowest: float
    highest: float
    quote: str  # of docs/accuracy.md


def rows() -> list[Row]:
    """All comparisons; a mean of squares (NEES per component) becomes a ratio."""
    out = []
    with TABLE.open(encoding="utf-8", newline="") as file:
        for r in csv.DictReader(file):
            low, high = (math.sqrt(float(r[k])) if r["kind"] == "NEES" else float(r[k]) for k in ("lowest", "highest"))
            out.append(Row(r["subject"], r["what"], r["data"], r["seeds"], low, high, r["quote"]))
    return out


def with_comparisons(markdown: str) -> str:
    """A page with the marker replaced by the plot and the table of all comparisons."""
    if MARKER not in markdown:
        return markdown
    shown = rows()
    head = ("", "data", "found over stated", "seeds or sets")
    lines = table(head, ((cell(f"{r.subject}: {r.what}"), r.data, _range(r), r.seeds) for r in shown))
    return markdown.replace(MARKER, "\n".join([plot(shown), *lines]))


def _range(row: Row) -> str:
    return f"{row.lowest:.2f}" if row.lowest == row.highest else f"{row.lowest:.2f} to {row.highest:.2f}"


def _x(ratio: float) -> float:
    return _LEFT + (_RIGHT - _LEFT) * math.log(ratio / _LOW) / math.log(_HIGH / _LOW)


def plot(shown: list[Row]) -> str:
    """All ratios on a logarithmic axis, as SVG in the colours of the page."""
    bottom = _TOP + _ROW * len(shown)
    parts = [
        f'<line x1="{_x(v):.1f}" x2="{_x(v):.1f}" y1="{_TOP - 6}" y2="{bottom}" stroke="currentColor" '
        f'stroke-opacity="{0.9 if v == 1 else 0.2}"/>'
        f'<text x="{_x(v):.1f}" y="{bottom + 16}" text-anchor="middle">{v:g}</text>'
        for v in (0.2, 0.5, 1, 2)
    ]
    for k, row in enumerate(shown):
        y, colour = _TOP + _ROW * (k + 0.5), _COLOURS[row.data]
        low, high = _x(row.lowest), _x(row.highest)
        parts.append(
            f'<text x="{_LEFT - 12}" y="{y + 4}" text-anchor="end">{escape(f"{row.subject}: {row.what}")}</text>'
            f'<rect x="{low - 5:.1f}" y="{y - 5}" width="{high - low + 10:.1f}" height="10" rx="5" fill="{colour}">'
            f"<title>{_range(row)}</title></rect>"
        )
    at = 0.0
    for name, colour in _COLOURS.items():
        parts.append(
            f'<rect x="{at}" y="6" width="10" height="10" rx="5" fill="{colour}"/>'
            f'<text x="{at + 16}" y="15">{name}</text>'
        )
        at += 34 + 6.6 * len(name)
    parts.append(
        f'<text x="{(_LEFT + _RIGHT) / 2}" y="{bottom + 34}" text-anchor="middle">error over stated sigma, RMS</text>'
    )
    return (
        f'<svg viewBox="0 0 {_RIGHT + 10} {bottom + 42}" role="img" aria-label="found over stated sigma" '
        f'fill="currentColor" font-size="12.5" style="max-width: 44rem">{"".join(parts)}</svg>\n'
    )
