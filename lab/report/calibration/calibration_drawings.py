"""Drawings over a camera's image (corners, residuals, coverage, tilts), charts and maps of a calibration.

Every function returns one `<svg>` as text, 540 units wide: half a page. Pixels as in OpenCV: (0, 0) is the centre of
the top-left pixel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from html import escape

import cv2
import numpy as np

from geometry.arrays import Array, Bools, evenly_spread, robust_sigma
from lab.report.plot import svg
from lab.report.plot.maps import BAR_WIDTH, colour_bar, colours, contour_lines, hex_colour, label_place, value_range

_MOST_VECTORS = 2000  # in a residual field: more cover each other
_ARROW = 24.0  # drawing units: length of the 95th percentile of the residuals
_LONGEST = 70.0  # drawing units: longer vectors are cut
_CELLS = 12  # of the map of coverage, from left to right
_PICTURE_WIDTH = 720  # px of an embedded photograph


def corners_overlay(
    size_px: tuple[int, int],
    found_px: Array,
    residual_px: Array,
    title: str,
    *,
    picture: Array | np.ndarray | None = None,
    rejected: Bools | None = None,
    labels: Sequence[str] | None = None,
) -> str:
    """One view: its corners and their residuals, magnified.

    found_px, residual_px (n, 2), px: detected place of each corner, and detected minus model. picture (height, width)
    or (height, width, 3): the photograph, embedded beneath as a smaller JPEG. rejected (n,): corners that were not
    used. labels (n,): names of the corners, if any.
    """
    p = svg.image_area(size_px)
    out = svg.axes(p, title, "u (px)", "v (px)", grid=picture is None)
    if picture is not None:
        out.append(_photograph(p, np.asarray(picture)))
    found, residual = np.asarray(found_px, dtype=float), np.asarray(residual_px, dtype=float)
    bad = np.zeros(len(found), dtype=bool) if rejected is None else np.asarray(rejected, dtype=bool)
    stretch, bar = _magnification(residual[~bad])
    starts = p.at(found)
    ends = starts + _capped(residual * stretch)
    for colour, some, radius in ((svg.BLUE, ~bad, 2.2), (svg.VERMILLION, bad, 3.0)):
        vectors, places = svg.segments(starts[some], ends[some]), svg.dots(starts[some], radius)
        # A light line beneath keeps the coloured line visible on any photograph.
        out.append(f'<path d="{vectors}" stroke="#fff" stroke-width="3.4" stroke-opacity="0.75" fill="none"/>')
        out.append(f'<path d="{vectors}" stroke="{svg.ORANGE}" stroke-width="1.6" fill="none"/>')
        out.append(f'<path d="{places}" fill="{colour}" stroke="#fff" stroke-width="0.7"/>')
    for place, label in zip(starts.tolist(), labels or (), strict=labels is not None):
        out.append(svg.text(place[0] - 5, place[1] + 13, label, "end"))
    out.append(_scale_bar(p, stretch, bar))
    if bad.any():
        out.append(svg.note(p, f"{bad.sum()} corners not used (red); their vectors are cut"))
    return svg.svg_of(p, title, [*out, svg.frame(p)])


def residual_field(
    size_px: tuple[int, int],
    found_px: Array,
    residual_px: Array,
    title: str = "Residuals over the sensor, all views",
    *,
    things: str = "corners",
) -> str:
    """The residuals of all views over the sensor: single residuals faint, the mean of each cell bold.

    found_px, residual_px (n, 2), px. With a suitable lens model the means are about zero; means that vary
    systematically over the sensor show distortion that the model cannot describe. A mean is drawn where its cell, a
    sixteenth of the width, has 5 or more points. things: the name of the points in the text.
    """
    found, residual = np.asarray(found_px, dtype=float), np.asarray(residual_px, dtype=float)
    good = np.isfinite(found).all(axis=1) & np.isfinite(residual).all(axis=1)
    found, residual = found[good], residual[good]
    p = svg.image_area(size_px)
    out = svg.axes(p, title, "u (px)", "v (px)")
    if not len(found):
        return svg.svg_of(p, title, [*out, svg.frame(p), _in_the_middle(p, f"no {things}")])
    stretch, bar = _magnification(residual)
    kept = np.arange(len(found))
    if len(found) > _MOST_VECTORS:
        # Every k-th residual, and the largest ones, which the user must be able to see.
        largest = np.argsort(np.linalg.norm(residual, axis=1))[-_MOST_VECTORS // 10 :]
        kept = np.union1d(evenly_spread(np.arange(len(found)), _MOST_VECTORS), largest)
    starts = p.at(found)
    d = svg.segments(starts[kept], starts[kept] + _capped(residual[kept] * stretch))
    out.append(f'<path d="{d}" stroke="{svg.BLUE}" stroke-width="0.7" stroke-opacity="0.55" fill="none"/>')
    middle, mean, _ = cell_means(size_px, found, residual, 16)
    tips = p.at(middle) + mean * stretch * 2
    d = svg.segments(p.at(middle), tips)
    out.append(f'<path d="{d}" stroke="var(--paper)" stroke-width="4" fill="none"/>')
    out.append(f'<path d="{d}" stroke="{svg.VERMILLION}" stroke-width="2" stroke-linecap="round" fill="none"/>')
    out.append(f'<path d="{svg.dots(p.at(middle), 1.7)}" fill="{svg.VERMILLION}"/>')
    out.append(_scale_bar(p, stretch, bar))
    counted = f"{len(found)} {things}" + (f", {len(kept)} drawn" if len(kept) < len(found) else "")
    out.append(svg.note(p, f"blue: {counted}; red: mean of a cell, twice as long"))
    return svg.svg_of(p, title, [*out, svg.frame(p)])


def cell_means(
    size_px: tuple[int, int], places_px: Array, values: Array, cells: int, at_least: int = 5
) -> tuple[Array, Array, Array]:
    """Centres (m, 2), means (m, k) and counts (m,) of the square cells of a sensor with enough of the values (n, k)."""
    side = size_px[0] / cells
    column = np.clip((places_px[:, 0] + 0.5) // side, 0, cells - 1).astype(np.int64)
    rows = max(1, round(size_px[1] / side))
    row = np.clip((places_px[:, 1] + 0.5) // (size_px[1] / rows), 0, rows - 1).astype(np.int64)
    cell = row * cells + column
    count = np.bincount(cell, minlength=rows * cells)
    sums = np.stack([np.bincount(cell, values[:, k], rows * cells) for k in range(values.shape[1])], axis=1)
    held = np.flatnonzero(count >= at_least)
    middle = np.stack([(held % cells + 0.5) * side - 0.5, (held // cells + 0.5) * size_px[1] / rows - 0.5], axis=1)
    return middle, sums[held] / np.maximum(count[held, None], 1), count[held].astype(float)


def coverage_map(
    size_px: tuple[int, int],
    corners_px: Array,
    title: str = "Where the sensor had corners",
    *,
    things: str = "corners",
    outlines_px: list[Array] | None = None,
) -> str:
    """Number of corners in each cell of the sensor; cells without any are crossed out.

    corners_px (n, 2), px, of all views. outlines_px: a closed outline (k, 2) per view, drawn thin (60 at most).
    things: the name of the points in the text.
    """
    corners = np.asarray(corners_px, dtype=float)
    corners = corners[np.isfinite(corners).all(axis=1)]
    p = svg.image_area(size_px)
    out = svg.axes(p, title, "u (px)", "v (px)", grid=False)
    middle, _, count = cell_means(size_px, corners, np.zeros((len(corners), 1)), _CELLS, 0)
    side = np.array([size_px[0] / _CELLS, size_px[1] * _CELLS / len(count)])
    most = max(float(count.max()), 1.0)
    for (x, y), n in zip(middle.tolist(), count.tolist(), strict=True):
        left, top = p.at(np.array([x - side[0] / 2, y - side[1] / 2])).tolist()
        right, low = p.at(np.array([x + side[0] / 2, y + side[1] / 2])).tolist()
        box = f'x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" height="{low - top:.1f}"'
        if n:
            # The square root, so that a cell with 5 corners beside one with 500 does not look empty.
            out.append(f'<rect {box} fill="{svg.BLUE}" fill-opacity="{0.12 + 0.8 * np.sqrt(n / most):.2f}"/>')
        else:
            slope = f"M{left:.1f} {low:.1f}L{right:.1f} {top:.1f}M{left:.1f} {top:.1f}L{right:.1f} {low:.1f}"
            out.append(f'<path d="{slope}" stroke="{svg.VERMILLION}" stroke-width="1" stroke-opacity="0.8"/>')
        if n or most > 1:
            words = f"{n:.0f}"
            style = "font-size:9.5px;fill:#fff;paint-order:stroke;stroke:#0008;stroke-width:2px" if n else "fill:none"
            out.append(svg.text((left + right) / 2, (top + low) / 2 + 3.5, words, "mid", style))
    step = max(1, -(-len(outlines_px or []) // 60))
    for outline in (outlines_px or [])[::step]:
        d = svg.polyline(p.at(outline), closed=True)
        out.append(f'<path d="{d}" fill="none" stroke="{svg.ORANGE}" stroke-width="0.8" stroke-opacity="0.7"/>')
    share = float((count > 0).mean())
    words = f"{len(corners)} {things} in {100 * share:.0f} % of the cells of the sensor; crossed out: none"
    out.append(svg.note(p, words))
    return svg.svg_of(p, title, [*out, svg.frame(p)])


_WANTED_DEG = 20.0  # views of boards that are tilted less contribute little to the focal length


def tilt_polar(tilts_deg: Array, azimuths_deg: Array) -> str:
    """The tilt of the board in each view as a polar plot: radius the angle, direction the azimuth.

    tilts_deg (n,): angle between the normal of the board and the optical axis; azimuths_deg (n,): direction of the tilt
    from +u towards +v.
    """
    tilts, azimuths = np.asarray(tilts_deg, dtype=float), np.radians(np.asarray(azimuths_deg, dtype=float))
    finite = tilts[np.isfinite(tilts)]
    outer = max(60.0, float(finite.max()) * 1.05 if finite.size else 0.0)
    p = svg.PlotArea(svg.Scale(-outer, outer, 95, 445), svg.Scale(-outer, outer, 30, 380), 540, 412)
    title = "How the boards were tilted"
    out = [svg.text(58, 15, title, "title")]
    at = p.at(np.zeros(2))
    per_degree = 175 / outer
    for ring in range(20, int(outer) + 1, 20):
        out.append(
            f'<circle class="ring" cx="{at[0]}" cy="{at[1]}" r="{ring * per_degree:.1f}" fill="none"'
            f' stroke="var(--line)" stroke-width="0.8"/>'
        )
        out.append(svg.text(float(at[0]) + 3, float(at[1]) - ring * per_degree - 2, f"{ring}°"))
    few = f'r="{_WANTED_DEG * per_degree:.1f}" fill="{svg.ORANGE}" fill-opacity="0.16"'
    out.append(f'<circle cx="{at[0]}" cy="{at[1]}" {few}/>')
    out.append('<path class="grid" d="M95 205H445M270 30V380"/>')
    out += [svg.text(449, 209, "+u"), svg.text(270, 394, "+v", "mid")]
    places = p.at(np.stack([tilts * np.cos(azimuths), tilts * np.sin(azimuths)], axis=-1))
    style = f'fill="{svg.BLUE}" fill-opacity="0.75" stroke="var(--paper)" stroke-width="0.7"'
    out.append(f'<path d="{svg.dots(places, 3.6)}" {style}/>')
    tilted = int((finite > _WANTED_DEG).sum())
    out.append(svg.text(58, 408, f"{tilted} of {finite.size} views are tilted by more than {_WANTED_DEG:g}°"))
    return svg.svg_of(p, title, out)


def _magnification(residual: Array) -> tuple[float, float]:
    """Drawing units per px of residual, and the residual (px) that the scale bar shows."""
    size = np.linalg.norm(residual, axis=1)
    size = size[np.isfinite(size)]
    usual = max(float(np.percentile(size, 95)) if size.size else 0.0, 1e-6)
    return _ARROW / usual, svg.round_size(usual * 1.5)


def _capped(vectors: Array) -> Array:
    """Vectors (n, 2), drawing units, cut to the largest length, so that an outlier does not cross the whole plot."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors * np.minimum(1.0, _LONGEST / np.maximum(length, 1e-9))


