"""Colours for values: sequential and diverging maps, their range, and the bar beside a plot."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array
from lab.report.plot.axes import PlotArea
from lab.report.plot.scales import Scale, tick_texts, ticks
from lab.report.plot.svg import text

# Anchors of the colour maps. The lightness is monotonic, so that the order is kept in print and for all colour vision.
# Sequential: cividis (Nunez, Anderton & Renslow 2018); diverging: blue to vermillion of Okabe & Ito through light grey.
_SEQUENTIAL = (
    (253, 234, 69),
    (203, 186, 105),
    (158, 148, 117),
    (120, 118, 121),
    (80, 90, 109),
    (40, 62, 107),
    (0, 32, 77),
)
_DIVERGING = (
    (0, 74, 130),
    (60, 140, 200),
    (168, 204, 228),
    (238, 238, 238),
    (244, 190, 150),
    (222, 120, 50),
    (150, 58, 0),
)
BAR_WIDTH = 74  # viewBox units that a colour bar with its labels takes


def colours(share: Array, diverging: bool = False) -> np.ndarray:
    """RGB (..., 3) uint8 of shares (...) of the range, clipped to 0..1."""
    anchors = np.array(_DIVERGING if diverging else _SEQUENTIAL, dtype=float)
    places = np.linspace(0, 1, len(anchors))
    share = np.nan_to_num(np.clip(share, 0, 1))
    return np.stack([np.interp(share, places, anchors[:, k]) for k in range(3)], axis=-1).round().astype(np.uint8)


def hex_colour(rgb: np.ndarray) -> str:
    """`#rrggbb` of (3,) uint8."""
    return "#" + "".join(f"{int(v):02x}" for v in rgb)


def value_range(values: Array, diverging: bool) -> tuple[float, float]:
    """The range of the colours: all finite values, without the largest 2 % where these are spikes."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return (-1.0, 1.0) if diverging else (0.0, 1.0)
    if diverging:
        top = max(float(np.abs(finite).max()), 1e-12)
        return -top, top
    lo, hi = float(finite.min()), float(finite.max())
    usual = float(np.percentile(finite, 98))
    hi = hi if hi <= 3 * usual else 1.5 * usual  # image corners where a lens model diverges would take all colours
    return lo, max(hi, lo + max(abs(lo), 1e-12) * 1e-3)


def colour_bar(p: PlotArea, lo: float, hi: float, unit: str, diverging: bool) -> str:
    """The colours with their values, to the right of the axes."""
    left, top, wide, high = p.box
    high = max(high, 40.0)
    x, n = left + wide + 14, 40
    out = []
    fills = colours((np.arange(n) + 0.5) / n, diverging)
    for i in range(n):
        y = top + high * (1 - (i + 1) / n)
        out.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="12" height="{high / n + 0.6:.1f}" fill="{hex_colour(fills[i])}"/>'
        )
    scale = Scale(lo, hi, top + high, top)
    marks = ticks(lo, hi, 5)
    for at, words in zip(scale(marks), tick_texts(marks), strict=True):
        out.append(f'<path class="grid" d="M{x + 12:.1f} {at:.1f}h4"/>{text(x + 18, float(at) + 3.5, words)}')
    if unit:
        out.append(text(x + 2, top - 6, unit))
    return "".join(out)
