"""Charts of a calibration: residuals against the normal curve, the lens ladder, error ellipses, drift over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from html import escape

import numpy as np

from geometry.arrays import Array, Ints
from lab.report.plot.axes import Plane, axes, dots, frame, number, plane, polyline, svg_of
from lab.report.plot.axes import note as foot
from lab.report.plot.svg import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    Scale,
    line_path,
    text,
    tick_texts,
    ticks,
)

SERIES = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILLION)


def residual_histogram(
    residuals: Array, title: str = "Residuals against the normal curve", unit: str = "px", *, sigma: float | None = None
) -> str:
    """Counts of residuals (any shape; nan left out) and the normal curve of the same area.

    sigma: of the curve, in the residuals' unit: what the noise was taken to be; None: the robust spread of the
    residuals themselves (1.4826 times the median size). Values beyond 5 sigma are counted in words.
    """
    values = np.asarray(residuals, dtype=float).ravel()
    values = values[np.isfinite(values)]
    robust = 1.4826 * float(np.median(np.abs(values))) if values.size else 1.0
    spread = max(sigma if sigma is not None else robust, 1e-12)
    reach = 5 * spread
    edges = np.linspace(-reach, reach, 61)
    counts: Ints = np.histogram(values, edges)[0]
    middle, wide = (edges[1:] + edges[:-1]) / 2, edges[1] - edges[0]
    normal = len(values) * wide * np.exp(-((middle / spread) ** 2) / 2) / (spread * np.sqrt(2 * np.pi))
    p = plane(
        (-reach, reach), (0, max(float(counts.max(initial=0)), float(normal.max(initial=0)), 1) * 1.06), height=240
    )
    out = axes(p, title, f"residual ({unit})", "count")
    base = float(p.Y(np.array(0.0)))
    bars = "".join(
        f"M{a:.1f} {base:.1f}V{y:.1f}H{b:.1f}V{base:.1f}z"
        for a, b, y in zip(p.X(edges[:-1]), p.X(edges[1:]), p.Y(counts.astype(float)), strict=True)
    )
    out.append(f'<path d="{bars}" fill="{BLUE}" fill-opacity="0.7"/>')
    out.append(
        f'<path class="line ink" d="{line_path(p.X(middle), p.Y(normal))}" stroke-width="1.5" stroke-dasharray="5 3"/>'
    )
    beyond = int((np.abs(values) > reach).sum())
    expected = 5.7e-7 * len(values)
    rms = number(float(np.sqrt(np.mean(values**2)))) if values.size else "–"
    told = f"{len(values)} values, RMS {rms} {unit}; curve: sigma {number(float(spread))} {unit}"
    told += "" if sigma is None else f" (robust spread {number(robust)})"
    told += f"; beyond 5 sigma: {beyond}" + (f" (normal: {expected:.1g})" if beyond else "")
    out.append(foot(p, told))
    return svg_of(p, title, [*out, frame(p)])


def lens_ladder(
    names: Sequence[str],
    holdout_rms_px: Array,
    chosen: int,
    title: str = "Lens models: error on views that the fit has not seen",
    *,
    fit_rms_px: Array | None = None,
    sigma_px: Array | None = None,
) -> str:
    """A bar per lens model: its RMS error on held-out views, px, the chosen one marked.

    names, holdout_rms_px (n,): nan where a model failed. fit_rms_px (n,): on the fitted views, as ticks: a model that
    only gains there learns noise. sigma_px (n,): of the hold-out error, as whiskers.
    """
    rms = np.asarray(holdout_rms_px, dtype=float)
    finite = rms[np.isfinite(rms)]
    # A model that is far off would press all others to nothing; it is cut, and its number says so.
    top = min(float(finite.max()), 4 * float(finite.min())) * 1.15 if finite.size else 1.0
    top = max(top, 1e-9)
    row, left = 26.0, min(20 + 6.4 * max((len(n) for n in names), default=0), 200.0)
    height = 30 + row * len(names) + 36
    p = Plane(Scale(0, top, left, 470), Scale(0, len(names), 28, 28 + row * len(names)), 540, height)
    out = [text(8, 15, title, "title")]
    bottom = p.box[1] + p.box[3]
    marks = ticks(0, top, 6)
    grid = "".join(f"M{x:.1f} {p.box[1]:.1f}V{bottom:.1f}" for x in p.X(marks))
    out.append(f'<path class="grid" d="{grid}"/>')
    out += [text(float(x), bottom + 14, w, "mid") for x, w in zip(p.X(marks), tick_texts(marks), strict=True)]
    out.append(text((left + 470) / 2, bottom + 29, "hold-out RMS (px)", "mid"))
    for i, name in enumerate(names):
        y, mine = float(p.Y(np.array(i + 0.5))), i == chosen
        bold = "font-weight:600;fill:var(--ink)" if mine else ""
        out.append(text(left - 6, y + 4, name, "end", bold))
        if not np.isfinite(rms[i]):
            out.append(text(left + 6, y + 4, "did not fit"))
            continue
        long = float(p.X(np.array(min(rms[i], top)))) - left
        fill = BLUE if mine else GREY
        out.append(
            f'<rect x="{left:.1f}" y="{y - 8:.1f}" width="{long:.1f}" height="16" fill="{fill}" fill-opacity="0.85">'
            f"<title>{escape(name)}: {rms[i]:.4g} px</title></rect>"
        )
        if sigma_px is not None and np.isfinite(sigma_px[i]) and rms[i] <= top:
            a, b = p.X(np.clip(np.array([rms[i] - sigma_px[i], rms[i] + sigma_px[i]]), 0, top)).tolist()
            out.append(
                f'<path d="M{a:.1f} {y:.1f}H{b:.1f}M{a:.1f} {y - 4:.1f}v8M{b:.1f} {y - 4:.1f}v8"'
                ' stroke="var(--ink)" fill="none"/>'
            )
        if fit_rms_px is not None and np.isfinite(fit_rms_px[i]):
            x = float(p.X(np.array(min(fit_rms_px[i], top))))
            out.append(
                f'<path d="M{x:.1f} {y - 11:.1f}v22" stroke="{ORANGE}" stroke-width="2.5">'
                f"<title>fitted views: {fit_rms_px[i]:.4g} px</title></path>"
            )
        words = number(float(rms[i])) + (" ✓" if mine else "") + (" ▸" if rms[i] > top else "")
        out.append(text(476, y + 4, words, "", bold))
    if fit_rms_px is not None:
        out.append(text(532, bottom + 29, "orange: fitted views", "end"))
    out.append(f'<path class="frame" d="M{left:.1f} {p.box[1]:.1f}V{bottom:.1f}H470"/>')
    return svg_of(p, title, out)


def error_ellipses(
    centres: Array,
    covariances: Array,
    labels: Sequence[str],
    unit: str,
    title: str,
    *,
    x_name: str = "x",
    y_name: str = "y",
    sigmas: float = 1.0,
    magnify: float | None = None,
) -> str:
    """Error ellipses about places, magnified where they would be too small to see.

    centres (n, 2) in `unit`; covariances (n, 2, 2) in unit squared; sigmas: how many to draw. magnify: of the ellipses;
    None: a round factor that lets the largest be seen.
    """
    centres, covariances = np.asarray(centres, dtype=float).reshape(-1, 2), np.asarray(covariances, dtype=float)
    if not len(centres):
        p = plane((-1, 1), (-1, 1), equal=True)
        return svg_of(p, title, [*axes(p, title, x_name, y_name), frame(p)])
    values, vectors = np.linalg.eigh(covariances.reshape(-1, 2, 2))
    axes_long = sigmas * np.sqrt(np.maximum(values, 0))
    span = float(np.ptp(centres, axis=0).max()) or 4 * float(axes_long.max()) or 1.0
    if magnify is None:
        wanted = 0.08 * span / max(float(axes_long.max()), 1e-300)
        magnify = 1.0 if wanted <= 2 else 10.0 ** np.floor(np.log10(wanted)) * (5 if np.log10(wanted) % 1 > 0.7 else 1)
    reach = axes_long.max() * magnify + 0.12 * span
    lo, hi = centres.min(axis=0) - reach, centres.max(axis=0) + reach
    p = plane((lo[0], hi[0]), (lo[1], hi[1]), equal=True, tallest=360)
    out = axes(p, title, f"{x_name} ({unit})", f"{y_name} ({unit})")
    turn = np.linspace(0, 2 * np.pi, 49)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    for i, label in enumerate(labels):
        ring = centres[i] + magnify * (vectors[i] @ (axes_long[i][:, None] * circle)).T
        told = f"{label}: {number(float(axes_long[i, 1]))} × {number(float(axes_long[i, 0]))} {unit}"
        d = polyline(p.at(ring), closed=True)
        out.append(
            f'<path d="{d}" fill="{BLUE}" fill-opacity="0.22" stroke="{BLUE}" stroke-width="1.4">'
            f"<title>{escape(told)}</title></path>"
        )
        x, y = p.at(centres[i]).tolist()
        out.append(f'<path d="{dots(p.at(centres[i : i + 1]), 1.6)}" fill="{VERMILLION}"/>')
        if len(labels) <= 40:
            out.append(text(x + 6, y - 6, label))
    note = f"ellipses of {sigmas:g} sigma" + (f", drawn {magnify:,.0f} times too large" if magnify != 1 else "")
    note += f"; largest half-axis {number(float(axes_long.max()))} {unit}"
    out.append(foot(p, note))
    return svg_of(p, title, [*out, frame(p)])


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
    """Drift per camera over the days, with the limits and the day on which the calibration expires."""
    days = [d.toordinal() for line in lines.values() for d in line.dates]
    p_values = [np.asarray(line.values, dtype=float) for line in lines.values()]
    tops = [v + (0 if line.sigmas is None else line.sigmas) for v, line in zip(p_values, lines.values(), strict=True)]
    top = float(np.nanmax(np.concatenate([*tops, np.array([fail or 0.0, warn or 0.0, 1e-6])])))
    today = max(days, default=date(2000, 1, 1).toordinal())
    first, last = min(days, default=today), today
    # The expiry is shown where the axis need not become three times as long for it.
    if expires is not None and expires.toordinal() <= last + max(2 * (last - first), 30):
        last = max(last, expires.toordinal())
    pad = max(0.03 * (last - first), 0.6)
    p = plane((first - pad, last + pad), (0, top * 1.12), height=250)
    left, over, wide, high = p.box
    bottom = over + high
    out = [text(left, 15, f"{title} ({unit})", "title")]
    ys = ticks(0, p.Y.hi, 5)
    out.append(f'<path class="grid" d="{"".join(f"M{left:.1f} {y:.1f}h{wide:.1f}" for y in p.Y(ys))}"/>')
    out += [text(left - 6, float(y) + 3.5, w, "end") for y, w in zip(p.Y(ys), tick_texts(ys), strict=True)]
    for day in _day_ticks(first, last):
        x = float(p.X(np.array(float(day))))
        out.append(f'<path class="grid" d="M{x:.1f} {bottom:.1f}v4"/>')
        out.append(text(x, bottom + 15, date.fromordinal(day).isoformat(), "mid"))
    for limit, colour, words in ((warn, ORANGE, "warning"), (fail, VERMILLION, "not to be used")):
        if limit is not None:
            y = float(p.Y(np.array(limit)))
            out.append(
                f'<path d="M{left:.1f} {y:.1f}h{wide:.1f}" stroke="{colour}"'
                ' stroke-width="1.3" stroke-dasharray="6 3"/>'
            )
            # One label at each end: limits are often too close for two lines of text.
            x, side = (left + 4, "") if limit == warn else (left + wide - 4, "end")
            out.append(text(x, y - 4, f"{words} {number(limit)}", side))
    if expires is not None and expires.toordinal() <= last:
        x = float(p.X(np.array(float(expires.toordinal()))))
        out.append(f'<path d="M{x:.1f} {over:.1f}v{high:.1f}" stroke="{VERMILLION}" stroke-width="1.3"/>')
        out.append(text(x - 4, over + 12, "expires", "end"))
    x_legend = left
    for i, (name, line) in enumerate(lines.items()):
        colour = SERIES[i % len(SERIES)]
        order = np.argsort([d.toordinal() for d in line.dates], kind="stable")
        xs = p.X(np.array([line.dates[k].toordinal() for k in order], dtype=float))
        v = np.asarray(line.values, dtype=float)[order]
        heights = p.Y(v)
        out.append(f'<path class="line" d="{line_path(xs, heights)}" stroke="{colour}" stroke-width="1.6"/>')
        if line.sigmas is not None:
            s = np.asarray(line.sigmas, dtype=float)[order]
            low, up = p.Y(np.maximum(v - s, 0)), p.Y(v + s)
            d = "".join(f"M{a:.1f} {b:.1f}V{c:.1f}" for a, b, c in zip(xs, low, up, strict=True) if np.isfinite(b + c))
            out.append(f'<path d="{d}" stroke="{colour}" stroke-width="1" stroke-opacity="0.7"/>')
        places = dots(np.stack([xs, heights], axis=-1), 3)
        out.append(f'<path d="{places}" fill="{colour}" stroke="var(--paper)" stroke-width="0.7"/>')
        out.append(f'<path d="M{x_legend:.1f} {p.height - 6:.1f}h16" stroke="{colour}" stroke-width="3"/>')
        out.append(text(x_legend + 20, p.height - 2, name))
        x_legend += 34 + 6.4 * len(name)
    return svg_of(p, title, [*out, frame(p)])


def _day_ticks(first: int, last: int) -> list[int]:
    """At most 5 days, evenly spread, whole."""
    count = min(5, last - first + 1)
    return sorted({round(float(d)) for d in np.linspace(first, last, count)})
