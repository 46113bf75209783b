"""Plot areas with two axes: frame, grid, ticks with labels, names, title and footnote."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array
from lab.report.plot.scales import Scale, tick_texts, ticks
from lab.report.plot.svg import figure, text, vertical_text


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
    left: float = 58,
    right: float = 12,
    bottom: float = 52,
    tallest: float = 440,
) -> PlotArea:
    """A plot area for values in these ranges. equal: one unit has the same length in x and y, and the height follows.

    y_down: y grows downwards, as in images. `bottom` leaves room for tick labels, the name of the axis and a `note`.
    """
    top = 24.0
    wide = width - left - right
    if equal:
        high = wide * (y_range[1] - y_range[0]) / (x_range[1] - x_range[0])
        if high > tallest:
            wide, high = wide * tallest / high, tallest
        height = top + high + bottom
    low, up = (top, height - bottom) if y_down else (height - bottom, top)
    return PlotArea(Scale(*x_range, left, left + wide), Scale(*y_range, low, up), width, height)


def image_area(size_px: tuple[int, int], *, width: float = 540, right: float = 12) -> PlotArea:
    """A plot area for the pixels of an image, whose edges are at -0.5 and size - 0.5."""
    return plot_area(
        (-0.5, size_px[0] - 0.5), (-0.5, size_px[1] - 0.5), equal=True, y_down=True, width=width, right=right
    )


def svg_of(p: PlotArea, title: str, parts: list[str], css: str = "plot") -> str:
    """The drawing as an svg element with a name for screen readers."""
    return figure(p.width, p.height, title, parts, css=css)


def axes(p: PlotArea, title: str, x_name: str, y_name: str, *, grid: bool = True) -> list[str]:
    """Title, ticks with labels, names of both axes; grid lines, or short ticks without `grid`."""
    left, top, wide, high = p.box
    xs = ticks(min(p.X.lo, p.X.hi), max(p.X.lo, p.X.hi), max(3, int(wide / 75)))
    ys = ticks(min(p.Y.lo, p.Y.hi), max(p.Y.lo, p.Y.hi), max(3, int(high / 45)))
    return [
        heading(p, title),
        x_ticks(p, xs, tick_texts(xs), grid=grid),
        y_ticks(p, ys, tick_texts(ys), grid=grid),
        text(left + wide / 2, top + high + 30, x_name, "mid"),
        vertical_text(12, top + high / 2, y_name),
    ]


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
