"""Maps over a picture or a range, and the colours of their values."""

from __future__ import annotations

import cv2
import numpy as np
from contourpy import contour_generator

from geometry.arrays import Array
from lab.report.plot import svg

# Colours for values: sequential and diverging maps, their range, and the bar beside a plot.

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


def colour_bar(p: svg.PlotArea, lo: float, hi: float, unit: str, diverging: bool) -> str:
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
    scale = svg.Scale(lo, hi, top + high, top)
    marks = svg.ticks(lo, hi, 5)
    for at, words in zip(scale(marks), svg.tick_texts(marks), strict=True):
        out.append(f'<path class="grid" d="M{x + 12:.1f} {at:.1f}h4"/>{svg.text(x + 18, float(at) + 3.5, words)}')
    if unit:
        out.append(svg.text(x + 2, top - 6, unit))
    return "".join(out)


# Maps of a quantity over a plane: colours, contour lines and a colour bar.


def heat_map(
    values: Array,
    extent: tuple[float, float, float, float],
    title: str,
    unit: str,
    *,
    x_name: str = "u (px)",
    y_name: str = "v (px)",
    y_down: bool = True,
    limits: tuple[float, float] | None = None,
    equal: bool = True,
) -> str:
    """A quantity over a plane, with contour lines and a colour bar.

    values (rows, columns): at evenly spaced places from the first to the last of extent = (x_first, x_last, y_first,
    y_last), row 0 at y_first; nan where there is none (hatched). limits: of the colours; None: of the values.
    equal: one unit has the same length in x and y.
    """
    values = np.asarray(values, dtype=float)
    lo, hi = limits or value_range(values, False)
    x0, x1, y0, y1 = extent
    p = svg.plot_area((x0, x1), (y0, y1), equal=equal, y_down=y_down, right=BAR_WIDTH)
    out = [*svg.axes(p, title, x_name, y_name, grid=False), _hatched(*p.box)]
    out.append(_image(p, _enlarged(values if y_down else values[::-1]), lo, hi))
    grid_x, grid_y = np.linspace(x0, x1, values.shape[1]), np.linspace(y0, y1, values.shape[0])
    for level in contour_levels(lo, hi).tolist():
        lines = [p.at(line) for line in contour_lines(values, grid_x, grid_y, level)]
        if not lines:
            continue
        d = "".join(map(svg.polyline, lines))
        out.append(f'<path d="{d}" stroke="#000" stroke-opacity="0.35" stroke-width="2.4" fill="none"/>')
        out.append(f'<path d="{d}" stroke="#fff" stroke-width="1.1" fill="none"/>')
        if place := label_place(p, lines):
            style = "fill:#fff;font-weight:600;paint-order:stroke;stroke:#000a;stroke-width:2.6px"
            out.append(svg.text(place[0], place[1] + 3.5, svg.number(level), "mid", style))
    finite = values[np.isfinite(values)]
    out.append(colour_bar(p, lo, hi, unit, False))
    if finite.size:
        spread = f"{svg.number(float(finite.min()))} to {svg.number(float(finite.max()))} {unit}"
        out.append(svg.note(p, f"{spread}, median {svg.number(float(np.median(finite)))}"))
    return svg.svg_of(p, title, [*out, svg.frame(p)])


def contour_levels(lo: float, hi: float) -> Array:
    """Round levels: evenly spaced, or 1, 2, 5, 10 ... where the values span more than a factor of 6.

    An uncertainty grows steeply towards the corners of an image: with even levels the whole usable part would lie
    inside the first contour.
    """
    if lo > 0 and hi > 6 * lo:
        powers = 10.0 ** np.arange(np.floor(np.log10(lo)), np.ceil(np.log10(hi)) + 1)
        steps = (powers[:, None] * [1, 2, 5]).ravel()
        return steps[(steps > lo) & (steps < hi)]
    return svg.ticks(lo, hi, 5)


def contour_lines(values: Array, x: Array, y: Array, level: float) -> list[Array]:
    """The contour lines of a surface at a level, each (n, 2); a closed line ends at its first point.

    values (rows, columns) over y (rows,) and x (columns,). Cells with a nan have none.
    """
    if min(values.shape) < 2:
        return []
    generator = contour_generator(x, y, np.ma.masked_invalid(values), corner_mask=False)
    return [np.asarray(line) for line in generator.lines(level)]


def label_place(p: svg.PlotArea, lines: list[Array]) -> tuple[float, float] | None:
    """The place for the label of contour lines, drawing coordinates: their point nearest the diagonal of the plot.

    This spreads the labels of different levels. None where all points are too close to the edge for a label.
    """
    at = np.concatenate(lines)
    left, top, wide, high = p.box
    middle, room = np.array([left + wide / 2, top + high / 2]), np.array([wide / 2 - 16, high / 2 - 9])
    at = at[(np.abs(at - middle) < room).all(axis=1)]
    if not len(at):
        return None
    off = np.abs((at[:, 0] - left) / wide - (at[:, 1] - top) / high)
    x, y = at[int(np.argmin(off))].tolist()
    return x, y


def _image(p: svg.PlotArea, values: Array, lo: float, hi: float) -> str:
    """The colours of values (rows, columns) over the plot area as an embedded PNG, transparent at nan."""
    rgb = colours((values - lo) / (hi - lo))
    alpha = np.where(np.isfinite(values), 255, 0).astype(np.uint8)
    return svg.filled(p, svg.image_uri(np.dstack([rgb[..., ::-1], alpha]), "png"))


def _enlarged(values: Array) -> Array:
    """The map interpolated to at least 160 columns; nan stay."""
    rows, columns = values.shape
    times = max(1, -(-160 // columns))
    # The first and the last value lie on the edges of the plot, as `extent` defines.
    across = np.linspace(0, columns - 1, min(columns * times, 320), dtype=np.float32)
    down = np.linspace(0, rows - 1, min(rows * times, 320), dtype=np.float32)
    map_x, map_y = np.meshgrid(across, down)
    filled = np.where(np.isfinite(values), values, 0.0).astype(np.float32)
    weight = np.isfinite(values).astype(np.float32)
    smooth = cv2.remap(filled, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    known = cv2.remap(weight, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.where(known > 0.5, smooth / np.maximum(known, 1e-3), np.nan).astype(float)


def _hatched(left: float, top: float, wide: float, high: float) -> str:
    """Slanted lines over an area, visible where a map has no value."""
    out, step = [], 9.0
    for s in np.arange(step, wide + high, step):
        x0, y0 = (left + s, top) if s <= wide else (left + wide, top + s - wide)
        x1, y1 = (left, top + s) if s <= high else (left + s - high, top + high)
        out.append(f"M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}")
    return f'<path class="grid" d="{"".join(out)}"/>'
