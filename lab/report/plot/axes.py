"""A plot with two axes in SVG text: frame, grid, numbers and names, for the drawings of a calibration."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from html import escape

import numpy as np

from geometry.arrays import Array
from lab.report.plot.svg import Scale, text, tick_texts, ticks

INK, SOFT = "var(--ink)", "var(--soft)"


@dataclass(frozen=True, slots=True)
class Plane:
    """Where values go in a drawing, and how large it is. Coordinates are viewBox units."""

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


def plane(
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
) -> Plane:
    """A plane for values in these ranges. equal: one unit is as long in x as in y, and the height follows.

    y_down: y grows downwards, as in pictures. Below the axes is room for their numbers, the name and a `note`.
    """
    top = 24.0
    wide = width - left - right
    if equal:
        high = wide * (y_range[1] - y_range[0]) / (x_range[1] - x_range[0])
        if high > tallest:
            wide, high = wide * tallest / high, tallest
        height = top + high + bottom
    low, up = (top, height - bottom) if y_down else (height - bottom, top)
    return Plane(Scale(*x_range, left, left + wide), Scale(*y_range, low, up), width, height)


def image_plane(size_px: tuple[int, int], *, width: float = 540, right: float = 12) -> Plane:
    """A plane for the pixels of a picture: its edges are -0.5 and size - 0.5."""
    return plane((-0.5, size_px[0] - 0.5), (-0.5, size_px[1] - 0.5), equal=True, y_down=True, width=width, right=right)


def svg_of(plane: Plane, title: str, parts: list[str], css: str = "plot") -> str:
    """The drawing as an svg element that a screen reader can name."""
    name = escape(title, quote=True)
    return (
        f'<svg class="{css}" viewBox="0 0 {plane.width:.0f} {plane.height:.0f}" role="img" aria-label="{name}">'
        f"<title>{escape(title)}</title>{''.join(parts)}</svg>"
    )


def axes(plane: Plane, title: str, x_name: str, y_name: str, *, grid: bool = True) -> list[str]:
    """Title, frame, ticks with numbers, names of both axes."""
    left, top, wide, high = plane.box
    bottom, out = top + high, [text(left, 15, title, "title")]
    xs = ticks(min(plane.X.lo, plane.X.hi), max(plane.X.lo, plane.X.hi), max(3, int(wide / 75)))
    ys = ticks(min(plane.Y.lo, plane.Y.hi), max(plane.Y.lo, plane.Y.hi), max(3, int(high / 45)))
    if grid:
        lines = "".join(f"M{x:.1f} {top:.1f}v{high:.1f}" for x in plane.X(xs))
        lines += "".join(f"M{left:.1f} {y:.1f}h{wide:.1f}" for y in plane.Y(ys))
    else:
        lines = "".join(f"M{x:.1f} {bottom:.1f}v4" for x in plane.X(xs))
        lines += "".join(f"M{left - 4:.1f} {y:.1f}h4" for y in plane.Y(ys))
    out.append(f'<path class="grid" d="{lines}"/>')
    out += [text(float(x), bottom + 14, w, "mid") for x, w in zip(plane.X(xs), tick_texts(xs), strict=True)]
    out += [text(left - 6, float(y) + 3.5, w, "end") for y, w in zip(plane.Y(ys), tick_texts(ys), strict=True)]
    out.append(text(left + wide / 2, bottom + 29, x_name, "mid"))
    out.append(
        f'<text x="0" y="0" class="mid" transform="translate(12 {top + high / 2:.1f}) rotate(-90)">'
        f"{escape(y_name)}</text>"
    )
    return out


def note(plane: Plane, words: str) -> str:
    """A line of words at the foot of a drawing, clear of the axis' name."""
    return text(plane.box[0], plane.height - 5, words, "", "font-size:10.5px")


def frame(plane: Plane) -> str:
    """The edge of the area inside the axes."""
    left, top, wide, high = plane.box
    return f'<path class="frame" d="M{left:.1f} {top:.1f}h{wide:.1f}v{high:.1f}h{-wide:.1f}z"/>'


def segments(starts: Array, ends: Array) -> str:
    """The `d` of a path of separate lines (n, 2) to (n, 2), drawing coordinates; those with a nan are left out."""
    good = np.isfinite(starts).all(axis=1) & np.isfinite(ends).all(axis=1)
    rows = np.concatenate([starts[good], ends[good]], axis=1)
    return "".join(map("M%.1f %.1fL%.1f %.1f".__mod__, map(tuple, rows.tolist())))


def dots(places: Array, radius: float) -> str:
    """The `d` of round dots (n, 2), to be filled; nan are left out."""
    good = places[np.isfinite(places).all(axis=1)]
    r = f"{radius:g}"
    ring = f"a{r} {r} 0 1 0 {2 * radius:g} 0a{r} {r} 0 1 0 {-2 * radius:g} 0z"
    return "".join(f"M{x - radius:.1f} {y:.1f}{ring}" for x, y in good.tolist())


def polyline(places: Array, closed: bool = False) -> str:
    """The `d` of one line through (n, 2) drawing coordinates."""
    return "M" + " ".join(map("%.1f %.1f".__mod__, map(tuple, places.tolist()))) + ("z" if closed else "")


def picture_uri(data: bytes, kind: str) -> str:
    """A picture's bytes as text that an HTML file can hold; kind: png or jpeg."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def round_size(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is at most value (> 0): lengths of scale bars."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(m * power for m in (1, 2, 5) if m * power <= value * 1.0001))


def number(value: float, digits: int = 3) -> str:
    """A number with so many significant digits and a true minus, trailing noughts cut off."""
    return f"{value:.{digits}g}".replace("-", "\u2212")
