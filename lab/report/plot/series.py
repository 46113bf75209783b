"""Plots over time, and their data for enlarging in the page."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from geometry.arrays import Array, Bools, Ints
from lab.number_format import format_number
from lab.report.plot import svg

# The series behind a page's time plots, compact enough to embed: cursor.js draws parts of them when a user zooms.
#
# Each series of n values is a row of integers: asinh((y - centre) / scale), rounded. So a few large values cost no
# resolution near the centre. Above a size limit each block of frames is stored as its smallest and largest value. The
# integers are differenced, split into planes of bytes and deflated.

_BITS, _FINE_BITS = 14, 20
_FINE_SHARE = 8  # blocks of fine series are shorter by this factor: they are smooth and so compress better
_SPARE_BYTES, _BYTES_PER_FRAME, _MOST_BYTES = 150_000, 65, 2_700_000


class ZoomData:
    """Collects the series of one page over common times t (n,), increasing, and frame numbers (n,)."""

    def __init__(self, t: Array, frames: Ints) -> None:
        self._t, self._frames = t, frames
        self._series: list[tuple[Array, int]] = []
        self._place: dict[tuple[bytes, int], int] = {}
        self._rows: list[dict[str, Any]] = []
        self._codes: list[Ints] = []

    @property
    def n(self) -> int:
        """The number of frames."""
        return len(self._t)

    def add(self, y: Array, fine: bool = False) -> str | None:
        """The name of a series (n,) for an attribute: its number, or `=value` for a constant.

        None for another number of values: such a plot shows the whole run only. fine: with more digits, for series
        whose axis follows the visible part.
        """
        if len(y) != len(self._t):
            return None
        if len(y) and np.isfinite(y).all() and np.ptp(y) == 0:
            return f"={float(y[0])!r}"
        y = np.ascontiguousarray(y, dtype=float)
        key = (y.tobytes(), _FINE_BITS if fine else _BITS)
        if key not in self._place:
            self._place[key] = len(self._series)
            self._series.append((y, key[1]))
        return str(self._place[key])

    def add_row(self, name: str, codes: Ints, words: Sequence[tuple[str, str]]) -> int:
        """The number of a row of statuses: codes (n,) index into `words`, (word, colour) each; negative: none."""
        self._rows.append({"name": name, "words": words})
        self._codes.append(codes)
        return len(self._rows) - 1

    def encoded(self) -> str:
        """JSON text: what the rows and series are, and their integers, deflated, in base64."""
        n = len(self._t)
        allowed = min(_SPARE_BYTES + _BYTES_PER_FRAME * n, _MOST_BYTES)
        fixed = [*_whole_numbers(self._t)[1], *_whole_numbers(self._frames.astype(float), 1.0)[1]]
        fixed += [_bytes(codes + 1, 1) for codes in self._codes]
        expected = 1.6 * n * len(self._series)
        block = 1 if expected <= 1.3 * allowed else max(2, int(1.4 * expected / allowed))
        while True:
            packed = [_packed(y, bits, _own(block, bits)) for y, bits in self._series]
            data = base64.b64encode(zlib.compress(b"".join([*fixed, *(p[1] for p in packed)]), 6)).decode("ascii")
            if len(data) <= allowed or block >= max(n, 1):
                break
            block = max(block + 1, int(block * 1.05 * len(data) / allowed))
        head = {
            "n": n,
            "t": _whole_numbers(self._t)[0],
            "frames": _whole_numbers(self._frames.astype(float), 1.0)[0],
            "rows": self._rows,
            "series": [p[0] for p in packed],
            "data": data,
        }
        return json.dumps(head, separators=(",", ":"), ensure_ascii=True).replace("<", "\\u003c")


def _own(block: int, bits: int) -> int:
    """The length of the blocks of a series where most have `block` frames."""
    return block if bits == _BITS else -(-block // _FINE_SHARE)


def _bytes(values: Ints, count: int) -> bytes:
    """The `count` low bytes of each integer, as planes: all lowest bytes first."""
    return b"".join(((values >> (8 * i)) & 255).astype(np.uint8).tobytes() for i in range(count))


def _whole_numbers(values: Array, least_step: float = 1e-6) -> tuple[list[float], list[bytes]]:
    """First value and step; and the second differences of the values (n,) in steps, four bytes each."""
    first = float(values[0]) if len(values) else 0.0
    largest = float(np.abs(values - first).max(initial=0.0))
    step = max(least_step, largest / 2**30)
    places = np.round((values - first) / step).astype(np.int64)
    return [first, step], [_bytes(np.diff(np.diff(places, prepend=0), prepend=0), 4)]


def _packed(y: Array, bits: int, block: int) -> tuple[list[float], bytes]:
    """Centre, scale, lowest asinh, its step, bytes per value, frames per block; and the integers, 0 for nan."""
    finite = y[np.isfinite(y)]
    centre = float(np.median(finite)) if finite.size else 0.0
    usual = float(np.percentile(np.abs(finite - centre), 75)) if finite.size else 0.0
    scale = usual or float(np.abs(finite - centre).max(initial=0.0)) or 1.0
    if block > 1:
        padded = np.full(-(-len(y) // block) * block, np.nan)
        padded[: len(y)] = y
        grid = padded.reshape(-1, block)
        low = np.where(np.isnan(grid), np.inf, grid).min(axis=1)
        high = np.where(np.isnan(grid), -np.inf, grid).max(axis=1)
        y = np.concatenate([low, high])
        y[~np.isfinite(y)] = np.nan
    u = np.arcsinh((y - centre) / scale)
    lowest = float(np.nanmin(u)) if finite.size else 0.0
    step = max((float(np.nanmax(u)) - lowest) if finite.size else 0.0, 1e-9) / (2**bits - 2)
    q = np.where(np.isfinite(u), 1 + np.round((np.nan_to_num(u) - lowest) / step), 0).astype(np.int64)
    count = (bits + 7) // 8
    return [centre, scale, lowest, step, count, block], _bytes(np.diff(q, prepend=0), count)


# Plots of series over time: lines, bands and shaded intervals with a common time axis.


_BINS_PER_UNIT = 0.6  # of a thinned series; cursor.js draws enlarged parts from more points
_NAME_WIDTH = 46  # viewBox units at the right end of a time axis that its name takes


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
    sigma: Array | None = None  # (n,) where the band is centre +- times * sigma
    centre: Array | float = 0.0
    times: float = 1.0

    @classmethod
    def about(
        cls, centre: Array | float, sigma: Array, times: float, colour: str, name: str, opacity: float = 0.25
    ) -> Band:
        """The band centre +- times * sigma."""
        low, high = centre - times * sigma, centre + times * sigma
        return cls(low, high, colour, name, opacity, sigma, centre, times)


@dataclass(frozen=True, slots=True)
class Shade:
    """Intervals of time with a background colour."""

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
    zoom: ZoomData | None = None,
    row: int = -1,
    fit: bool = False,
) -> str:
    """One plot over times t (n,), increasing.

    Values beyond y_range are drawn at its edge with a mark, and the largest one is given in the corner.
    zoom: takes the series, so that a part of the time can be enlarged; row: the number of the row of statuses in it
    from which the shades follow; fit: the y axis of an enlarged part follows the values in it.
    """
    values = np.concatenate(
        [np.zeros(0), *(line.y for line in lines), *(b.low for b in bands), *(b.high for b in bands)]
    )
    lo, hi = y_range or svg.padded_range(values)
    bottom = height - (30.0 if with_time else 8.0)
    p = svg.PlotArea(time_scale(t, 54.0, width - 10.0), svg.Scale(lo, hi, bottom, 20.0), width, height)
    bins = max(int(_BINS_PER_UNIT * (p.X.b - p.X.a)), 1)
    marks = svg.ticks(lo, hi, max(5, int((bottom - 20.0) / 22)))
    out = ['<g class="whole">', *_shaded(p, shades, len(t)), svg.y_ticks(p, marks, svg.tick_texts(marks), grid=True)]
    out.append(time_ticks(p, time_name if with_time else ""))
    for band in bands:
        x, low, high = svg.band_envelope(t, band.low, band.high, bins)
        d = svg.area_path(p.X(x), p.Y(np.clip(low, lo, hi)), p.Y(np.clip(high, lo, hi)))
        out.append(
            f'<path d="{d}" fill="{band.colour}" opacity="{band.opacity}"{_band_data(zoom, band, fit)}>'
            f"<title>{escape(band.name)}</title></path>"
        )
    beyond = 0.0
    for line in lines:
        x, y = svg.envelope(t, line.y, bins)
        dash = f' stroke-dasharray="{line.dash}"' if line.dash else ""
        out.append(
            f'<path class="line" d="{svg.line_path(p.X(x), p.Y(np.clip(y, lo, hi)))}" stroke="{line.colour}"'
            f' stroke-width="{line.width}"{dash}{_line_data(zoom, line, fit)}><title>{escape(line.name)}</title></path>'
        )
        out.append(_marks_beyond(p, x, y, line.colour))
        outside = line.y[(line.y < lo) | (line.y > hi)]
        beyond = max(beyond, float(np.abs(outside).max()) if outside.size else 0.0)
    if beyond:
        out.append(svg.text(p.X.b, 12, f"▲▼ up to {format_number(beyond)} {unit}", "end"))
    out += ["</g>", svg.heading(p, f"{title} ({unit})" if unit else title)]
    data = time_data(p.X)
    if zoom is not None and len(t) == zoom.n:
        data += f' data-y="{lo!r} {hi!r} {bottom} 20.0" data-u="{escape(unit, quote=True)}" data-row="{row}"'
        data += f' data-name="{escape(time_name) if with_time else ""}"' + (' data-fit="1"' if fit else "")
    return svg.figure(width, height, title, [*out, svg.frame(p, closed=False)], data=data)


def _line_data(zoom: ZoomData | None, line: Line, fine: bool) -> str:
    name = None if zoom is None else zoom.add(line.y, fine)
    return "" if name is None else f' data-s="{name}"'


def _band_data(zoom: ZoomData | None, band: Band, fine: bool) -> str:
    """The attribute that names the series of a band: `centre sigma times`, or its two edges."""
    if zoom is None:
        return ""
    if band.sigma is None:
        names = [zoom.add(band.low), zoom.add(band.high)]
    else:
        centre = f"={band.centre!r}" if isinstance(band.centre, float) else zoom.add(band.centre, fine)
        names = [centre, zoom.add(band.sigma), repr(float(band.times))]
    return "" if None in names else f' data-b="{" ".join(map(str, names))}"'


def unwrapped(degrees: Array) -> Array:
    """Angles (n, k) over time without jumps by 360 degrees; nan where they are not known."""
    out = np.where(np.isfinite(degrees), degrees, np.nan)
    for k in range(out.shape[1]):
        known = np.isfinite(out[:, k])
        out[known, k] = np.unwrap(out[known, k], period=360.0)
    return out


def time_scale(t: Array, left: float, right: float, margin: float = 0.0) -> svg.Scale:
    """A scale for times (n,) between two drawing coordinates; margin: time added at both ends."""
    lo, hi = float(t[0]), float(t[-1])
    if hi <= lo:
        lo, hi = lo - 0.5, hi + 0.5
    return svg.Scale(lo - margin, hi + margin, left, right)


def time_data(X: svg.Scale) -> str:
    """The attribute from which cursor.js knows the time axis of a drawing."""
    return f' data-t="{X.lo!r} {X.hi!r} {X.a} {X.b}"'


def time_ticks(p: svg.PlotArea, name: str) -> str:
    """Ticks of a time axis; with a name also the labels and, at the right end, the name."""
    values = svg.ticks(p.X.lo, p.X.hi, 6)
    free = p.X(values) < p.X.b - _NAME_WIDTH
    labels = [label if name and ok else "" for label, ok in zip(svg.tick_texts(values), free.tolist(), strict=True)]
    _, top, _, high = p.box
    return svg.x_ticks(p, values, labels) + (svg.text(p.X.b, top + high + 15, name, "end") if name else "")


def _shaded(p: svg.PlotArea, shades: tuple[Shade, ...], n: int) -> list[str]:
    """Rectangles behind the intervals, each from half a frame before its first to half a frame after its last frame."""
    left, top, wide, high = p.box
    half = 0.5 / max(n - 1, 1)
    out = []
    for shade in shades:
        for start, stop in svg.true_shares(shade.where, int(wide)):
            x0 = left + wide * max(start * (1 + 2 * half) - half, 0.0)
            x1 = left + wide * min(stop * (1 + 2 * half) - half, 1.0)
            out.append(
                f'<rect class="{shade.css}" x="{x0:.1f}" y="{top}" width="{max(x1 - x0, 1.0):.1f}"'
                f' height="{high:.1f}"><title>{escape(shade.name)}</title></rect>'
            )
    return out


def _marks_beyond(p: svg.PlotArea, x: Array, y: Array, colour: str) -> str:
    """Small triangles where a line leaves the axes, at most one in five units of width."""
    out = []
    for outside, edge, tip in ((y > p.Y.hi, p.Y.b, -5), (y < p.Y.lo, p.Y.a, 5)):
        places = np.unique(np.round(p.X(x[outside]) / 5) * 5)
        out += [f"M{at - 3:.1f} {edge}h6l-3 {tip}z" for at in places.tolist()]
    return f'<path d="{"".join(out)}" fill="{colour}"/>' if out else ""
