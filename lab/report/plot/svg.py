"""Elements of a plot in SVG text: colours, text, lines, areas, dots and embedded images.

Coordinates are viewBox units, about one screen pixel each. Plots are written as text because importing matplotlib takes
0.33 s of process time, as long as the whole report of a usual run (docs/decisions/figures.md).
"""

from __future__ import annotations

import base64
from html import escape

import numpy as np

from geometry.arrays import Array, Ints
from lab.report.plot.thinning import true_ranges

# The palette of Okabe & Ito: distinct with any kind of colour vision.
BLUE, ORANGE, GREEN, VERMILLION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PURPLE, SKY, YELLOW, GREY = "#CC79A7", "#56B4E9", "#F0E442", "#8a8f98"
INK = "var(--ink)"  # the page's text colour


def figure(width: float, height: float, title: str, parts: list[str], *, css: str = "plot", data: str = "") -> str:
    """A whole drawing as an svg element with a name for screen readers. data: further attributes."""
    name = escape(title, quote=True)
    return (
        f'<svg class="{css}" viewBox="0 0 {width:.0f} {height:.0f}"{data} role="img" aria-label="{name}">'
        f"<title>{escape(title)}</title>{''.join(parts)}</svg>"
    )


def text(x: float, y: float, words: str, css: str = "", style: str = "") -> str:
    """A text element; the words are escaped. style: CSS, which takes precedence over the page's rules for text."""
    own = f' style="{escape(style)}"' if style else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" class="{css}"{own}>{escape(words)}</text>'


def vertical_text(x: float, y: float, words: str) -> str:
    """A text element that reads upwards, centred on (x, y)."""
    return f'<text x="0" y="0" class="mid" transform="translate({x:.0f} {y:.1f}) rotate(-90)">{escape(words)}</text>'


def line_path(x: Array, y: Array) -> str:
    """The `d` of a line through drawing coordinates (n,), interrupted at nan; an isolated point becomes a dot."""
    parts = []
    for start, stop in true_ranges(np.isfinite(x) & np.isfinite(y)):
        parts.append(_steps(x[start:stop], y[start:stop]) + ("" if stop - start > 1 else "h0"))
    return "".join(parts)


def _steps(x: Array, y: Array) -> str:
    """The `d` of a line through finite drawing coordinates (n,), n > 0: its start and then steps, in tenths."""
    places = np.round(10 * np.stack([x, y], -1)).astype(np.int64)  # rounded first: steps do not accumulate errors
    start = f"M{places[0, 0] / 10:.1f} {places[0, 1] / 10:.1f}"
    return start + ("l" + _tenths(np.diff(places, axis=0).ravel()) if len(places) > 1 else "")


def _tenths(values: Ints) -> str:
    """Integers (n,) divided by ten as a list of numbers in as few characters as SVG allows."""
    distinct, which = np.unique(values, return_inverse=True)
    words = [f"{v / 10:g}".replace("0.", ".") if abs(v) < 10 else f"{v / 10:g}" for v in distinct.tolist()]
    words = [w if w.startswith("-") else f" {w}" for w in words]
    return "".join([words[i] for i in which.tolist()]).lstrip()


def area_path(x: Array, low: Array, high: Array) -> str:
    """The `d` of the area between two lines (n,) in drawing coordinates, interrupted at nan."""
    parts = []
    for start, stop in true_ranges(np.isfinite(low) & np.isfinite(high)):
        xs = np.concatenate([x[start:stop], x[start:stop][::-1]])
        ys = np.concatenate([high[start:stop], low[start:stop][::-1]])
        parts.append(_steps(xs, ys) + "z")
    return "".join(parts)


def bar_path(edges: Array, tops: Array, base: float) -> str:
    """The `d` of adjacent bars: edges (n + 1,), tops (n,) and base in drawing coordinates."""
    bars = zip(edges[:-1].tolist(), edges[1:].tolist(), tops.tolist(), strict=True)
    return "".join(f"M{a:.1f} {base:.1f}V{y:.1f}H{b:.1f}V{base:.1f}z" for a, b, y in bars)


def polyline(places: Array, closed: bool = False) -> str:
    """The `d` of one line through finite drawing coordinates (n, 2)."""
    return "M" + " ".join(map("%.1f %.1f".__mod__, map(tuple, places.tolist()))) + ("z" if closed else "")


def segments(starts: Array, ends: Array) -> str:
    """The `d` of separate lines from (n, 2) to (n, 2), drawing coordinates; lines with a nan are omitted."""
    good = np.isfinite(starts).all(axis=1) & np.isfinite(ends).all(axis=1)
    rows = np.concatenate([starts[good], ends[good]], axis=1)
    return "".join(map("M%.1f %.1fL%.1f %.1f".__mod__, map(tuple, rows.tolist())))


def dots(places: Array, radius: float) -> str:
    """The `d` of filled circles at (n, 2), drawing coordinates; nan are omitted."""
    good = places[np.isfinite(places).all(axis=1)]
    r = f"{radius:g}"
    ring = f"a{r} {r} 0 1 0 {2 * radius:g} 0a{r} {r} 0 1 0 {-2 * radius:g} 0z"
    return "".join(f"M{x - radius:.1f} {y:.1f}{ring}" for x, y in good.tolist())


def picture_uri(data: bytes, kind: str) -> str:
    """The bytes of an image file as a data URI; kind: png or jpeg."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