def _scale_bar(p: svg.PlotArea, stretch: float, bar: float) -> str:
    left, top, wide, _ = p.box
    long = bar * stretch
    x, y = left + wide - 8, top - 8
    words = f"residual of {svg.number(bar)} px"
    line = f'<path d="M{x - long:.1f} {y:.1f}h{long:.1f}m0 -3v6m{-long:.1f} 0v-6"'
    line += f' stroke="{svg.INK}" stroke-width="1.3" fill="none"/>'
    return line + svg.text(x - long - 6, y + 4, words, "end")


def _photograph(p: svg.PlotArea, picture: np.ndarray) -> str:
    if picture.dtype != np.uint8:
        top = max(float(picture.max()), 1.0)
        picture = (picture.astype(float) * (255 / top)).astype(np.uint8)
    if picture.shape[1] > _PICTURE_WIDTH:
        shrink = _PICTURE_WIDTH / picture.shape[1]
        size = (_PICTURE_WIDTH, max(1, round(picture.shape[0] * shrink)))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return svg.filled(p, svg.image_uri(picture, "jpeg"))


def _in_the_middle(p: svg.PlotArea, words: str) -> str:
    left, top, wide, high = p.box
    return svg.text(left + wide / 2, top + high / 2, words, "mid")


# Charts of a calibration: histogram of residuals, comparison of lens models, drift over time.
#
# Maps of a calibration: flatness of a screen, correlations of parameters.


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
    p = svg.plot_area((lo[0], hi[0]), (lo[1], hi[1]), equal=True, right=BAR_WIDTH)
    limits = value_range(mm, True)
    out = svg.axes(p, title, "x of the screen (m)", "y of the screen (m)")
    if bow is not None:
        a, b, c = bow
        X, Y = np.meshgrid(np.linspace(lo[0], hi[0], 60), np.linspace(lo[1], hi[1], 45))
        offset = float(np.mean(a * xy[:, 0] ** 2 + b * xy[:, 0] * xy[:, 1] + c * xy[:, 1] ** 2)) if len(xy) else 0.0
        surface = 1e3 * (a * X**2 + b * X * Y + c * Y**2 - offset)
        for level in svg.ticks(limits[0], limits[1], 7):
            lines = [p.at(line) for line in contour_lines(surface, X[0], Y[:, 0], float(level))]
            if lines:
                d = "".join(map(svg.polyline, lines))
                out.append(f'<path d="{d}" stroke="var(--soft)" stroke-width="1" stroke-dasharray="4 3" fill="none"/>')
                if place := label_place(p, lines):
                    out.append(svg.text(place[0], place[1] - 2, svg.number(float(level)), "mid"))
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
        out.append(
            f'<path d="{svg.dots(places[some], radius)}" fill="{fill}" stroke="var(--ink)" stroke-width="0.35"/>'
        )
    out.append(colour_bar(p, *limits, "mm", True))
    if len(mm):
        words = f"{len(mm)} points, RMS {svg.number(float(np.sqrt(np.mean(mm**2))))} mm,"
        words += f" largest {svg.number(float(mm[np.argmax(np.abs(mm))]))} mm"
        if sigma_m is not None:
            words += f"; sigma of one point {svg.number(1e3 * sigma_m)} mm"
        if bow is not None:
            words += "; dashed: the bow"
        out.append(svg.note(p, words))
    return svg.svg_of(p, title, [*out, svg.frame(p)])


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
    p = svg.PlotArea(svg.Scale(0, n, left, left + wide), svg.Scale(0, n, top, top + wide), 540, top + wide + left - 16)
    out = [svg.text(8, 15, title, "title")]
    size = f"font-size:{min(11.0, max(side * 0.95, 5.0)):.1f}px"
    for i, name in enumerate(names):
        middle = top + (i + 0.5) * side
        out.append(svg.text(left - 5, middle + 0.33 * min(11, side), name, "end", size))
        x = left + (i + 0.5) * side
        turned = f'transform="translate({x + 3:.1f} {top + wide + 6:.1f}) rotate(-90)"'
        out.append(f"<g {turned}>{svg.text(0, 0, name, 'end', size)}</g>")
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
                out.append(svg.text(left + (k + 0.5) * side, middle + side * 0.14, value, "mid", style))
    if n:
        out.append(colour_bar(p, -1.0, 1.0, "", True))
    return svg.svg_of(p, title, out)


