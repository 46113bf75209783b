"""Drawings of a plan: values on a grid as coloured cells, and shares as bars."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from geometry.arrays import Array
from lab import number_format
from lab.number_format import format_percent
from lab.report.plot import svg
from lab.report.plot.colour_map import colours, hex_colour
from lab.report.plot.scales import number

_LEFT, _TOP, _WIDE, _HIGH = 58.0, 24.0, 468.0, 224.0
_MAX_LABELLED_COLUMNS = 15  # with more columns the cells are too small for a number


def cell_map(
    values: Array,
    x: Array,
    y: Array,
    title: str,
    *,
    x_name: str,
    y_name: str,
    low_is_bad: bool = False,
) -> str:
    """Values on a grid as coloured cells with their numbers.

    values (rows, columns): at y (rows,), increasing upwards, and x (columns,); nan is an empty cell with a cross. Deep
    colours mark bad values: large ones, or small ones with `low_is_bad`.
    """
    rows, columns = values.shape
    wide, high = _WIDE / columns, _HIGH / rows
    finite = values[np.isfinite(values)]
    lo, hi = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    if lo > 0 and hi > 6 * lo:  # logarithmic, otherwise a few large values would give all others the same colour
        share = np.log(values / lo) / np.log(hi / lo)
    else:
        share = (values - lo) / (hi - lo) if hi > lo else np.zeros_like(values)
    share = 0.12 + 0.76 * (1 - share if low_is_bad and hi > lo else share)  # avoids the ends of the colour scale
    out = [svg.text(_LEFT, 15, title, "title")]
    for j in range(rows):
        top = _TOP + (rows - 1 - j) * high
        for i in range(columns):
            left = _LEFT + i * wide
            box = f'x="{left:.1f}" y="{top:.1f}" width="{wide:.1f}" height="{high:.1f}"'
            value = float(values[j, i])
            middle = (left + wide / 2, top + high / 2 + 3.5)
            if not np.isfinite(value):
                out.append(f'<rect {box} fill="none" stroke="var(--line)"/>{svg.text(*middle, "×", "mid")}')
                continue
            fill = hex_colour(colours(np.array(share[j, i])))
            out.append(f'<rect {box} fill="{fill}" stroke="var(--line)" stroke-width="0.5"/>')
            if columns <= _MAX_LABELLED_COLUMNS:
                ink = "#fff" if share[j, i] > 0.5 else "#1c2126"
                out.append(svg.text(*middle, _cell(value), "mid", f"fill:{ink}"))
    bottom = _TOP + _HIGH
    out += [
        svg.text(_LEFT + (i + 0.5) * wide, bottom + 14, _plain(x[i]), "mid")
        for i in range(0, columns, -(-columns // 12))
    ]
    out += [
        svg.text(_LEFT - 6, _TOP + (rows - 0.5 - j) * high + 3.5, _plain(y[j]), "end")
        for j in range(0, rows, -(-rows // 12))
    ]
    out.append(svg.text(_LEFT + _WIDE / 2, bottom + 30, x_name, "mid"))
    turned = f'transform="translate(12 {_TOP + _HIGH / 2:.1f}) rotate(-90)"'
    out.append(f'<text x="0" y="0" class="mid" {turned}>{escape(y_name)}</text>')
    return _svg(out, title, bottom + 38)


def share_bars(parts: Sequence[tuple[str, float]], title: str) -> str:
    """Named shares (fractions; negative ones are drawn paler) as bars, in the given order."""
    left, wide, step = 132.0, 330.0, 22.0
    out = [svg.text(8, 14, title, "title")]
    scale = wide / max(max((abs(s) for _, s in parts), default=1.0), 1e-9)
    for k, (name, share) in enumerate(parts):
        y = 26 + step * k
        size = max(abs(share) * scale, 0.5)
        pale = ' opacity="0.4"' if share < 0 else ""
        out.append(svg.text(left - 8, y + 11, name, "end"))
        out.append(f'<rect x="{left}" y="{y}" width="{size:.1f}" height="14" fill="{svg.BLUE}"{pale}/>')
        out.append(svg.text(left + size + 6, y + 11, format_percent(share)))
    return _svg(out, title, 30 + step * len(parts))


def _cell(value: float) -> str:
    return f"{value:.0f}" if value == round(value) else number_format.format_number(value)


def _plain(value: float) -> str:
    return number(round(float(value), 4) + 0.0)


def _svg(parts: Sequence[str], title: str, height: float) -> str:
    name = escape(title, quote=True)
    return f'<svg class="plot" viewBox="0 0 540 {height:.0f}" role="img" aria-label="{name}">{"".join(parts)}</svg>'
