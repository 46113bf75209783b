"""Maps of a calibration: a quantity over a picture or a screen, flatness, correlations."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import cv2
import numpy as np

from geometry.arrays import Array
from lab.report.plot.axes import Plane, axes, dots, frame, number, picture_uri, plane, segments, svg_of
from lab.report.plot.axes import note as foot
from lab.report.plot.svg import Scale, text, tick_texts, ticks

# Anchors of the colours, light to dark so that print and all eyes keep the order. Sequential: cividis (Nunez, Anderton
# & Renslow 2018); diverging: blue to vermillion of Okabe & Ito through a light grey.
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
_RIGHT = 74  # room for the colour bar


def colours(share: Array, diverging: bool = False) -> np.ndarray:
    """RGB (..., 3) uint8 of shares (...) of the range, 0 to 1 and clipped to it."""
    anchors = np.array(_DIVERGING if diverging else _SEQUENTIAL, dtype=float)
    places = np.linspace(0, 1, len(anchors))
    share = np.nan_to_num(np.clip(share, 0, 1))
    return np.stack([np.interp(share, places, anchors[:, k]) for k in range(3)], axis=-1).round().astype(np.uint8)


def hex_colour(rgb: np.ndarray) -> str:
    """`#rrggbb` of (3,) uint8."""
    return "#" + "".join(f"{int(v):02x}" for v in rgb)


def value_range(values: Array, diverging: bool) -> tuple[float, float]:
    """The range that the colours span: all finite values but the topmost hundredth where that one is a spike."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return (-1.0, 1.0) if diverging else (0.0, 1.0)
    if diverging:
        top = max(float(np.abs(finite).max()), 1e-12)
        return -top, top
    lo, hi = float(finite.min()), float(finite.max())
    usual = float(np.percentile(finite, 98))
    hi = hi if hi <= 3 * usual else 1.5 * usual  # corners where a lens model runs away would drown all else
    return lo, max(hi, lo + max(abs(lo), 1e-12) * 1e-3)