SERIES = (svg.BLUE, svg.ORANGE, svg.GREEN, svg.PURPLE, svg.SKY, svg.VERMILLION)


def residual_histogram(
    residuals: Array, title: str = "Residuals against the normal curve", unit: str = "px", *, sigma: float | None = None
) -> str:
    """Counts of residuals (any shape; nan are omitted) within 5 sigma, and the normal curve of the same area.

    sigma: of the curve, in the residuals' unit: the assumed noise; None: the robust sigma of the residuals.
    """
    values = np.asarray(residuals, dtype=float).ravel()
    values = values[np.isfinite(values)]
    robust = float(robust_sigma(values)) if values.size else 1.0
    spread = max(sigma if sigma is not None else robust, 1e-12)
    beyond = int((np.abs(values) > 5 * spread).sum())
    rms = svg.number(float(np.sqrt(np.mean(values**2)))) if values.size else "–"
    words = f"{len(values)} values, RMS {rms} {unit}; curve: sigma {svg.number(float(spread))} {unit}"
    words += "" if sigma is None else f" (robust spread {svg.number(robust)})"
    words += f"; beyond 5 sigma: {beyond}" + (f" (normal: {5.7e-7 * len(values):.1g})" if beyond else "")
    limits = -5 * spread, 5 * spread
    return svg.histogram(values, limits, title, f"residual ({unit})", sigma=spread, footnote=words)


