"""Charts of spots and noise: histograms on a logarithmic axis, positions in the picture, variance over grey level.

Contact sheet: evenly spaced pictures with stretched contrast, and rings around the detected spots.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from geometry.arrays import Array, Bools
from lab.number_format import format_count, format_number
from lab.pictures.picture_file import GreyPicture
from lab.report.frames.canvas import PAPER, SOFT, Canvas, Pixels, ground, png, text_size, write
from lab.report.page import Page, PageDrawing, PageTable, Section, made_with, write_page
from lab.report.plot import svg
from lab.report.plot.series import Line, time_panel
from lab.runs.detect.picture_series import PictureSeries, SizeGroup
from tracking.detections import Detections
from tracking.noise_estimation.levels import LevelVariances, level_variances
from tracking.noise_estimation.photon_transfer import NoiseEstimate

MOST = 24  # pictures on a sheet
# Largest number of pictures, columns, and width of each picture, px.
_GRIDS = ((1, 1, 1280), (4, 2, 860), (9, 3, 600), (16, 4, 460), (24, 6, 320))
_STRIP = 22  # px, height of the strip above each picture, for its caption
_GAP = 8  # px, between pictures
_NUMBERED = 30  # spots per picture that get a number
_LARGEST_ZOOM = 8
_RING = (80, 200, 255)  # BGR
_TEXT = 12.0  # px, height of a line of text


@dataclass(frozen=True, slots=True)
class _Kept:
    frame: int
    picture: GreyPicture
    found: Detections
    numbered: frozenset[int]  # rows of the spots that get their number


@dataclass(slots=True)
class ContactSheet:
    """Selects evenly spaced pictures from all that are offered.

    total: number of pictures; None: unknown. Every second selected picture is then dropped whenever there are too many.
    """

    total: int | None
    _kept: dict[int, _Kept] = field(default_factory=dict)  # by index in the series
    _stride: int = 1

    def offer(self, index: int, frame: int, picture: GreyPicture, found: Detections, likeness: Array) -> None:
        """Offer the picture at this index of the series, from 0, with its detections and their likeness (n,)."""
        if self._selects(index):
            most_alike = np.argsort(-likeness, kind="stable")[:_NUMBERED]
            self._kept[index] = _Kept(frame, picture.copy(), found, frozenset(most_alike.tolist()))
        if len(self._kept) > MOST:
            self._stride *= 2
            self._kept = {k: kept for k, kept in self._kept.items() if k % self._stride == 0}

    def write(self, path: Path) -> None:
        """Write the sheet as a PNG file."""
        path.write_bytes(png(self.drawn()))

    def drawn(self) -> Pixels:
        """The sheet (h, w, 3), 8 bit, BGR."""
        kept = [self._kept[k] for k in sorted(self._kept)]
        columns, width = next((c, w) for most, c, w in _GRIDS if len(kept) <= most)
        columns = min(columns, max(len(kept), 1))
        height = round(width * max((k.picture.shape[0] / k.picture.shape[1] for k in kept), default=0.75))
        height = min(height, 2 * width)
        rows = -(-len(kept) // columns)
        across, down = width + _GAP, height + _STRIP + _GAP
        sheet = np.full((max(rows, 1) * down + _GAP, columns * across + _GAP, 3), PAPER, np.uint8)
        for i, one in enumerate(kept):
            top, left = _GAP + (i // columns) * down, _GAP + (i % columns) * across
            sheet[top : top + _STRIP + height, left : left + width] = _tile(one, width, height)
        return sheet

    def _selects(self, index: int) -> bool:
        if self.total is None or index >= self.total:
            return index % self._stride == 0
        # The k-th of m selected pictures of n has the index (n - 1) k / (m - 1), rounded: first and last are included.
        m = min(MOST, self.total)
        k = round(index * (m - 1) / max(self.total - 1, 1))
        return index == round(k * (self.total - 1) / max(m - 1, 1))


def _tile(one: _Kept, width: int, height: int) -> Pixels:
    """One picture with its caption above it, and rings around its spots; those most like a laser's have a number."""
    out: Pixels = np.full((_STRIP + height, width, 3), PAPER, np.uint8)
    spots = format_count(len(one.found), "spot")
    write(out, (2, 15), f"frame {one.frame}", _TEXT)
    write(out, (width - text_size(spots, _TEXT)[0] - 3, 15), spots, _TEXT, SOFT)
    h, w = one.picture.shape
    scale = min(width / w, height / h, _LARGEST_ZOOM)
    size = (max(round(w * scale), 1), max(round(h * scale), 1))
    grey = svg.stretched(one.picture, *svg.grey_limits(one.picture))
    canvas = Canvas(ground(grey, size, scale), np.array([-0.5, -0.5]), scale, 1.0)
    small = width < 400
    taken: list[svg.Box] = []
    for i, uv in enumerate(one.found.uv_px):
        major = float(one.found.major_px[i]) if np.isfinite(one.found.major_px[i]) else 1.0
        radius = max(3.5 * major * scale, 5.0 if small else 8.0)
        canvas.ring(uv, radius, _RING)
        if i in one.numbered:
            u, v = canvas.at(uv).tolist()
            canvas.label((u, v), radius + 2, str(i + 1), 10.0 if small else _TEXT, _RING, taken)
    left, top = (width - size[0]) // 2, _STRIP + (height - size[1]) // 2
    out[top : top + size[1], left : left + size[0]] = canvas.image
    return out


