"""Trends of a batch: quantities of its runs over the day of the recording."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Sequence

import numpy as np

from geometry.arrays import Array
from lab.number_format import format_number
from lab.report.index.indexed_run import IndexedRun
from lab.report.plot.axes import PlotArea, frame, heading, svg_of, x_ticks, y_ticks
from lab.report.plot.scales import Scale, tick_texts, ticks
from lab.report.plot.svg import line_path, text

_WIDTH, _HEIGHT = 540.0, 150.0
_DAYS = (1, 2, 5, 10)  # steps between ticks
_MONTHS = (1, 2, 3, 6, 12, 24, 60, 120, 240, 600, 1200, 2400, 6000, 12000)
_LEAST_DAYS_OF_A_MEDIAN = 4
QUANTITIES: tuple[tuple[str, str, Callable[[IndexedRun], float | None]], ...] = (
    ("Residual rms, median of the run", "px", lambda run: run.rms_px),
    ("Largest mean residual of a camera", "px", lambda run: run.mean_residual_px),
    ("Attitude sigma, median of the run", "deg", lambda run: run.sigma_attitude_deg),
    ("Position sigma, median of the run", "mm", lambda run: _times(run.sigma_position_m, 1e3)),
    ("Share of frames measured", "%", lambda run: _times(run.measured_share, 100.0)),
    ("Age of the calibration at the recording", "days", lambda run: _times(run.calibration_age, 1.0)),
)


def dated(runs: Sequence[IndexedRun]) -> list[IndexedRun]:
    """The runs whose day of recording is known."""
    return [run for run in runs if run.recorded is not None]


def trends(runs: Sequence[IndexedRun]) -> list[str]:
    """An svg element per quantity that at least two days state; none where all runs are of one day."""
    known = dated(runs)
    day = np.array([run.recorded.toordinal() for run in known if run.recorded is not None], dtype=float)
    if len(np.unique(day)) < 2:
        return []
    pad = max(0.5, 0.02 * float(np.ptp(day)))
    limits = float(day.min()) - pad, float(day.max()) + pad
    out = []
    for title, unit, of in QUANTITIES:
        values = np.array([np.nan if (value := of(run)) is None else value for run in known])
        if len(np.unique(day[np.isfinite(values)])) > 1:
            out.append(_trend(day, values, [run.status for run in known], limits, title, unit))
    return out


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


def _trend(
    day: Array, values: Array, statuses: Sequence[str], limits: tuple[float, float], title: str, unit: str
) -> str:
    lo, hi = _value_range(values, unit)
    p = PlotArea(Scale(*limits, 54.0, _WIDTH - 10.0), Scale(lo, hi, _HEIGHT - 24.0, 22.0), _WIDTH, _HEIGHT)
    marks = ticks(lo, hi, 4)
    out = [y_ticks(p, marks, tick_texts(marks), grid=True), x_ticks(p, *date_ticks(*limits))]
    days, medians = _medians(day, values)
    if len(days) >= _LEAST_DAYS_OF_A_MEDIAN:
        d = line_path(p.X(days), p.Y(np.clip(medians, lo, hi)))
        out.append(f'<path class="line median" d="{d}"><title>Median of the runs of each day</title></path>')
    status = np.array(statuses)
    for name in dict.fromkeys(statuses):
        which = (status == name) & np.isfinite(values)
        # A line of length zero with round ends is a dot: a tenth of the bytes of a circle.
        places = zip(p.X(day[which]).tolist(), p.Y(np.clip(values[which], lo, hi)).tolist(), strict=True)
        d = "".join(map("M%.0f %.0fh0".__mod__, places))
        css = name if name in ("pass", "check", "fail") else "error"
        out.append(f'<path class="dots {css}" d="{d}"/>')
    if np.nanmax(values) > hi:
        out.append(text(p.X.b, 14, f"▲ up to {format_number(float(np.nanmax(values)))} {unit}", "end"))
    out.append(heading(p, f"{title} ({unit})"))
    return svg_of(p, title, [*out, frame(p, closed=False)])


def _value_range(values: Array, unit: str) -> tuple[float, float]:
    """From zero (shares: up to 100 %); a few values far above the others do not set the scale."""
    finite = values[np.isfinite(values)]
    low = float(finite.min())
    if unit == "%":
        return (max(0.0, low - 0.1 * (100.0 - low) - 0.5), 100.5)
    usual, high = float(np.percentile(finite, 95)), float(finite.max())
    high = high if high <= 3.0 * usual or usual <= 0 else 1.5 * usual
    low = min(low, 0.0)
    return low, max(low + (high - low) * 1.08, low + 1e-9)


def _medians(day: Array, values: Array) -> tuple[Array, Array]:
    """The days with a value, rising, and the median of each."""
    days = np.unique(day[np.isfinite(values)])
    return days, np.array([np.nanmedian(values[day == d]) for d in days])


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