def lens_model_chart(
    names: Sequence[str],
    error_px: Array,
    chosen: int,
    *,
    noise_px: Array | None = None,
) -> str:
    """A bar per lens model: the expected error of its directions, px; the chosen model is marked.

    names, error_px (n,): nan where a fit failed. noise_px (n,): the part of the error from noise, drawn as ticks.
    """
    rms = np.asarray(error_px, dtype=float)
    finite = rms[np.isfinite(rms)]
    title = "Lens models: expected error of directions"
    # The bar of a model with a much larger error is cut and its number marked, so that the others stay readable.
    top = max(min(float(finite.max()), 4 * float(finite.min())) * 1.15 if finite.size else 1.0, 1e-9)
    row, left = 26.0, min(20 + 6.4 * max((len(n) for n in names), default=0), 200.0)
    low = 28 + row * len(names)
    p = svg.PlotArea(svg.Scale(0, top, left, 470), svg.Scale(0, len(names), 28, low), 540, low + 38)
    marks = svg.ticks(0, top, 6)
    out = [svg.text(8, 15, title, "title"), svg.x_ticks(p, marks, svg.tick_texts(marks), grid=True)]
    out.append(svg.text((left + 470) / 2, low + 30, "expected error (px)", "mid"))
    for i, name in enumerate(names):
        y = float(p.Y(np.array(i + 0.5)))
        bold = "font-weight:600;fill:var(--ink)" if i == chosen else ""
        out.append(svg.text(left - 6, y + 4, name, "end", bold))
        if not np.isfinite(rms[i]):
            out.append(svg.text(left + 6, y + 4, "did not fit"))
            continue
        long = float(p.X(np.array(min(rms[i], top)))) - left
        fill = svg.BLUE if i == chosen else svg.GREY
        out.append(
            f'<rect x="{left:.1f}" y="{y - 8:.1f}" width="{long:.1f}" height="16" fill="{fill}" fill-opacity="0.85">'
            f"<title>{escape(name)}: {rms[i]:.4g} px</title></rect>"
        )
        if noise_px is not None and np.isfinite(noise_px[i]):
            x = float(p.X(np.array(min(noise_px[i], top))))
            out.append(
                f'<path d="M{x:.1f} {y - 11:.1f}v22" stroke="{svg.ORANGE}" stroke-width="2.5">'
                f"<title>noise: {noise_px[i]:.4g} px</title></path>"
            )
        words = svg.number(float(rms[i])) + (" ✓" if i == chosen else "") + (" ▸" if rms[i] > top else "")
        out.append(svg.text(476, y + 4, words, "", bold))
    if noise_px is not None:
        out.append(svg.text(532, low + 30, "orange: noise", "end"))
    return svg.svg_of(p, title, [*out, svg.frame(p, closed=False)])