_BINS = 48
_MOST_DOTS = 6000
_COLOURS = (svg.BLUE, svg.ORANGE)


def counts_chart(series: Sequence[tuple[str, Array]], title: str, x_name: str, *, mark: float | None = None) -> str:
    """Histograms of positive values (n,) on a logarithmic axis, several series in one chart.

    mark: a value that is marked by a vertical line.
    """
    good = [(name, values[np.isfinite(values) & (values > 0)]) for name, values in series]
    everything = np.concatenate([v for _, v in good])
    if not everything.size:
        return ""
    low, high = np.percentile(everything, [0.1, 99.9])
    low, high = (min(low, mark), max(high, mark)) if mark is not None else (low, high)
    middle, half = 0.5 * np.log10(low * high), max(0.5 * np.log10(high / low), 0.1) * 1.08
    lo, hi = float(middle - half), float(middle + half)
    edges = np.linspace(lo, hi, _BINS + 1)
    counts = [np.histogram(np.clip(np.log10(v), lo, hi), edges)[0].astype(float) for _, v in good]
    p = svg.plot_area((lo, hi), (0.0, max(float(c.max()) for c in counts) * 1.08), height=250)
    base = float(p.Y(np.array(0.0)))
    out = svg.axes(p, title, x_name, "spots", x_log=True)
    for (name, _), count, colour in zip(good, counts, _COLOURS, strict=False):
        steps = "".join(f"V{y:.1f}H{x:.1f}" for y, x in zip(p.Y(count), p.X(edges[1:]), strict=True))
        d = f"M{float(p.X(edges[0])):.1f} {base:.1f}{steps}V{base:.1f}"
        out.append(f'<path d="{d}z" fill="{colour}" fill-opacity="0.3"/>')
        out.append(f'<path d="{d}" fill="none" stroke="{colour}" stroke-width="1.4"><title>{name}</title></path>')
    if mark is not None:
        x = float(p.X(np.log10(mark)))
        out.append(f'<path d="M{x:.1f} {base:.1f}V{p.box[1]:.1f}" stroke="{svg.VERMILLION}" stroke-dasharray="5 3"/>')
    right = p.box[0] + p.box[2]
    if len(good) > 1:
        for i, ((name, _), colour) in enumerate(zip(good, _COLOURS, strict=False)):
            out.append(svg.text(right - 8, p.box[1] + 14 + 15 * i, name, "end", f"fill:{colour};font-weight:600"))
    medians = "; ".join(f"{name}: median {format_number(float(np.median(v)))}" for name, v in good)
    out.append(svg.note(p, f"{len(good[0][1])} spots; {medians}"))
    return svg.svg_of(p, title, [*out, svg.frame(p)])


