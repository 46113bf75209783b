"""SVG of the reports: elements, scales, areas with axes, histograms, long series reduced to what a screen shows.

Embedded images: grey values brought to eight bits and encoded.
"""

from __future__ import annotations

import base64
import datetime
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools, Ints, true_ranges
from lab.pictures.opencv import load_cv2
from tracking.statuses import PoseStatus, SpotStatus

# Long series reduced to what a screen can show, without losing extremes or gaps.


def envelope(x: Array, y: Array, bins: int) -> tuple[Array, Array]:
    """A line of n points reduced to at most 2 * bins points that draws the same.

    Keeps the smallest and the largest value of each bin, in their order, so that no spike is lost. A bin without a
    finite value stays a gap.
    """
    n = len(x)
    if n <= 2 * bins:
        return x, y
    per_bin = -(-n // bins)
    padded = np.full(per_bin * bins, np.nan)
    padded[:n] = y
    block = padded.reshape(bins, per_bin)
    low = np.argmin(np.where(np.isnan(block), np.inf, block), axis=1)
    high = np.argmax(np.where(np.isnan(block), -np.inf, block), axis=1)
    order = np.sort(np.stack([low, high], -1), axis=1) + per_bin * np.arange(bins)[:, None]
    at = np.minimum(order.ravel(), n - 1)
    return x[at], padded[order.ravel()]


def band_envelope(x: Array, low: Array, high: Array, bins: int) -> tuple[Array, Array, Array]:
    """A band of n points reduced to at most `bins` points: the smallest low and the largest high of each bin."""
    n = len(x)
    if n <= bins:
        return x, low, high
    starts = np.arange(0, n, -(-n // bins))
    lows = np.minimum.reduceat(np.where(np.isnan(low), np.inf, low), starts)
    highs = np.maximum.reduceat(np.where(np.isnan(high), -np.inf, high), starts)
    return x[starts], np.where(np.isinf(lows), np.nan, lows), np.where(np.isinf(highs), np.nan, highs)


def true_shares(mask: Bools, n_columns: int) -> list[tuple[float, float]]:
    """The runs of True in (n,) as shares 0..1 of the length; runs within one of the n columns are joined."""
    n = len(mask)
    if n > n_columns:
        column = np.arange(n) * n_columns // n
        mask = np.bincount(column, weights=mask.astype(float), minlength=n_columns) > 0
        n = n_columns
    return [(start / n, stop / n) for start, stop in true_ranges(mask)]


# Elements of a plot in SVG text: colours, text, lines, areas, dots and embedded images.
#
# Coordinates are viewBox units, about one screen pixel each. Plots are written as text because importing matplotlib
# takes 0.33 s of process time, as long as the whole report of a usual run (docs/decisions/figures.md).

Box: TypeAlias = tuple[float, float, float, float]  # left, top, right, bottom
_MOST_NAMES = 60  # in a drawing
_NAME_SHIFTS = (-6, 12, -20, 26, -34, 40, -48, 54)  # of a name's base line from its thing, in order


# The palette of Okabe & Ito: distinct with any kind of colour vision.
BLUE, ORANGE, GREEN, VERMILLION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PURPLE, SKY, YELLOW, GREY = "#CC79A7", "#56B4E9", "#F0E442", "#8a8f98"
INK = "var(--ink)"  # the page's text colour
SPOT_COLOURS = {
    SpotStatus.MATCHED: GREEN,
    SpotStatus.TURNED: PURPLE,
    SpotStatus.OCCLUDED: ORANGE,
    SpotStatus.OUT_OF_VIEW: SKY,
    SpotStatus.OFF_SCREEN: BLUE,
    SpotStatus.NO_IMAGE: GREY,
    SpotStatus.LOST: VERMILLION,
}
POSE_COLOURS = {
    PoseStatus.MEASURED: GREEN,
    PoseStatus.PREDICTED: ORANGE,
    PoseStatus.LOST: VERMILLION,
}


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


def free_box(boxes: Iterable[Box], taken: list[Box]) -> Box | None:
    """The first of some boxes that covers none of the boxes `taken`, to which it is added; None without one."""
    for box in boxes:
        if not any(box[0] < t[2] and box[2] > t[0] and box[1] < t[3] and box[3] > t[1] for t in taken):
            taken.append(box)
            return box
    return None


def names(labels: Sequence[tuple[float, float, str]], p: PlotArea) -> list[str]:
    """Names (x, y, words) beside their things, shifted up or down so that none overlap.

    A name without a free place is left out.
    """
    out: list[str] = []
    taken: list[Box] = []
    for x, y, words in labels[:_MOST_NAMES]:
        wide = 7.5 * len(words) + 4
        start = min(x + 7, p.width - wide - 4)
        places = ((start, y + shift - 11, start + wide, y + shift + 3) for shift in _NAME_SHIFTS)
        box = free_box((b for b in places if b[1] >= 18 and b[3] <= p.height - 4), taken)
        if box is not None:
            out.append(text(box[0], box[3] - 3, words, "label"))
    return out


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


# Scales: linear maps from values to drawing coordinates, ranges, ticks and their labels.


@dataclass(frozen=True, slots=True)
class Scale:
    """A linear map from values lo..hi to drawing coordinates a..b."""

    lo: float
    hi: float
    a: float
    b: float

    def __call__(self, values: Array) -> Array:
        """Drawing coordinates of values, any shape."""
        return self.a + (np.asarray(values, dtype=float) - self.lo) * (self.b - self.a) / (self.hi - self.lo)


def ticks(lo: float, hi: float, about: int) -> Array:
    """Round numbers between lo and hi, roughly `about` of them, in steps of 1, 2 or 5 times a power of ten."""
    raw = (hi - lo) / max(about, 1)
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * min((m for m in (1, 2, 5, 10) if m * power >= raw * 0.999), default=10)
    first = np.ceil(lo / step - 1e-9)
    return step * np.arange(first, np.floor(hi / step + 1e-9) + 1) + 0.0  # + 0.0: no negative zero


def tick_texts(values: Array) -> list[str]:
    """Labels of ticks, with as many decimals as are needed to distinguish them, and a true minus sign."""
    step = float(np.min(np.diff(values))) if len(values) > 1 else abs(float(values[0])) if len(values) else 1.0
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9))) if step > 0 else 0
    return [f"{0.0 if abs(v) < step / 2 else v:.{min(decimals, 9)}f}".replace("-", "\u2212") for v in values]