@dataclass(frozen=True, slots=True)
class DriftLine:
    """The drift of one camera, check by check."""

    dates: Sequence[date]
    values: Array  # (n,)
    sigmas: Array | None = None  # (n,)


def drift_chart(
    lines: Mapping[str, DriftLine],
    title: str = "Drift since the calibration",
    unit: str = "px",
    *,
    warn: float | None = None,
    fail: float | None = None,
    expires: date | None = None,
) -> str:
    """Drift of each camera over the days, with the limits and the day on which the calibration expires."""
    days = [d.toordinal() for line in lines.values() for d in line.dates]
    tops = [line.values + (0 if line.sigmas is None else line.sigmas) for line in lines.values()]
    top = float(np.nanmax(np.concatenate([*tops, np.array([fail or 0.0, warn or 0.0, 1e-6])])))
    today = max(days, default=date(2000, 1, 1).toordinal())
    first, last = min(days, default=today), today
    # The expiry is shown unless the axis would have to become three times as long.
    if expires is not None and expires.toordinal() <= last + max(2 * (last - first), 30):
        last = max(last, expires.toordinal())
    pad = max(0.03 * (last - first), 0.6)
    p = svg.plot_area((first - pad, last + pad), (0, top * 1.12), height=250)
    left, over, wide, high = p.box
    marks = svg.ticks(0, p.Y.hi, 5)
    out = [
        svg.heading(p, f"{title} ({unit})"),
        svg.y_ticks(p, marks, svg.tick_texts(marks), grid=True),
        svg.x_ticks(p, *svg.date_ticks(first - pad, last + pad, 4)),
    ]
    for limit, colour, words in ((warn, svg.ORANGE, "warning"), (fail, svg.VERMILLION, "not to be used")):
        if limit is not None:
            y = float(p.Y(np.array(limit)))
            out.append(
                f'<path d="M{left:.1f} {y:.1f}h{wide:.1f}" stroke="{colour}"'
                ' stroke-width="1.3" stroke-dasharray="6 3"/>'
            )
            # One label at each end: the limits are often too close for two lines of text.
            x, side = (left + 4, "") if limit == warn else (left + wide - 4, "end")
            out.append(svg.text(x, y - 4, f"{words} {svg.number(limit)}", side))
    if expires is not None and expires.toordinal() <= last:
        x = float(p.X(np.array(float(expires.toordinal()))))
        out.append(f'<path d="M{x:.1f} {over:.1f}v{high:.1f}" stroke="{svg.VERMILLION}" stroke-width="1.3"/>')
        out.append(svg.text(x - 4, over + high - 6, "expires", "end"))  # at the bottom, away from the limits
    at = left
    for i, (name, line) in enumerate(lines.items()):
        out += _drift_line(p, name, line, SERIES[i % len(SERIES)], at)
        at += 34 + 6.4 * len(name)
    return svg.svg_of(p, title, [*out, svg.frame(p)])


