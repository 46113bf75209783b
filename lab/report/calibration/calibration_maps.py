"""Maps of a calibration: flatness of a screen, correlations of parameters."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from geometry.arrays import Array
from lab.report.plot.axes import (
    PlotArea,
    Scale,
    axes,
    dots,
    frame,
    note,
    number,
    plot_area,
    polyline,
    svg_of,
    text,
    ticks,
)
from lab.report.plot.maps import BAR_WIDTH, colour_bar, colours, contour_lines, hex_colour, label_place, value_range


def flatness_map(
    xy_m: Array,
    deviation_m: Array,
    title: str = "Flatness: height above the best plane",
    *,
    size_m: tuple[float, float] | None = None,
    bow: tuple[float, float, float] | None = None,
    sigma_m: float | None = None,
) -> str:
    """Distances of points of a screen from its plane, in mm.

    xy_m (n, 2), m, in the screen frame; deviation_m (n,), m, along its normal. bow: a, b, c, 1/m, of the surface
    z = a x^2 + b x y + c y^2, drawn beneath the points with the mean at the points subtracted. sigma_m: of one point.
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
    p = plot_area((lo[0], hi[0]), (lo[1], hi[1]), equal=True, right=BAR_WIDTH)
    limits = value_range(mm, True)
    out = axes(p, title, "x of the screen (m)", "y of the screen (m)")
    if bow is not None:
        a, b, c = bow
        X, Y = np.meshgrid(np.linspace(lo[0], hi[0], 60), np.linspace(lo[1], hi[1], 45))
        offset = float(np.mean(a * xy[:, 0] ** 2 + b * xy[:, 0] * xy[:, 1] + c * xy[:, 1] ** 2)) if len(xy) else 0.0
        surface = 1e3 * (a * X**2 + b * X * Y + c * Y**2 - offset)
        for level in ticks(limits[0], limits[1], 7):
            lines = [p.at(line) for line in contour_lines(surface, X[0], Y[:, 0], float(level))]
            if lines:
                d = "".join(map(polyline, lines))
                out.append(f'<path d="{d}" stroke="var(--soft)" stroke-width="1" stroke-dasharray="4 3" fill="none"/>')
                if place := label_place(p, lines):
                    out.append(text(place[0], place[1] - 2, number(float(level)), "mid"))
    if size_m is not None:
        corner, opposite = p.at(-half).tolist(), p.at(half).tolist()
        x, y = corner[0], opposite[1]
        edge = f'x="{x:.1f}" y="{y:.1f}" width="{opposite[0] - x:.1f}" height="{corner[1] - y:.1f}"'
        out.append(f'<rect {edge} fill="none" stroke="var(--ink)" stroke-width="1.2"/>')
    radius = float(np.clip(90 / np.sqrt(max(len(xy), 1)), 1.6, 7))
    step = max(1, -(-len(xy) // 6000))
    fills = colours((mm[::step] - limits[0]) / (limits[1] - limits[0]), True)
    keys = (fills // 8 * 8).astype(np.int64) @ np.array([65536, 256, 1])  # one path for each of a few colours
    places = p.at(xy[::step])
    for key in np.unique(keys):
        some = keys == key
        fill = hex_colour(fills[some][0])
        out.append(f'<path d="{dots(places[some], radius)}" fill="{fill}" stroke="var(--ink)" stroke-width="0.35"/>')
    out.append(colour_bar(p, *limits, "mm", True))
    if len(mm):
        words = f"{len(mm)} points, RMS {number(float(np.sqrt(np.mean(mm**2))))} mm,"
        words += f" largest {number(float(mm[np.argmax(np.abs(mm))]))} mm"
        if sigma_m is not None:
            words += f"; sigma of one point {number(1e3 * sigma_m)} mm"
        if bow is not None:
            words += "; dashed: the bow"
        out.append(note(p, words))
    return svg_of(p, title, [*out, frame(p)])


def correlation_matrix(names: Sequence[str], covariance: Array, title: str = "Correlations of the parameters") -> str:
    """Correlations from a covariance (n, n) as coloured squares, at most 60 names. Rows without variance stay grey."""
    matrix = np.asarray(covariance, dtype=float)
    if len(names) > 60:
        names, matrix = names[:60], matrix[:60, :60]
        title += " (the first 60)"
    n = len(names)
    sigma = np.sqrt(np.maximum(np.diag(matrix), 0))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = matrix / sigma[:, None] / sigma[None, :]
    left, top = min(28 + 6.0 * max((len(w) for w in names), default=0), 190.0), 24.0
    side = min(26.0, (540 - left - BAR_WIDTH) / max(n, 1))
    wide = side * n
    p = PlotArea(Scale(0, n, left, left + wide), Scale(0, n, top, top + wide), 540, top + wide + left - 16)
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
            words = f"{name}, {names[k]}: {r:.2f}" if np.isfinite(r) else f"{name}, {names[k]}: fixed"
            out.append(f'<rect {place} fill="{fill}"><title>{escape(words)}</title></rect>')
            if n <= 20 and np.isfinite(r) and i != k and abs(r) >= 0.1:
                ink = "#fff" if abs(r) > 0.72 else "#1c2126"
                digits = f"{abs(r):.2f}"[1:] if abs(r) < 0.995 else "1"
                value = ("−" if r < 0 else "") + digits
                style = f"font-size:{side * 0.4:.1f}px;fill:{ink}"
                out.append(text(left + (k + 0.5) * side, middle + side * 0.14, value, "mid", style))
    if n:
        out.append(colour_bar(p, -1.0, 1.0, "", True))
    return svg_of(p, title, out)