def number(value: float, digits: int = 3) -> str:
    """A number with at most `digits` significant digits, without trailing zeros, and a true minus sign."""
    return f"{value:.{digits}g}".replace("-", "\u2212")


def padded_range(values: Array) -> tuple[float, float]:
    """The range of the finite values with a small margin; never empty."""
    finite = values[np.isfinite(values)]
    lo, hi = (float(finite.min()), float(finite.max())) if finite.size else (-1.0, 1.0)
    pad = max(0.06 * (hi - lo), 1e-9, 1e-6 * abs(hi))
    return lo - pad, hi + pad


def robust_range(values: Array, at_least: float = 0.0) -> tuple[float, float]:
    """A range symmetric about zero that a few spikes do not widen.

    The whole range where it is below three times the 99th percentile; otherwise 1.6 times that percentile, and the plot
    must mark the values beyond.
    """
    size = np.abs(values[np.isfinite(values)])
    if not size.size:
        return -1.0, 1.0
    usual, largest = float(np.percentile(size, 99)), float(size.max())
    limit = max(largest * 1.08 if largest < 3 * usual else 1.6 * usual, at_least, 1e-9)
    return -limit, limit


def round_size(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is at most `value` (> 0): the length of a scale bar."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(m * power for m in (1, 2, 5) if m * power <= value * 1.0001))


# Plot areas with two axes: frame, grid, ticks with labels, names, title and footnote.


@dataclass(frozen=True, slots=True)
class PlotArea:
    """The scales of a drawing and its size. Coordinates are viewBox units."""

    X: Scale
    Y: Scale
    width: float
    height: float

    def at(self, xy: Array) -> Array:
        """Drawing coordinates (..., 2) of values (..., 2)."""
        xy = np.asarray(xy, dtype=float)
        return np.stack([self.X(xy[..., 0]), self.Y(xy[..., 1])], axis=-1)

    @property
    def box(self) -> tuple[float, float, float, float]:
        """left, top, width, height of the area inside the axes."""
        left, top = min(self.X.a, self.X.b), min(self.Y.a, self.Y.b)
        return left, top, abs(self.X.b - self.X.a), abs(self.Y.b - self.Y.a)


def plot_area(
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    *,
    equal: bool = False,
    y_down: bool = False,
    width: float = 540,
    height: float = 300,
    right: float = 12,
    bottom: float = 52,
    tallest: float = 440,
) -> PlotArea:
    """A plot area for values in these ranges. equal: one unit has the same length in x and y, and the height follows.

    y_down: y grows downwards, as in images. `bottom` leaves room for tick labels, the name of the axis and a `note`.
    """
    left, top = 58.0, 24.0
    wide = width - left - right
    if equal:
        high = wide * (y_range[1] - y_range[0]) / (x_range[1] - x_range[0])
        if high > tallest:
            wide, high = wide * tallest / high, tallest
        height = top + high + bottom
    low, up = (top, height - bottom) if y_down else (height - bottom, top)
    return PlotArea(Scale(*x_range, left, left + wide), Scale(*y_range, low, up), width, height)


def image_area(size_px: tuple[int, int]) -> PlotArea:
    """A plot area for the pixels of an image, whose edges are at -0.5 and size - 0.5."""
    return plot_area((-0.5, size_px[0] - 0.5), (-0.5, size_px[1] - 0.5), equal=True, y_down=True)


def svg_of(p: PlotArea, title: str, parts: list[str]) -> str:
    """The drawing as an svg element with a name for screen readers."""
    return figure(p.width, p.height, title, parts, css="plot")


def axes(
    p: PlotArea,
    title: str,
    x_name: str,
    y_name: str,
    *,
    grid: bool = True,
    x_log: bool = False,
    y_log: bool = False,
) -> list[str]:
    """Title, ticks with labels, names of both axes; grid lines, or short ticks without `grid`.

    x_log, y_log: the scale is one of decimal logarithms.
    """
    left, top, wide, high = p.box
    x_range = min(p.X.lo, p.X.hi), max(p.X.lo, p.X.hi)
    y_range = min(p.Y.lo, p.Y.hi), max(p.Y.lo, p.Y.hi)
    xs = ticks(*x_range, max(3, int(wide / 75)))
    ys = ticks(*y_range, max(3, int(high / 45)))
    return [
        heading(p, title),
        x_ticks(p, *(log_ticks(*x_range) if x_log else (xs, tick_texts(xs))), grid=grid),
        y_ticks(p, *(log_ticks(*y_range) if y_log else (ys, tick_texts(ys))), grid=grid),
        text(left + wide / 2, top + high + 30, x_name, "mid"),
        vertical_text(12, top + high / 2, y_name),
    ]


def log_ticks(lo: float, hi: float) -> tuple[Array, list[str]]:
    """Ticks and labels between two decimal logarithms: powers of ten and, where there is room, numbers between."""
    steps = [1.0] if hi - lo > 3 else [1.0, 2.0, 5.0] if hi - lo > 0.6 else [1.0, 1.5, 2.0, *range(3, 10)]
    powers = 10.0 ** np.arange(np.floor(lo), np.ceil(hi) + 1)
    values = np.sort(np.outer(powers, steps).ravel())
    values = values[(np.log10(values) >= lo) & (np.log10(values) <= hi)]
    return np.log10(values), [f"{v:.4g}" if v < 8000 else f"{v:.0f}" for v in values.tolist()]


_DAYS = (1, 2, 5, 10)  # steps between ticks
_MONTHS = (1, 2, 3, 6, 12, 24, 60, 120, 240, 600, 1200, 2400, 6000, 12000)


def date_ticks(lo: float, hi: float, about: int = 6) -> tuple[Array, list[str]]:
    """Days (ordinals) between two ordinals, roughly `about` of them, and their labels: a day, a month or a year."""
    span = hi - lo
    first, last = (datetime.date.fromordinal(int(max(1, edge))) for edge in (np.ceil(lo), np.floor(hi)))
    for step in _DAYS:
        if span / step <= about + 1 and span < 60:
            start = -(-first.toordinal() // step) * step
            places = range(start, last.toordinal() + 1, step)
            return np.array(places, dtype=float), [datetime.date.fromordinal(p).isoformat() for p in places]
    months = next((m for m in _MONTHS if span / 30.4 / m <= about + 1), _MONTHS[-1])
    count = range(-(-(first.year * 12 + first.month - 1) // months) * months, last.year * 12 + last.month, months)
    begun = [datetime.date(m // 12, m % 12 + 1, 1) for m in count if m >= 12]
    begun = [day for day in begun if first <= day <= last]
    labels = [f"{day.year:04d}" if months >= 12 else f"{day:%Y-%m}" for day in begun]
    return np.array([day.toordinal() for day in begun], dtype=float), labels


def heading(p: PlotArea, title: str) -> str:
    """The title above the axes."""
    left, top, _, _ = p.box
    return text(left, top - 8, title, "title")


def x_ticks(p: PlotArea, values: Array, labels: Sequence[str], *, grid: bool = False) -> str:
    """Ticks of the x axis at values (n,), or grid lines, and their labels; an empty label is omitted."""
    _, top, _, high = p.box
    places = p.X(values).tolist()
    lines = "".join(f"M{x:.1f} {top:.1f}v{high:.1f}" if grid else f"M{x:.1f} {top + high:.1f}v4" for x in places)
    words = [text(x, top + high + 15, label, "mid") for x, label in zip(places, labels, strict=True) if label]
    return f'<path class="grid" d="{lines}"/>{"".join(words)}'


def y_ticks(p: PlotArea, values: Array, labels: Sequence[str], *, grid: bool = False) -> str:
    """Ticks of the y axis at values (n,), or grid lines, and their labels."""
    left, _, wide, _ = p.box
    places = p.Y(values).tolist()
    lines = "".join(f"M{left:.1f} {y:.1f}h{wide:.1f}" if grid else f"M{left - 4:.1f} {y:.1f}h4" for y in places)
    words = [text(left - 6, y + 3.5, label, "end") for y, label in zip(places, labels, strict=True)]
    return f'<path class="grid" d="{lines}"/>{"".join(words)}'


def note(p: PlotArea, words: str) -> str:
    """A footnote below the name of the x axis."""
    return text(p.box[0], p.height - 5, words, "", "font-size:10.5px")


def frame(p: PlotArea, closed: bool = True) -> str:
    """The edge of the plot area: all four sides, or the left and the bottom one."""
    left, top, wide, high = p.box
    d = f"M{left:.1f} {top:.1f}"
    d += f"h{wide:.1f}v{high:.1f}h{-wide:.1f}z" if closed else f"v{high:.1f}h{wide:.1f}"
    return f'<path class="frame" d="{d}"/>'


# Histograms, with the normal curve of a given sigma over them.


def histogram(
    values: Array,
    limits: tuple[float, float],
    title: str,
    x_name: str,
    *,
    sigma: float = 0.0,
    footnote: str = "",
    bins: int = 60,
    height: float = 240,
) -> str:
    """Counts of the finite values (any shape) between two limits.

    sigma: of a normal curve about zero with the area of all finite values, also those beyond the limits; 0: no curve.
    """
    values = np.asarray(values, dtype=float).ravel()
    values = values[np.isfinite(values)]
    edges = np.linspace(*limits, bins + 1)
    counts: Ints = np.histogram(values, edges)[0]
    middle, wide = (edges[1:] + edges[:-1]) / 2, edges[1] - edges[0]
    normal = np.zeros(bins)
    if sigma:
        normal = len(values) * wide * np.exp(-((middle / sigma) ** 2) / 2) / (sigma * np.sqrt(2 * np.pi))
    top = max(float(counts.max(initial=0)), float(normal.max(initial=0)), 1) * 1.06
    p = plot_area(limits, (0, top), height=height)
    bars = bar_path(p.X(edges), p.Y(counts.astype(float)), float(p.Y(np.array(0.0))))
    out = [*axes(p, title, x_name, "count"), f'<path d="{bars}" fill="{BLUE}" fill-opacity="0.7"/>']
    if sigma:
        d = line_path(p.X(middle), p.Y(normal))
        out.append(f'<path class="line ink" d="{d}" stroke-width="1.5" stroke-dasharray="5 3"/>')
    return svg_of(p, title, [*out, note(p, footnote), frame(p)])


Bytes: TypeAlias = NDArray[np.uint8]
GreyValues: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16] | Array  # whole numbers are faster
_JPEG_QUALITY = 72


def grey_limits(picture: GreyValues) -> tuple[float, float]:
    """The grey values shown as black and as white; white saturates in 3 of 10,000 pixels.

    They differ by at least eight times the spread of the background, so that an unlit image does not show as noise.
    """
    low, usual, high = _percentiles(picture, (1.0, 50.0, 99.97))
    return low, max(high, low + 8.0 * (usual - low), low + 8.0)


def _percentiles(picture: GreyValues, percent: Sequence[float]) -> list[float]:
    """As np.percentile; of whole numbers from their counts, which takes a tenth of the time."""
    if picture.dtype.kind != "u":
        return [float(p) for p in np.percentile(picture, percent)]
    up_to = np.cumsum(np.bincount(picture.ravel()))
    out = []
    for p in percent:
        at = p / 100 * (picture.size - 1)
        below, above = np.searchsorted(up_to, (np.floor(at), np.ceil(at)), side="right").tolist()
        out.append(below + (above - below) * (at - np.floor(at)))
    return out


def stretched(picture: GreyValues, low: float, high: float) -> Bytes:
    """Eight bits on a square-root scale: the background is just visible and not all spots saturate."""
    if picture.dtype.kind == "u":
        shades: Bytes = stretched(np.arange(256.0**picture.itemsize), low, high)
        return shades[picture]
    shares = np.clip((picture - low) / max(high - low, 1.0), 0.0, 1.0)
    return (255 * np.sqrt(shares)).astype(np.uint8)


def image_uri(picture: Bytes, kind: str) -> str:
    """Pixels (h, w), (h, w, 3) BGR or (h, w, 4) BGRA as a data URI; kind: png or jpeg.

    Raises ValueError: OpenCV cannot encode pixels of this shape.
    """
    cv2 = load_cv2()
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if kind == "jpeg" else [cv2.IMWRITE_PNG_COMPRESSION, 9]
    done, data = cv2.imencode(f".{kind}", picture, options)
    if not done:
        raise ValueError(f"an image of shape {picture.shape} cannot be written as {kind}")
    return picture_uri(data.tobytes(), kind)


def filled(p: PlotArea, uri: str) -> str:
    """An image, as a data URI, over the whole area inside the axes."""
    left, top, wide, high = p.box
    box = f'x="{left:.1f}" y="{top:.1f}" width="{wide:.1f}" height="{high:.1f}"'
    return f'<image {box} preserveAspectRatio="none" href="{uri}"/>'