def _drift_line(p: svg.PlotArea, name: str, line: DriftLine, colour: str, legend_x: float) -> list[str]:
    """One camera's values over the days with their sigmas, and its entry in the legend."""
    order = np.argsort([d.toordinal() for d in line.dates], kind="stable")
    x = p.X(np.array([line.dates[k].toordinal() for k in order], dtype=float))
    v = np.asarray(line.values, dtype=float)[order]
    y = p.Y(v)
    out = [f'<path class="line" d="{svg.line_path(x, y)}" stroke="{colour}" stroke-width="1.6"/>']
    if line.sigmas is not None:
        s = np.asarray(line.sigmas, dtype=float)[order]
        low, up = p.Y(np.maximum(v - s, 0)), p.Y(v + s)
        d = "".join(f"M{a:.1f} {b:.1f}V{c:.1f}" for a, b, c in zip(x, low, up, strict=True) if np.isfinite(b + c))
        out.append(f'<path d="{d}" stroke="{colour}" stroke-width="1" stroke-opacity="0.7"/>')
    d = svg.dots(np.stack([x, y], axis=-1), 3)
    out.append(f'<path d="{d}" fill="{colour}" stroke="var(--paper)" stroke-width="0.7"/>')
    out.append(f'<path d="M{legend_x:.1f} {p.height - 6:.1f}h16" stroke="{colour}" stroke-width="3"/>')
    out.append(svg.text(legend_x + 20, p.height - 2, name))
    return out
