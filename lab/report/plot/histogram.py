"""Histograms, with the normal curve of a given sigma over them."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Ints
from lab.report.plot.axes import axes, frame, note, plot_area, svg_of
from lab.report.plot.svg import BLUE, bar_path, line_path


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
