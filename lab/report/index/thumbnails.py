"""Thumbnails: three curves of a run in one small drawing, with a common scale."""

from __future__ import annotations

from html import escape

import numpy as np

from geometry.arrays import Array
from lab.report.plot.scales import number
from lab.report.plot.thinning import envelope, true_ranges

WIDTH, HEIGHT = 96, 26  # viewBox units
_MARGIN = 2


def thumbnail(values: Array, names: tuple[str, str, str], unit: str, least: float, points: int) -> str:
    """An svg element with three curves; empty where no value is known.

    values: (F, 3), nan where unknown. Each curve is drawn about the middle of its range, all with one scale, so that
    their heights compare. least: the smallest range that fills the height; noise at rest stays flat. points: at most so
    many per curve; the extremes are kept.
    """
    spans = [_span(values[:, k]) for k in range(3)]
    known = [span for span in spans if span is not None]
    if not known:
        return ""
    scale = (HEIGHT - 2 * _MARGIN) / max(least, *(high - low for low, high in known))
    words = ", ".join(
        f"{name} {number(span[0])} to {number(span[1])}" for name, span in zip(names, spans, strict=True) if span
    )
    paths = "".join(
        f'<path class="{css}" d="{_path(values[:, k], span, scale, points)}"/>'
        for k, (css, span) in enumerate(zip("abc", spans, strict=True))
        if span is not None
    )
    return (
        f'<svg class="t" viewBox="0 0 {WIDTH} {HEIGHT}" role="img"><title>{escape(words)} {unit}</title>{paths}</svg>'
    )


def _span(y: Array) -> tuple[float, float] | None:
    finite = y[np.isfinite(y)]
    return (float(finite.min()), float(finite.max())) if finite.size else None


def _path(y: Array, span: tuple[float, float], scale: float, points: int) -> str:
    """The `d` of a curve, in whole viewBox units relative to the point before."""
    n = len(y)
    x, y = envelope(np.arange(n, dtype=float), y, max(points // 2, 1))
    xs = np.rint(x * ((WIDTH - 1) / max(n - 1, 1)))
    ys = np.rint(HEIGHT / 2 - (y - (span[0] + span[1]) / 2) * scale)
    out = []
    for start, stop in true_ranges(np.isfinite(ys)):
        dx, dy = np.diff(xs[start:stop]).astype(int), np.diff(ys[start:stop]).astype(int)
        out.append(f"M{xs[start]:.0f} {ys[start]:.0f}{_steps(dx.tolist(), dy.tolist())}")
    return "".join(out)


def _steps(dx: list[int], dy: list[int]) -> str:
    """Relative lines; level ones are joined."""
    steps: list[tuple[int, int]] = []
    for step in zip(dx, dy, strict=True):
        if steps and step[1] == 0 and steps[-1][1] == 0:
            steps[-1] = (steps[-1][0] + step[0], 0)
        elif step != (0, 0):
            steps.append(step)
    if not steps:
        return "h0"
    return "l" + " ".join(f"{a} {b}" for a, b in steps).replace(" -", "-")
