"""Drawings over a camera's image: board corners, residuals, coverage; and the tilt of the boards.

Every function returns one `<svg>` as text, 540 units wide: half a page. Pixels as in OpenCV: (0, 0) is the centre of
the top-left pixel.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from geometry.arrays import Array, Bools
from lab.report.plot import svg

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
        kept = np.union1d(np.linspace(0, len(found) - 1, _MOST_VECTORS).astype(np.int64), largest)
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
    """The photograph inside the axes, as JPEG."""
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
