"""Charts of spots and noise: histograms on a logarithmic axis, positions in the picture, variance over grey level."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geometry.arrays import Array, Bools
from lab.number_format import format_number
from lab.report.plot.axes import (
    BLUE,
    ORANGE,
    VERMILLION,
    PlotArea,
    axes,
    dots,
    frame,
    image_area,
    line_path,
    note,
    plot_area,
    polyline,
    svg_of,
    text,
    ticks,
)
from tracking.noise_estimation.levels import LevelVariances
from tracking.noise_estimation.photon_transfer import NoiseEstimate

_BINS = 48
_MOST_DOTS = 6000
_COLOURS = (BLUE, ORANGE)


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
    p = plot_area((lo, hi), (0.0, max(float(c.max()) for c in counts) * 1.08), height=250)
    base = float(p.Y(np.array(0.0)))
    out = _log_axes(p, title, x_name)
    for (name, _), count, colour in zip(good, counts, _COLOURS, strict=False):
        steps = "".join(f"V{y:.1f}H{x:.1f}" for y, x in zip(p.Y(count), p.X(edges[1:]), strict=True))
        d = f"M{float(p.X(edges[0])):.1f} {base:.1f}{steps}V{base:.1f}"
        out.append(f'<path d="{d}z" fill="{colour}" fill-opacity="0.3"/>')
        out.append(f'<path d="{d}" fill="none" stroke="{colour}" stroke-width="1.4"><title>{name}</title></path>')
    if mark is not None:
        x = float(p.X(np.log10(mark)))
        out.append(f'<path d="M{x:.1f} {base:.1f}V{p.box[1]:.1f}" stroke="{VERMILLION}" stroke-dasharray="5 3"/>')
    right = p.box[0] + p.box[2]
    if len(good) > 1:
        for i, ((name, _), colour) in enumerate(zip(good, _COLOURS, strict=False)):
            out.append(text(right - 8, p.box[1] + 14 + 15 * i, name, "end", f"fill:{colour};font-weight:600"))
    medians = "; ".join(f"{name}: median {format_number(float(np.median(v)))}" for name, v in good)
    out.append(note(p, f"{len(good[0][1])} spots; {medians}"))
    return svg_of(p, title, [*out, frame(p)])


def places_chart(uv_px: Array, size_px: tuple[int, int]) -> str:
    """Positions of spots (n, 2) in the picture; evenly thinned if there are very many."""
    p = image_area(size_px)
    shown = uv_px[:: max(1, -(-len(uv_px) // _MOST_DOTS))]
    out = axes(p, "Positions of the spots", "u (px)", "v (px)", grid=False)
    out.append(f'<path d="{dots(p.at(shown), 1.6 if len(shown) > 300 else 2.6)}" fill="{BLUE}" fill-opacity="0.45"/>')
    some = "" if len(shown) == len(uv_px) else f", {len(shown)} of them shown"
    out.append(note(p, f"{len(uv_px)} spots{some}"))
    return svg_of(p, "Positions of the spots", [*out, frame(p)])


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
    p = plot_area((bottom, top), (0.0, highest), height=280)
    title = f"Variance of a pixel: {name}"
    out = axes(p, title, "grey value (DN)", "variance (DN²)")
    band = np.concatenate(
        [np.stack([level, np.minimum(above, highest)], -1), np.stack([level, np.minimum(below, highest)], -1)[::-1]]
    )
    out.append(f'<path d="{polyline(p.at(band), closed=True)}" fill="{BLUE}" fill-opacity="0.18"/>')
    x, y = p.at(np.stack([level, line], -1)).T
    out.append(f'<path class="line" d="{line_path(x, y)}" stroke="{BLUE}" stroke-width="1.5"/>')
    inside: Bools = np.ones(0, dtype=bool)
    if measured is not None and len(measured.level):
        ends = p.at(np.stack([measured.level, np.maximum(measured.variance - measured.sigma, 0.0)], -1))
        tops = p.at(np.stack([measured.level, np.minimum(measured.variance + measured.sigma, highest)], -1))
        inside = measured.variance <= highest
        ends, tops = ends[inside], tops[inside]
        whiskers = "".join(
            f"M{a:.1f} {b:.1f}V{c:.1f}" for (a, b), (_, c) in zip(ends.tolist(), tops.tolist(), strict=True)
        )
        out.append(f'<path d="{whiskers}" stroke="{VERMILLION}" fill="none"/>')
        places = p.at(np.stack([measured.level, measured.variance], -1)[inside])
        above_all = p.at(np.stack([measured.level, np.full(len(measured.level), highest)], -1)[~inside])
        marks = "".join(f"M{x - 4:.1f} {y + 8:.1f}h8l-4 -7z" for x, y in above_all.tolist())
        out.append(f'<path d="{marks}" fill="none" stroke="{VERMILLION}"/>' if marks else "")
        out.append(f'<path d="{dots(places, 2.6)}" fill="{VERMILLION}"/>')
    return svg_of(p, title, [*out, frame(p)])


def _log_axes(p: PlotArea, title: str, x_name: str) -> list[str]:
    """Axes whose horizontal values are decimal logarithms."""
    left, top, wide, high = p.box
    bottom = top + high
    out = [text(left, 15, title, "title")]
    ys = np.unique(np.round(ticks(0.0, max(p.Y.lo, p.Y.hi), 5)))
    out.append(f'<path class="grid" d="{"".join(f"M{left:.1f} {y:.1f}h{wide:.1f}" for y in p.Y(ys))}"/>')
    out += [text(left - 6, float(p.Y(y)) + 3.5, f"{abs(y):.0f}", "end") for y in ys.tolist()]
    decades = np.arange(np.floor(p.X.lo), np.ceil(p.X.hi) + 1)
    span = p.X.hi - p.X.lo
    steps = [1.0] if span > 2.5 else [1.0, 2.0, 5.0] if span > 0.6 else [1.0, 1.5, 2.0, *range(3, 10)]
    values = np.log10(np.outer(10.0**decades, steps).ravel())
    values = values[(values >= p.X.lo) & (values <= p.X.hi)]
    out.append(f'<path class="grid" d="{"".join(f"M{x:.1f} {top:.1f}v{high + 4:.1f}" for x in p.X(values))}"/>')
    out += [
        text(float(p.X(v)), bottom + 14, f"{10.0**v:.4g}" if v < 3.9 else f"{10.0**v:.0f}", "mid")
        for v in values.tolist()
    ]
    out.append(text(left + wide / 2, bottom + 29, x_name, "mid"))
    out.append(f'<text x="0" y="0" class="mid" transform="translate(12 {top + high / 2:.1f}) rotate(-90)">spots</text>')
    return out