def heat_map(
    values: Array,
    extent: tuple[float, float, float, float],
    title: str,
    unit: str,
    *,
    x_name: str = "u (px)",
    y_name: str = "v (px)",
    y_down: bool = True,
    diverging: bool = False,
    levels: Sequence[float] | None = None,
    limits: tuple[float, float] | None = None,
    equal: bool = True,
) -> str:
    """A quantity over a plane, with contour lines and a colour bar.

    values (rows, columns): at evenly spaced places from the first to the last of extent = (x_first, x_last, y_first,
    y_last), row 0 at y_first; nan where there is none (hatched). levels: of the contours; None: round ones. limits:
    of the colours; None: of the values. equal: one unit is as long in x as in y.
    """
    values = np.asarray(values, dtype=float)
    lo, hi = limits or value_range(values, diverging)
    x0, x1, y0, y1 = extent
    p = plane((x0, x1), (y0, y1), equal=equal, y_down=y_down, right=_RIGHT)
    out = axes(p, title, x_name, y_name, grid=False)
    left, top, wide, high = p.box
    out.append(_hatched(left, top, wide, high))
    smooth = _enlarged(values if y_down else values[::-1])
    rgb = colours((smooth - lo) / (hi - lo), diverging)
    alpha = np.where(np.isfinite(smooth), 255, 0).astype(np.uint8)
    done, data = cv2.imencode(".png", np.dstack([rgb[..., ::-1], alpha]), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not done:
        raise ValueError(f"a map of shape {values.shape} cannot be written as PNG")
    box = f'x="{left:.1f}" y="{top:.1f}" width="{wide:.1f}" height="{high:.1f}"'
    out.append(f'<image {box} preserveAspectRatio="none" href="{picture_uri(data.tobytes(), "png")}"/>')
    marks = np.asarray(levels, dtype=float) if levels is not None else contour_levels(lo, hi)
    grid_x, grid_y = np.linspace(x0, x1, values.shape[1]), np.linspace(y0, y1, values.shape[0])
    for level, words in zip(marks, [number(m) for m in marks.tolist()], strict=True):
        starts, ends = contour(values, grid_x, grid_y, float(level))
        if not len(starts):
            continue
        d = segments(p.at(starts), p.at(ends))
        out.append(f'<path d="{d}" stroke="#000" stroke-opacity="0.35" stroke-width="2.4" fill="none"/>')
        out.append(f'<path d="{d}" stroke="#fff" stroke-width="1.1" fill="none"/>')
        if place := _label_place(p, starts):
            style = "fill:#fff;font-weight:600;paint-order:stroke;stroke:#000a;stroke-width:2.6px"
            out.append(text(place[0], place[1] + 3.5, words, "mid", style))
    finite = values[np.isfinite(values)]
    out.append(colour_bar(p, lo, hi, unit, diverging))
    if finite.size:
        spread = f"{number(float(finite.min()))} to {number(float(finite.max()))} {unit},"
        note = f"{spread} median {number(float(np.median(finite)))}"
        out.append(foot(p, note))
    return svg_of(p, title, [*out, frame(p)])


def contour_levels(lo: float, hi: float) -> Array:
    """Round levels: evenly spaced, or 1, 2, 5, 10 ... where the values span more than a factor of 6.

    An uncertainty grows steeply towards the corners: with even levels the whole usable part would lie inside the first.
    """
    if lo > 0 and hi > 6 * lo:
        powers = 10.0 ** np.arange(np.floor(np.log10(lo)), np.ceil(np.log10(hi)) + 1)
        steps = (powers[:, None] * [1, 2, 5]).ravel()
        return steps[(steps > lo) & (steps < hi)]
    return ticks(lo, hi, 5)


def contour(values: Array, x: Array, y: Array, level: float) -> tuple[Array, Array]:
    """Where a surface has a level: line pieces from (n, 2) to (n, 2) by marching squares, one or two per cell.

    values (rows, columns) over y (rows,) and x (columns,). Cells with a nan have none; a saddle is cut by its mean.
    """
    a, b, c, d = values[:-1, :-1], values[:-1, 1:], values[1:, 1:], values[1:, :-1]  # round the cell
    with np.errstate(invalid="ignore", divide="ignore"):
        sides = [  # where the level crosses each side, nan where it does not
            _crossing(a, b, level),
            _crossing(b, c, level),
            _crossing(d, c, level),
            _crossing(a, d, level),
        ]
    X0, Y0 = np.meshgrid(x[:-1], y[:-1])
    X1, Y1 = np.meshgrid(x[1:], y[1:])
    finite = np.isfinite(a + b + c + d)
    places = [
        np.stack([X0 + sides[0] * (X1 - X0), Y0], axis=-1),
        np.stack([X1, Y0 + sides[1] * (Y1 - Y0)], axis=-1),
        np.stack([X0 + sides[2] * (X1 - X0), Y1], axis=-1),
        np.stack([X0, Y0 + sides[3] * (Y1 - Y0)], axis=-1),
    ]
    crossed = np.stack([np.isfinite(s) & finite for s in sides], axis=-1)
    n = crossed.sum(axis=-1)
    starts, ends = [], []
    for i in range(4):
        for k in range(i + 1, 4):
            pair = crossed[..., i] & crossed[..., k] & (n == 2)
            starts.append(places[i][pair])
            ends.append(places[k][pair])
    saddle = n == 4
    with np.errstate(invalid="ignore"):
        joined = ((a + b + c + d) / 4 > level) == (a > level)  # then b and d stand alone
    for where, pairs in ((saddle & joined, ((0, 1), (2, 3))), (saddle & ~joined, ((0, 3), (1, 2)))):
        for i, k in pairs:
            starts.append(places[i][where])
            ends.append(places[k][where])
    return np.concatenate(starts), np.concatenate(ends)


def _crossing(a: Array, b: Array, level: float) -> Array:
    return np.where((a > level) != (b > level), (level - a) / (b - a), np.nan)


def flatness_map(
    xy_m: Array,
    deviation_m: Array,
    title: str = "Flatness: height above the best plane",
    *,
    size_m: tuple[float, float] | None = None,
    bow: tuple[float, float, float] | None = None,
    sigma_m: float | None = None,
) -> str:
    """How far points of a screen lie from its plane, in mm.

    xy_m (n, 2), m, in the screen frame; deviation_m (n,), m, along its normal. bow: a, b, c, 1/m, of the surface
    z = a x^2 + b x y + c y^2, drawn beneath the points (its mean taken off, as from the points). sigma_m: of one point.
    """
    xy, mm = np.asarray(xy_m, dtype=float), 1e3 * np.asarray(deviation_m, dtype=float)
    good = np.isfinite(xy).all(axis=1) & np.isfinite(mm)
    xy, mm = xy[good], mm[good]
    lo, hi = (xy.min(axis=0), xy.max(axis=0)) if len(xy) else (-np.ones(2), np.ones(2))
    pad = 0.05 * np.maximum(hi - lo, 1e-3).max()
    lo, hi = lo - pad, hi + pad
    if size_m is not None:
        half = np.array(size_m) / 2
        lo, hi = np.minimum(lo, -half), np.maximum(hi, half)
    p = plane((lo[0], hi[0]), (lo[1], hi[1]), equal=True, right=_RIGHT)
    limits = value_range(mm, True)
    out = axes(p, title, "x of the screen (m)", "y of the screen (m)")
    if bow is not None:
        a, b, c = bow
        X, Y = np.meshgrid(np.linspace(lo[0], hi[0], 60), np.linspace(lo[1], hi[1], 45))
        offset = float(np.mean(a * xy[:, 0] ** 2 + b * xy[:, 0] * xy[:, 1] + c * xy[:, 1] ** 2)) if len(xy) else 0.0
        surface = 1e3 * (a * X**2 + b * X * Y + c * Y**2 - offset)
        for level in ticks(limits[0], limits[1], 7):
            starts, ends = contour(surface, X[0], Y[:, 0], float(level))
            if len(starts):
                d = segments(p.at(starts), p.at(ends))
                out.append(f'<path d="{d}" stroke="var(--soft)" stroke-width="1" stroke-dasharray="4 3" fill="none"/>')
                if place := _label_place(p, starts):
                    out.append(text(place[0], place[1] - 2, number(float(level)), "mid"))
    if size_m is not None:
        corner, opposite = p.at(-half).tolist(), p.at(half).tolist()
        x, y = corner[0], opposite[1]
        edge = f'x="{x:.1f}" y="{y:.1f}" width="{opposite[0] - x:.1f}" height="{corner[1] - y:.1f}"'
        out.append(f'<rect {edge} fill="none" stroke="var(--ink)" stroke-width="1.2"/>')
    radius = float(np.clip(90 / np.sqrt(max(len(xy), 1)), 1.6, 7))
    step = max(1, -(-len(xy) // 6000))
    fills = colours((mm[::step] - limits[0]) / (limits[1] - limits[0]), True)
    keys = (fills // 8 * 8).astype(np.int64) @ np.array([65536, 256, 1])  # few colours, one path each
    places = p.at(xy[::step])
    for key in np.unique(keys):
        some = keys == key
        fill = hex_colour(fills[some][0])
        out.append(f'<path d="{dots(places[some], radius)}" fill="{fill}" stroke="var(--ink)" stroke-width="0.35"/>')
    out.append(colour_bar(p, *limits, "mm", True))
    if len(mm):
        note = f"{len(mm)} points, RMS {number(float(np.sqrt(np.mean(mm**2))))} mm,"
        note += f" largest {number(float(mm[np.argmax(np.abs(mm))]))} mm"
        if sigma_m is not None:
            note += f"; sigma of one point {number(1e3 * sigma_m)} mm"
        if bow is not None:
            note += "; dashed: the bow"
        out.append(foot(p, note))
    return svg_of(p, title, [*out, frame(p)])


def correlation_matrix(names: Sequence[str], covariance: Array, title: str = "Correlations of the parameters") -> str:
    """Correlations from a covariance (n, n), as coloured squares. Rows with no variance stay grey. 60 names at most."""
    matrix = np.asarray(covariance, dtype=float)
    if len(names) > 60:
        names, matrix = names[:60], matrix[:60, :60]
        title += " (the first 60)"
    n = len(names)
    sigma = np.sqrt(np.maximum(np.diag(matrix), 0))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = matrix / sigma[:, None] / sigma[None, :]
    left, top = min(28 + 6.0 * max((len(w) for w in names), default=0), 190.0), 24.0
    side = min(26.0, (540 - left - _RIGHT) / max(n, 1))
    wide = side * n
    p = Plane(Scale(0, n, left, left + wide), Scale(0, n, top, top + wide), 540, top + wide + left - 16)
    out = [text(8, 15, title, "title")]
    size = f"font-size:{min(11.0, max(side * 0.95, 5.0)):.1f}px"
    for i, name in enumerate(names):
        middle = top + (i + 0.5) * side
        out.append(text(left - 5, middle + 0.33 * min(11, side), name, "end", size))
        x = left + (i + 0.5) * side
        turned = f'transform="translate({x + 3:.1f} {top + wide + 6:.1f}) rotate(-90)"'
        out.append(f"<g {turned}>{text(0, 0, name, 'end', size)}</g>")
        for k in range(n):
            r = correlation[i, k]
            fill = hex_colour(colours(np.array((r + 1) / 2), True)) if np.isfinite(r) else "var(--line)"
            place = f'x="{left + k * side:.1f}" y="{top + i * side:.1f}" width="{side:.1f}" height="{side:.1f}"'
            told = f"{name}, {names[k]}: {r:.2f}" if np.isfinite(r) else f"{name}, {names[k]}: fixed"
            out.append(f'<rect {place} fill="{fill}"><title>{escape(told)}</title></rect>')
            if n <= 20 and np.isfinite(r) and i != k and abs(r) >= 0.1:
                ink = "#fff" if abs(r) > 0.72 else "#1c2126"
                digits = f"{abs(r):.2f}"[1:] if abs(r) < 0.995 else "1"
                words = ("−" if r < 0 else "") + digits
                style = f"font-size:{side * 0.4:.1f}px;fill:{ink}"
                out.append(text(left + (k + 0.5) * side, middle + side * 0.14, words, "mid", style))
    if n:
        out.append(colour_bar(p, -1.0, 1.0, "", True))
    return svg_of(p, title, out)


def colour_bar(p: Plane, lo: float, hi: float, unit: str, diverging: bool) -> str:
    """The colours with their values, right of the axes."""
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


def _enlarged(values: Array) -> Array:
    """The map at 160 columns or more, smooth between its places; nan stay."""
    rows, columns = values.shape
    times = max(1, -(-160 // columns))
    # Sampled so that the first and the last value lie on the edges, as the extent says.
    across = np.linspace(0, columns - 1, min(columns * times, 320), dtype=np.float32)
    down = np.linspace(0, rows - 1, min(rows * times, 320), dtype=np.float32)
    map_x, map_y = np.meshgrid(across, down)
    filled = np.where(np.isfinite(values), values, 0.0).astype(np.float32)
    weight = np.isfinite(values).astype(np.float32)
    smooth = cv2.remap(filled, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    known = cv2.remap(weight, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.where(known > 0.5, smooth / np.maximum(known, 1e-3), np.nan).astype(float)


def _hatched(left: float, top: float, wide: float, high: float) -> str:
    """Slanted lines over an area: what shows where a map has no value."""
    out, step = [], 9.0
    for s in np.arange(step, wide + high, step):
        x0, y0 = (left + s, top) if s <= wide else (left + wide, top + s - wide)
        x1, y1 = (left, top + s) if s <= high else (left + s - high, top + high)
        out.append(f"M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}")
    return f'<path class="grid" d="{"".join(out)}"/>'


def _label_place(p: Plane, places: Array) -> tuple[float, float] | None:
    """A place on a contour for its number: the one nearest the drawing's diagonal, so that the labels spread.

    None where all of it lies at the edge: a number there would stand outside.
    """
    at = p.at(places)
    left, top, wide, high = p.box
    middle, room = np.array([left + wide / 2, top + high / 2]), np.array([wide / 2 - 16, high / 2 - 9])
    at = at[(np.abs(at - middle) < room).all(axis=1)]
    if not len(at):
        return None
    off = np.abs((at[:, 0] - left) / wide - (at[:, 1] - top) / high)
    x, y = at[int(np.argmin(off))].tolist()
    return x, y