def places_chart(uv_px: Array, size_px: tuple[int, int]) -> str:
    """Positions of spots (n, 2) in the picture; evenly thinned if there are very many."""
    p = svg.image_area(size_px)
    shown = uv_px[:: max(1, -(-len(uv_px) // _MOST_DOTS))]
    out = svg.axes(p, "Positions of the spots", "u (px)", "v (px)", grid=False)
    out.append(
        f'<path d="{svg.dots(p.at(shown), 1.6 if len(shown) > 300 else 2.6)}" fill="{svg.BLUE}" fill-opacity="0.45"/>'
    )
    some = "" if len(shown) == len(uv_px) else f", {len(shown)} of them shown"
    out.append(svg.note(p, f"{len(uv_px)} spots{some}"))
    return svg.svg_of(p, "Positions of the spots", [*out, svg.frame(p)])


def noise_chart(estimate: NoiseEstimate, measured: LevelVariances | None, name: str) -> str:
    """Photon transfer: variance of a pixel over its grey level, measured and modelled with its 1-sigma band.

    Measured variances far above the model are drawn as triangles at the top.
    """
    model = estimate.model
    top = model.black_dn + 10.0
    if measured is not None and len(measured.level):
        top = max(top, float(measured.level.max()) * 1.05)
    bottom = min(0.0 if model.black_dn < 0.3 * top else model.black_dn, model.black_dn)
    if measured is not None and len(measured.level):
        bottom = min(bottom, float(measured.level.min()))
    level = np.linspace(bottom, top, 60)
    rise = np.maximum(level - model.black_dn, 0.0)
    spread = np.exp(np.array([-1.0, 1.0])[:, None] * np.array([estimate.floor_sigma, estimate.slope_sigma]))
    line = model.floor_dn2 + model.slope_dn * rise
    below, above = (model.floor_dn2 * f + model.slope_dn * s * rise for f, s in spread)
    highest = float(line.max()) * 1.3
    if measured is not None and len(measured.variance):
        # Variances far above the line come from light that changed between the pictures, such as spots that moved.
        highest = max(highest, float(np.minimum(measured.variance + measured.sigma, 2 * highest).max()) * 1.08)
    p = svg.plot_area((bottom, top), (0.0, highest), height=280)
    title = f"Variance of a pixel: {name}"
    out = svg.axes(p, title, "grey value (DN)", "variance (DN²)")
    x, y = p.at(np.stack([level, line], -1)).T
    band = svg.area_path(x, *(p.Y(np.minimum(edge, highest)) for edge in (below, above)))
    out.append(f'<path d="{band}" fill="{svg.BLUE}" fill-opacity="0.18"/>')
    out.append(f'<path class="line" d="{svg.line_path(x, y)}" stroke="{svg.BLUE}" stroke-width="1.5"/>')
    inside: Bools = np.ones(0, dtype=bool)
    if measured is not None and len(measured.level):
        ends = p.at(np.stack([measured.level, np.maximum(measured.variance - measured.sigma, 0.0)], -1))
        tops = p.at(np.stack([measured.level, np.minimum(measured.variance + measured.sigma, highest)], -1))
        inside = measured.variance <= highest
        ends, tops = ends[inside], tops[inside]
        whiskers = "".join(
            f"M{a:.1f} {b:.1f}V{c:.1f}" for (a, b), (_, c) in zip(ends.tolist(), tops.tolist(), strict=True)
        )
        out.append(f'<path d="{whiskers}" stroke="{svg.VERMILLION}" fill="none"/>')
        places = p.at(np.stack([measured.level, measured.variance], -1)[inside])
        above_all = p.at(np.stack([measured.level, np.full(len(measured.level), highest)], -1)[~inside])
        marks = "".join(f"M{x - 4:.1f} {y + 8:.1f}h8l-4 -7z" for x, y in above_all.tolist())
        out.append(f'<path d="{marks}" fill="none" stroke="{svg.VERMILLION}"/>' if marks else "")
        out.append(f'<path d="{svg.dots(places, 2.6)}" fill="{svg.VERMILLION}"/>')
    return svg.svg_of(p, title, [*out, svg.frame(p)])


# The page of `beampose detect`: contact sheet, spots over frames, positions, sizes, signal to noise, sensor noise.


_MOST_KINDS = 4  # kinds of pictures (size and depth) whose noise is drawn
_MOST_SPOTS = 20  # spots that look most like a laser's
_MOST_ROWS = 20  # kinds of pictures whose noise is listed


def write_detect_page(series: PictureSeries, sheet: ContactSheet, folder: Path) -> Path:
    """Write report.html into a folder. Returns its path."""
    table = series.spots.table()
    groups = sorted(series.groups.values(), key=lambda g: -g.pictures)
    sections = [
        _sheet(sheet),
        _spots(series, table),
        *([_most_alike(table), _places(table, groups)] if len(table) else []),
        _noise(series, groups),
    ]
    page = Page(
        "spots in pictures", series.camera, series.source, sections, _key_figures(series, table, groups), series.notes,
        _made(series),
    )  # fmt: skip
    return write_page(page, folder)


def _key_figures(series: PictureSeries, table: Array, groups: list[SizeGroup]) -> list[tuple[str, str, str]]:
    counts = np.array([n for _, n in series.spots.per_frame])
    bad = sum(map(len, series.unreadable.values()))
    each = f"{counts.min()} to {counts.max()}, median {np.median(counts):.0f}"
    figures = [
        ("Pictures", str(series.pictures), f"{bad} more cannot be read" if bad else groups[0].text()),
        ("Spots", str(series.spots.total), f"{each} in a picture" if series.pictures > 1 else "in the picture"),
    ]
    if len(table):
        size, ratio = (list(map(format_number, np.percentile(table[:, k], [5, 50, 95]))) for k in (3, 5))
        figures += [
            ("Size", f"{size[1]} px", f"1 sigma of the major axis; 90 %: {size[0]} to {size[2]}"),
            ("Signal to noise", ratio[1], f"matched filter, median; 90 %: {ratio[0]} to {ratio[2]}"),
        ]
    model = groups[0].noise.model
    if model is not None:
        floor = f"{format_number(math.sqrt(model.floor_dn2))} DN"
        figures.append(("Noise", floor, f"of a pixel at {format_number(model.black_dn)} DN"))
    return figures


def _sheet(sheet: ContactSheet) -> Section:
    picture = (
        f'<img src="{svg.image_uri(sheet.drawn(), "jpeg")}" alt="contact sheet: pictures with the spots found in them">'
    )
    caption = (
        "Evenly spaced pictures with stretched grey values. Rings: detected spots. The number is that of the row of"
        f" the frame in detections.csv, which are in the order of brightness; the {_NUMBERED} spots most like a laser's"
        " have one. Without compression loss: contact-sheet.png."
    )
    return Section("Contact sheet", (), [PageDrawing(picture, caption, wide=True)])


def _spots(series: PictureSeries, table: Array) -> Section:
    drawings = []
    if len(series.spots.per_frame) > 1:
        frame, count = np.array(series.spots.per_frame, dtype=float).T
        counts = time_panel(
            frame, "Spots in each picture", "", lines=(Line(count, svg.BLUE, "spots"),),
            y_range=(0.0, max(float(count.max()) * 1.1, 1.0)), width=1100, height=150, time_name="frame",
        )  # fmt: skip
        drawings.append(PageDrawing(counts, wide=True))
    if len(table):
        axes, ratio = [("major", table[:, 3]), ("minor", table[:, 4])], [("signal to noise", table[:, 5])]
        title, threshold = "Signal to noise behind a matched filter", series.parameters.threshold_sigma
        caption = (
            "Flux over its noise, with the noise of the background only. Spots below the threshold (dashed line) are"
            " not detected."
        )
        drawings += [
            PageDrawing(counts_chart(axes, "Sizes", "half axis, 1 sigma (px)")),
            PageDrawing(counts_chart(ratio, title, "ratio", mark=threshold), caption),
        ]
    description = (
        "Positions are centroids of the light."
        if series.spots.total
        else "No spot was found. Are the spots in the pictures? A lower threshold (--set detect.threshold_sigma=4)"
        " finds fainter spots, and more false ones."
    )
    return Section("Spots", description, drawings)


def _most_alike(table: Array) -> Section:
    """The spots that look most like a laser's: among many points of a room, the spot is one of the first."""
    best = table[np.argsort(-table[:, 7], kind="stable")[:_MOST_SPOTS]]
    heads = ("frame", "u (px)", "v (px)", "likeness", "signal to noise", "peak (DN)", "major (px)", "minor (px)")
    rows = [[int(row[0]), *row[[1, 2, 7, 5, 6, 3, 4]].tolist()] for row in best]
    description = (
        "Likeness, 0 to 1: how much of the light a round Gaussian explains, times the ratio of the axes, times the"
        " brightness of the core relative to that of a clipped pixel. All spots: detections.csv, column likeness."
    )
    return Section("Most like the spot of a laser", description, (), PageTable(heads, rows))


def _places(table: Array, groups: list[SizeGroup]) -> Section:
    width, height = (max(g.size_px[k] for g in groups) for k in (0, 1))
    description = (
        "All spots of all pictures. A spot that does not move while others do (a reflection, a hot pixel) appears as"
        " one dense dot."
    )
    return Section("Positions", description, [PageDrawing(places_chart(table[:, 1:3], (width, height)))])


def _noise(series: PictureSeries, groups: list[SizeGroup]) -> Section:
    known = [(g.text(), e, e.model) for g in groups[:_MOST_ROWS] if (e := g.noise.estimate) is not None]
    rows = [
        (
            name, e.pictures, "in time" if e.temporal else "within pictures", m.black_dn,
            _with_sigma(math.sqrt(m.floor_dn2), e.floor_sigma / 2), _with_sigma(1 / m.slope_dn, e.slope_sigma),
            m.correlation, math.sqrt(m.compression_dn2), 100 * m.texture,
            "not seen" if e.saturation_dn is None else e.saturation_dn, e.step_dn,
        )
        for name, e, m in known
    ]  # fmt: skip
    heads = (
        "pictures", "estimated from", "differences", "background (DN)", "noise there (DN)", "electrons per DN",
        "correlation of pixels", "by compression (DN)", "texture (%)", "clips at (DN)", "grey step (DN)",
    )  # fmt: skip
    drawings = []
    for g in groups[:_MOST_KINDS]:
        measured = _levels(series.noise_pictures.get((g.size_px, g.bits), []), g)
        if g.noise.estimate is not None:
            drawings.append(PageDrawing(noise_chart(g.noise.estimate, measured, g.text()), _caption(measured)))
    description = [
        "The variance of a pixel is a linear function of the light: its value at the background is read noise, rounding"
        " and the background's own shot noise; its slope is one over the electrons per grey value.",
        "Where the pictures have few bright and stationary regions, the slope is that of usual sensors, with a large"
        " sigma.",
    ]
    return Section("Noise of the sensor", description, drawings, PageTable(heads, rows))


def _caption(measured: LevelVariances | None) -> str:
    """Explains the dots and lines of a noise chart."""
    line = "Line: the model in use, with its 1-sigma band."
    if measured is None or not len(measured.level):
        return f"{line} No grey level has enough pixels for a measurement."
    how = "from differences in time" if measured.temporal else "within pictures"
    return f"{line} Dots: measured {how}; triangles: larger variances, where the light itself changed."


def _levels(pictures: list[GreyPicture], group: SizeGroup) -> LevelVariances | None:
    """The variances by grey level that the estimate was made from; None for small pictures."""
    estimate = group.noise.estimate
    if not pictures or estimate is None or min(pictures[0].shape) < 32:
        return None
    top = float(np.iinfo(pictures[0].dtype).max) if estimate.saturation_dn is None else estimate.saturation_dn
    return level_variances(pictures, top, estimate.step_dn**2 / 12)


def _with_sigma(value: float, relative: float) -> str:
    """A value with the sigma of its logarithm: as a factor if that is large, else as a percentage."""
    return (
        f"{format_number(value)} ×/÷ {math.exp(relative):.2f}"
        if relative > 0.15
        else f"{format_number(value)} ± {100 * relative:.0f} %"
    )


def _made(series: PictureSeries) -> list[tuple[str, str]]:
    p = series.parameters
    searched = f"threshold {p.threshold_sigma:g} sigma, at most {p.max_detections} spots in a picture"
    return [("detection", searched), made_with("numpy", "opencv-python-headless")]
