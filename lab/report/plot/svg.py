"""Small drawings in SVG text: axes, lines, bands, shading. Nothing is drawn point by point that a screen cannot show.

Drawn by hand rather than by matplotlib: importing that takes as long as the whole report of a usual run, and its SVG is
ten times the size. Coordinates of a drawing are its viewBox units, about one screen pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np

from geometry.arrays import Array, Bools, Ints
from lab.number_format import short

# Okabe & Ito's palette, told apart with any colour vision.
BLUE, ORANGE, GREEN, VERMILLION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PURPLE, SKY, YELLOW, GREY = "#CC79A7", "#56B4E9", "#F0E442", "#8a8f98"


@dataclass(frozen=True, slots=True)
class Scale:
    """A straight map from values lo..hi to drawing coordinates a..b."""

    lo: float
    hi: float
    a: float
    b: float

    def __call__(self, values: Array) -> Array:
        """Drawing coordinates of values, any shape."""
        return self.a + (np.asarray(values, dtype=float) - self.lo) * (self.b - self.a) / (self.hi - self.lo)


def ticks(lo: float, hi: float, about: int) -> Array:
    """Round numbers between lo and hi, about so many: steps of 1, 2 or 5 times a power of ten."""
    raw = (hi - lo) / max(about, 1)
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * min((m for m in (1, 2, 5, 10) if m * power >= raw * 0.999), default=10)
    first = np.ceil(lo / step - 1e-9)
    return step * np.arange(first, np.floor(hi / step + 1e-9) + 1) + 0.0  # and no minus nought


def tick_texts(values: Array) -> list[str]:
    """The labels of ticks: just the decimals that tell them apart, and a true minus sign."""
    step = float(np.min(np.diff(values))) if len(values) > 1 else abs(float(values[0])) if len(values) else 1.0
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9))) if step > 0 else 0
    return [f"{0.0 if abs(v) < step / 2 else v:.{min(decimals, 9)}f}".replace("-", "\u2212") for v in values]


def plain_range(values: Array, margin: float = 0.06) -> tuple[float, float]:
    """The range of the finite values, widened a little, and never empty."""
    finite = values[np.isfinite(values)]
    lo, hi = (float(finite.min()), float(finite.max())) if finite.size else (-1.0, 1.0)
    pad = max(margin * (hi - lo), 1e-9, 1e-6 * abs(hi))
    return lo - pad, hi + pad


def robust_range(values: Array, at_least: float = 0.0) -> tuple[float, float]:
    """A range about zero that shows the body of the values, not a few spikes: symmetric.

    The whole range where it is under three times the 99th percentile; otherwise 1.6 times that percentile, and who
    draws must mark what lies beyond.
    """
    size = np.abs(values[np.isfinite(values)])
    if not size.size:
        return -1.0, 1.0
    usual, largest = float(np.percentile(size, 99)), float(size.max())
    limit = max(largest * 1.08 if largest < 3 * usual else 1.6 * usual, at_least, 1e-9)
    return -limit, limit


def envelope(x: Array, y: Array, bins: int) -> tuple[Array, Array]:
    """A line of n points thinned to at most 2 * bins that looks the same.

    Of each bin its least and greatest value remain, in order, so no spike is lost. A bin without a finite value stays a
    gap.
    """
    n = len(x)
    if n <= 2 * bins:
        return x, y
    wide = -(-n // bins)
    padded = np.full(wide * bins, np.nan)
    padded[:n] = y
    block = padded.reshape(bins, wide)
    low = np.argmin(np.where(np.isnan(block), np.inf, block), axis=1)
    high = np.argmax(np.where(np.isnan(block), -np.inf, block), axis=1)
    order = np.sort(np.stack([low, high], -1), axis=1) + wide * np.arange(bins)[:, None]
    at = np.minimum(order.ravel(), n - 1)
    return x[at], padded[order.ravel()]


def band_envelope(x: Array, low: Array, high: Array, bins: int) -> tuple[Array, Array, Array]:
    """A band of n points thinned to at most `bins`: each bin's least low and greatest high."""
    n = len(x)
    if n <= bins:
        return x, low, high
    starts = np.arange(0, n, -(-n // bins))
    lows = np.minimum.reduceat(np.where(np.isnan(low), np.inf, low), starts)
    highs = np.maximum.reduceat(np.where(np.isnan(high), -np.inf, high), starts)
    return x[starts], np.where(np.isinf(lows), np.nan, lows), np.where(np.isinf(highs), np.nan, highs)


def runs(mask: Bools) -> list[tuple[int, int]]:
    """First and one past the last index of each stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(mask, dtype=np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def line_path(x: Array, y: Array) -> str:
    """The `d` of a path through drawing coordinates, broken where one is nan; a lone point becomes a dot."""
    parts = []
    for start, stop in runs(np.isfinite(x) & np.isfinite(y)):
        points = " ".join(map("%.1f %.1f".__mod__, zip(x[start:stop].tolist(), y[start:stop].tolist(), strict=True)))
        parts.append(f"M{points}" if stop - start > 1 else f"M{points}h0")
    return "".join(parts)


def area_path(x: Array, low: Array, high: Array) -> str:
    """The `d` of the area between two lines in drawing coordinates, broken where one is nan."""
    parts = []
    for start, stop in runs(np.isfinite(low) & np.isfinite(high)):
        xs = np.concatenate([x[start:stop], x[start:stop][::-1]])
        ys = np.concatenate([high[start:stop], low[start:stop][::-1]])
        parts.append("M" + " ".join(map("%.1f %.1f".__mod__, zip(xs.tolist(), ys.tolist(), strict=True))) + "Z")
    return "".join(parts)


def columns_of(mask: Bools, n_columns: int) -> list[tuple[float, float]]:
    """The stretches of True as shares 0..1 of the whole length, joined where they fall into one of n columns."""
    n = len(mask)
    if n > n_columns:
        column = np.arange(n) * n_columns // n
        mask = np.bincount(column, weights=mask.astype(float), minlength=n_columns) > 0
        n = n_columns
    return [(start / n, stop / n) for start, stop in runs(mask)]


def text(x: float, y: float, words: str, css: str = "", style: str = "") -> str:
    """A piece of text; the words are escaped. (A style, since the page's rules for text outdo attributes.)"""
    own = f' style="{escape(style)}"' if style else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" class="{css}"{own}>{escape(words)}</text>'


@dataclass(frozen=True, slots=True)
class Line:
    """A line over time."""

    y: Array  # (n,)
    colour: str
    name: str
    width: float = 1.1
    dash: str = ""


@dataclass(frozen=True, slots=True)
class Band:
    """An area over time."""

    low: Array  # (n,)
    high: Array  # (n,)
    colour: str
    name: str
    opacity: float = 0.25


@dataclass(frozen=True, slots=True)
class Shade:
    """Stretches of time set off by a background colour."""

    where: Bools  # (n,)
    css: str
    name: str


def time_panel(
    t: Array,
    title: str,
    unit: str,
    *,
    lines: tuple[Line, ...] = (),
    bands: tuple[Band, ...] = (),
    shades: tuple[Shade, ...] = (),
    y_range: tuple[float, float] | None = None,
    width: int = 540,
    height: int = 118,
    with_time: bool = True,
    time_name: str = "time (s)",
) -> str:
    """One plot over time. t (n,) rises; y values beyond y_range are drawn at its edge with a mark, and named."""
    left, right, top, bottom = 54.0, width - 10.0, 20.0, height - (30.0 if with_time else 8.0)
    values = np.concatenate(
        [np.zeros(0), *(line.y for line in lines), *(b.low for b in bands), *(b.high for b in bands)]
    )
    lo, hi = y_range or plain_range(values)
    t_lo, t_hi = float(t[0]), float(t[-1])
    if t_hi <= t_lo:
        t_lo, t_hi = t_lo - 0.5, t_hi + 0.5
    X, Y = Scale(t_lo, t_hi, left, right), Scale(lo, hi, bottom, top)
    bins = int(right - left)
    out = [
        f'<svg class="plot" viewBox="0 0 {width} {height}" data-t="{t_lo!r} {t_hi!r} {left} {right}" role="img">',
        f"<title>{escape(title)}</title>",
    ]
    half = 0.5 / max(len(t) - 1, 1)
    for shade in shades:
        for start, stop in columns_of(shade.where, bins):
            # a stretch reaches from half a frame before its first to half a frame after its last
            x0 = left + (right - left) * max(start * (1 + 2 * half) - half, 0.0)
            x1 = left + (right - left) * min(stop * (1 + 2 * half) - half, 1.0)
            out.append(
                f'<rect class="{shade.css}" x="{x0:.1f}" y="{top}" width="{max(x1 - x0, 1.0):.1f}"'
                f' height="{bottom - top:.1f}"><title>{escape(shade.name)}</title></rect>'
            )
    y_ticks = ticks(lo, hi, max(5, int((bottom - top) / 22)))
    for value, words in zip(y_ticks, tick_texts(y_ticks), strict=True):
        at = float(Y(value))
        out.append(f'<path class="grid" d="M{left} {at:.1f}H{right}"/>{text(left - 5, at + 3.5, words, "tick end")}')
    out.append(time_ticks(X, bottom, with_time, time_name))
    for band in bands:
        x, low, high = band_envelope(t, band.low, band.high, bins)
        d = area_path(X(x), Y(np.clip(low, lo, hi)), Y(np.clip(high, lo, hi)))
        out.append(
            f'<path d="{d}" fill="{band.colour}" opacity="{band.opacity}"><title>{escape(band.name)}</title></path>'
        )
    beyond = 0.0
    for line in lines:
        x, y = envelope(t, line.y, bins)
        dash = f' stroke-dasharray="{line.dash}"' if line.dash else ""
        out.append(
            f'<path class="line" d="{line_path(X(x), Y(np.clip(y, lo, hi)))}" stroke="{line.colour}"'
            f' stroke-width="{line.width}"{dash}><title>{escape(line.name)}</title></path>'
        )
        out.append(_marks_beyond(X(x), y, lo, hi, top, bottom, line.colour))
        outside = line.y[(line.y < lo) | (line.y > hi)]
        beyond = max(beyond, float(np.abs(outside).max()) if outside.size else 0.0)
    out.append(text(left, 13, f"{title} ({unit})" if unit else title, "title"))
    if beyond:
        out.append(text(right, 13, f"▲▼ up to {short(beyond)} {unit}", "tick end"))
    out.append(f'<path class="frame" d="M{left} {top}V{bottom}H{right}"/></svg>')
    return "".join(out)


def time_ticks(X: Scale, bottom: float, with_time: bool, name: str) -> str:
    """Tick marks of a time axis and, if wanted, their numbers and the axis' name."""
    values = ticks(X.lo, X.hi, 6)
    out = [f'<path class="grid" d="{"".join(f"M{x:.1f} {bottom}v4" for x in X(values))}"/>']
    if with_time:
        for value, words in zip(values, tick_texts(values), strict=True):
            x = float(X(value))
            if x < X.b - 46:  # the axis' name stands at the right end
                out.append(text(x, bottom + 15, words, "tick mid"))
        out.append(text(X.b, bottom + 15, name, "tick end"))
    return "".join(out)


def _marks_beyond(x: Array, y: Array, lo: float, hi: float, top: float, bottom: float, colour: str) -> str:
    """Small triangles where a line leaves the axis, at most one in five units of width."""
    out = []
    for outside, y0, tip in ((y > hi, top, -5), (y < lo, bottom, 5)):
        places = np.unique(np.round(x[outside] / 5) * 5)
        out += [f"M{p - 3:.1f} {y0}h6l-3 {tip}z" for p in places.tolist()]
    return f'<path d="{"".join(out)}" fill="{colour}"/>' if out else ""


def histogram(values: Array, title: str, unit: str, *, curve: float = 0.0, width: int = 540) -> str:
    """Counts of values; with `curve` the normal curve of that sigma and the same area is drawn over them."""
    height, left, right, top, bottom = 150, 54.0, width - 10.0, 20.0, 120.0
    values = values[np.isfinite(values)]
    if not values.size:
        return ""
    lo, hi = (-5.0, 5.0) if curve else (0.0, float(max(np.percentile(values, 99.5) * 1.2, 1e-9)))
    edges = np.linspace(lo, hi, 51)
    counts: Ints = np.histogram(np.clip(values, lo, hi), edges)[0]
    centre, wide = (edges[1:] + edges[:-1]) / 2, edges[1] - edges[0]
    normal = np.zeros(50)
    if curve:
        normal = len(values) * wide * np.exp(-((centre / curve) ** 2) / 2) / (curve * np.sqrt(2 * np.pi))
    X, Y = Scale(lo, hi, left, right), Scale(0, max(float(max(counts.max(), normal.max())), 1.0) * 1.05, bottom, top)
    bars = "".join(
        f"M{x0:.1f} {bottom}V{y:.1f}H{x1:.1f}V{bottom}z"
        for x0, x1, y in zip(X(edges[:-1]), X(edges[1:]), Y(counts.astype(float)), strict=True)
    )
    out = [f'<svg class="plot" viewBox="0 0 {width} {height}" role="img"><title>{escape(title)}</title>']
    y_ticks = np.unique(np.round(ticks(0, Y.hi, 4)))
    for value in y_ticks:
        y = float(Y(value))
        out.append(f'<path class="grid" d="M{left} {y:.1f}H{right}"/>')
        out.append(text(left - 5, y + 3.5, f"{abs(value):.0f}", "tick end"))
    out.append(f'<path d="{bars}" fill="{BLUE}" opacity="0.75"><title>{len(values)} values</title></path>')
    if curve:
        out.append(f'<path class="line ink" d="{line_path(X(centre), Y(normal))}" stroke-dasharray="4 3"/>')
    x_ticks = ticks(lo, hi, 8)
    out += [text(float(X(v)), bottom + 15, w, "tick mid") for v, w in zip(x_ticks, tick_texts(x_ticks), strict=True)]
    out.append(text(left, 13, title, "title") + text(right, bottom + 28, unit, "tick end"))
    out.append(f'<path class="frame" d="M{left} {top}V{bottom}H{right}"/></svg>')
    return "".join(out)
