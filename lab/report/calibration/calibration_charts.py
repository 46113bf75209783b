"""Charts of a calibration: histogram of residuals, comparison of lens models, drift over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from html import escape

import numpy as np

from geometry.arrays import Array
from lab.report.plot.axes import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    PlotArea,
    Scale,
    dots,
    frame,
    heading,
    histogram,
    line_path,
    number,
    plot_area,
    svg_of,
    text,
    tick_texts,
    ticks,
    x_ticks,
    y_ticks,
)

SERIES = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILLION)


def residual_histogram(
    residuals: Array, title: str = "Residuals against the normal curve", unit: str = "px", *, sigma: float | None = None
) -> str:
    """Counts of residuals (any shape; nan are omitted) within 5 sigma, and the normal curve of the same area.

    sigma: of the curve, in the residuals' unit: the assumed noise; None: the robust spread of the residuals (1.4826
    times their median absolute value).
    """
    values = np.asarray(residuals, dtype=float).ravel()
    values = values[np.isfinite(values)]
    robust = 1.4826 * float(np.median(np.abs(values))) if values.size else 1.0
    spread = max(sigma if sigma is not None else robust, 1e-12)
    beyond = int((np.abs(values) > 5 * spread).sum())
    rms = number(float(np.sqrt(np.mean(values**2)))) if values.size else "–"
    words = f"{len(values)} values, RMS {rms} {unit}; curve: sigma {number(float(spread))} {unit}"
    words += "" if sigma is None else f" (robust spread {number(robust)})"
    words += f"; beyond 5 sigma: {beyond}" + (f" (normal: {5.7e-7 * len(values):.1g})" if beyond else "")
    limits = -5 * spread, 5 * spread
    return histogram(values, limits, title, f"residual ({unit})", sigma=spread, footnote=words)


def lens_model_chart(
    names: Sequence[str],
    error_px: Array,
    chosen: int,
    title: str = "Lens models: expected error of directions",
    *,
    noise_px: Array | None = None,
) -> str:
    """A bar per lens model: the expected error of its directions, px; the chosen model is marked.

    names, error_px (n,): nan where a fit failed. noise_px (n,): the part of the error from noise, drawn as ticks.
    """
    rms = np.asarray(error_px, dtype=float)
    finite = rms[np.isfinite(rms)]
    # The bar of a model with a much larger error is cut and its number marked, so that the others stay readable.
    top = max(min(float(finite.max()), 4 * float(finite.min())) * 1.15 if finite.size else 1.0, 1e-9)
    row, left = 26.0, min(20 + 6.4 * max((len(n) for n in names), default=0), 200.0)
    low = 28 + row * len(names)
    p = PlotArea(Scale(0, top, left, 470), Scale(0, len(names), 28, low), 540, low + 38)
    marks = ticks(0, top, 6)
    out = [text(8, 15, title, "title"), x_ticks(p, marks, tick_texts(marks), grid=True)]
    out.append(text((left + 470) / 2, low + 30, "expected error (px)", "mid"))
    for i, name in enumerate(names):
        y = float(p.Y(np.array(i + 0.5)))
        bold = "font-weight:600;fill:var(--ink)" if i == chosen else ""
        out.append(text(left - 6, y + 4, name, "end", bold))
        if not np.isfinite(rms[i]):
            out.append(text(left + 6, y + 4, "did not fit"))
            continue
        long = float(p.X(np.array(min(rms[i], top)))) - left
        fill = BLUE if i == chosen else GREY
        out.append(
            f'<rect x="{left:.1f}" y="{y - 8:.1f}" width="{long:.1f}" height="16" fill="{fill}" fill-opacity="0.85">'
            f"<title>{escape(name)}: {rms[i]:.4g} px</title></rect>"
        )
        if noise_px is not None and np.isfinite(noise_px[i]):
            x = float(p.X(np.array(min(noise_px[i], top))))
            out.append(
                f'<path d="M{x:.1f} {y - 11:.1f}v22" stroke="{ORANGE}" stroke-width="2.5">'
                f"<title>noise: {noise_px[i]:.4g} px</title></path>"
            )
        words = number(float(rms[i])) + (" ✓" if i == chosen else "") + (" ▸" if rms[i] > top else "")
        out.append(text(476, y + 4, words, "", bold))
    if noise_px is not None:
        out.append(text(532, low + 30, "orange: noise", "end"))
    return svg_of(p, title, [*out, frame(p, closed=False)])


@dataclass(frozen=True, slots=True)
class DriftLine:
    """The drift of one camera, check by check."""

    dates: Sequence[date]
    values: Array  # (n,)
    sigmas: Array | None = None  # (n,)


def drift_chart(
    lines: Mapping[str, DriftLine],
    title: str = "Drift since the calibration",
    unit: str = "px",
    *,
    warn: float | None = None,
    fail: float | None = None,
    expires: date | None = None,
) -> str:
    """Drift of each camera over the days, with the limits and the day on which the calibration expires."""
    days = [d.toordinal() for line in lines.values() for d in line.dates]
    tops = [line.values + (0 if line.sigmas is None else line.sigmas) for line in lines.values()]
    top = float(np.nanmax(np.concatenate([*tops, np.array([fail or 0.0, warn or 0.0, 1e-6])])))
    today = max(days, default=date(2000, 1, 1).toordinal())
    first, last = min(days, default=today), today
    # The expiry is shown unless the axis would have to become three times as long.
    if expires is not None and expires.toordinal() <= last + max(2 * (last - first), 30):
        last = max(last, expires.toordinal())
    pad = max(0.03 * (last - first), 0.6)
    p = plot_area((first - pad, last + pad), (0, top * 1.12), height=250)
    left, over, wide, high = p.box
    marks, dated = ticks(0, p.Y.hi, 5), _day_ticks(first, last)
    out = [
        heading(p, f"{title} ({unit})"),
        y_ticks(p, marks, tick_texts(marks), grid=True),
        x_ticks(p, np.array(dated, dtype=float), [date.fromordinal(d).isoformat() for d in dated]),
    ]
    for limit, colour, words in ((warn, ORANGE, "warning"), (fail, VERMILLION, "not to be used")):
        if limit is not None:
            y = float(p.Y(np.array(limit)))
            out.append(
                f'<path d="M{left:.1f} {y:.1f}h{wide:.1f}" stroke="{colour}"'
                ' stroke-width="1.3" stroke-dasharray="6 3"/>'
            )
            # One label at each end: the limits are often too close for two lines of text.
            x, side = (left + 4, "") if limit == warn else (left + wide - 4, "end")
            out.append(text(x, y - 4, f"{words} {number(limit)}", side))
    if expires is not None and expires.toordinal() <= last:
        x = float(p.X(np.array(float(expires.toordinal()))))
        out.append(f'<path d="M{x:.1f} {over:.1f}v{high:.1f}" stroke="{VERMILLION}" stroke-width="1.3"/>')
        out.append(text(x - 4, over + high - 6, "expires", "end"))  # at the bottom, away from the limits
    at = left
    for i, (name, line) in enumerate(lines.items()):
        out += _drift_line(p, name, line, SERIES[i % len(SERIES)], at)
        at += 34 + 6.4 * len(name)
    return svg_of(p, title, [*out, frame(p)])


def _drift_line(p: PlotArea, name: str, line: DriftLine, colour: str, legend_x: float) -> list[str]:
    """One camera's values over the days with their sigmas, and its entry in the legend."""
    order = np.argsort([d.toordinal() for d in line.dates], kind="stable")
    x = p.X(np.array([line.dates[k].toordinal() for k in order], dtype=float))
    v = np.asarray(line.values, dtype=float)[order]
    y = p.Y(v)
    out = [f'<path class="line" d="{line_path(x, y)}" stroke="{colour}" stroke-width="1.6"/>']
    if line.sigmas is not None:
        s = np.asarray(line.sigmas, dtype=float)[order]
        low, up = p.Y(np.maximum(v - s, 0)), p.Y(v + s)
        d = "".join(f"M{a:.1f} {b:.1f}V{c:.1f}" for a, b, c in zip(x, low, up, strict=True) if np.isfinite(b + c))
        out.append(f'<path d="{d}" stroke="{colour}" stroke-width="1" stroke-opacity="0.7"/>')
    d = dots(np.stack([x, y], axis=-1), 3)
    out.append(f'<path d="{d}" fill="{colour}" stroke="var(--paper)" stroke-width="0.7"/>')
    out.append(f'<path d="M{legend_x:.1f} {p.height - 6:.1f}h16" stroke="{colour}" stroke-width="3"/>')
    out.append(text(legend_x + 20, p.height - 2, name))
    return out


def _day_ticks(first: int, last: int) -> list[int]:
    """At most 5 days, evenly spaced."""
    count = min(5, last - first + 1)
    return sorted({round(float(d)) for d in np.linspace(first, last, count)})
