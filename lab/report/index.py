"""The index page of a folder of runs, with their curves and trends.

A run's content is its row of batch.csv, and what its result folder adds: what cannot be read there is left empty.
"""

from __future__ import annotations

import datetime
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from geometry.arrays import Array, true_ranges
from lab.errors import BeamposeError
from lab.files.run.results import read_result_table, read_summary
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.yaml_text import read_mapping
from lab.findings.finding import Level
from lab.number_format import format_number, format_percent, median
from lab.report.page import environment
from lab.report.plot import svg
from lab.report.plot.series import unwrapped
from lab.report.summary import VERDICTS, day_of, valid
from tracking.statuses import PoseStatus

_LEVELS = tuple(level.word for level in Level)
_ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
_POSITION = ("x_m", "y_m", "z_m")
_SIGMAS = ("sigma_yaw_deg", "sigma_pitch_deg", "sigma_roll_deg", "sigma_x_m", "sigma_y_m", "sigma_z_m")
_NONE = np.zeros((0, 3))


@dataclass(frozen=True, slots=True)
class IndexedRun:
    """A run of a batch. Numbers are None where they are not known."""

    row: Mapping[str, Any]  # of batch.csv
    name: str
    folder: str  # the run folder, as the row gives it
    href: str  # of the report, relative to the index; empty: there is none of this run
    status: str
    frames: int | None
    measured_share: float | None
    rms_px: float | None  # median over the measured frames
    sigma_attitude_deg: float | None  # median over the measured frames of the largest of the three sigmas
    sigma_position_m: float | None
    mean_residual_px: float | None  # length of the mean residual of a camera, the largest of all cameras
    recorded: datetime.date | None
    calibrated: datetime.date | None
    angles_deg: Array  # (F, 3) yaw, pitch, roll without jumps of 360 degrees; nan where lost; F = 0: not known
    position_m: Array  # (F, 3)

    @property
    def word(self) -> str:
        """The verdict as the index shows it."""
        return VERDICTS[self.status][0] if self.status in VERDICTS else self.status.upper()

    @property
    def rank(self) -> int:
        """0 without a verdict, then the worst first."""
        return len(_LEVELS) - _LEVELS.index(self.status) if self.status in _LEVELS else 0

    @property
    def calibration_age(self) -> int | None:
        """Days from the calibration to the recording."""
        return None if self.recorded is None or self.calibrated is None else (self.recorded - self.calibrated).days

    @property
    def badness(self) -> tuple[int, float, float, str]:
        """Sorts runs, the worst first: by verdict, by the share measured, by the residuals, by name."""
        share = -1.0 if self.measured_share is None else self.measured_share
        return self.rank, share, -(self.rms_px or 0.0), self.name


def indexed_run(row: Mapping[str, Any], out: Path) -> IndexedRun:
    """A row of batch.csv, with what its result folder below `out` adds."""
    results = str(row.get("results") or "")
    report = str(row.get("report") or (f"{results}/report.html" if results else ""))
    folder = out / results if results else None
    summary = {} if folder is None else _summary(folder)
    angles, position, medians = _poses(folder)
    return IndexedRun(
        row=row,
        name=str(row["name"]),
        folder=str(row["run"]),
        href=f"./{quote(os.fsencode(report))}" if report and (out / report).is_file() else "",
        status=str(row["status"]),
        frames=valid(int, row.get("frames")),
        measured_share=_number(row.get("measured_share")),
        rms_px=medians[0],
        sigma_attitude_deg=medians[1],
        sigma_position_m=medians[2],
        mean_residual_px=_mean_residual(summary),
        recorded=_recorded(row, summary),
        calibrated=day_of(_at(summary, "calibration", "date")),
        angles_deg=angles,
        position_m=position,
    )


def _summary(folder: Path) -> Mapping[str, Any]:
    try:
        return read_summary(folder)
    except (BeamposeError, OSError, RecursionError):
        return {}


def _at(tree: object, *keys: str) -> Any:
    """The value at nested keys; None where there is none."""
    for key in keys:
        tree = tree.get(key) if isinstance(tree, Mapping) else None
    return tree


def _number(value: object) -> float | None:
    number = None if isinstance(value, bool) else valid(float, value)
    return number if number is not None and np.isfinite(number) else None


def _recorded(row: Mapping[str, Any], summary: Mapping[str, Any]) -> datetime.date | None:
    """The day of the recording, from summary.json or else from the run.yaml that can be reached."""
    if stated := day_of(summary.get("recorded")):
        return stated
    for folder in (str(row["run"]), valid(str, summary.get("run_folder"))):
        path = Path(folder or "") / "run.yaml"
        try:
            if folder and path.is_file() and (stated := day_of(read_mapping(path).get("recorded"))):
                return stated
        except (BeamposeError, OSError, ValueError):
            continue
    return None


def _mean_residual(summary: Mapping[str, Any]) -> float | None:
    """px: the camera whose residuals have the largest mean; it grows when a camera or a screen has moved."""
    groups = _at(summary, "model_check", "cameras")
    means = [valid(list[float], _at(group, "mean_px")) for group in groups] if isinstance(groups, list) else []
    lengths = [math.hypot(*mean) for mean in means if mean is not None]
    return max((length for length in lengths if math.isfinite(length)), default=None)


def _poses(folder: Path | None) -> tuple[Array, Array, tuple[float | None, float | None, float | None]]:
    """Angles (F, 3), deg, position (F, 3), m, and the medians of the measured frames: rms, sigma deg, sigma m."""
    nothing = _NONE, _NONE, (None, None, None)
    if folder is None:
        return nothing
    try:
        table = read_result_table(folder / "attitude.csv", (*_ANGLES, *_POSITION, *_SIGMAS, "rms_px", "status"))
    except (BeamposeError, OSError):
        return nothing
    measured = table.words["status"].recoded((PoseStatus.MEASURED,)) == 0
    sigmas = table.stack(*_SIGMAS)[measured]
    medians = (
        median(table.numbers["rms_px"][measured]),
        median(sigmas[:, :3].max(axis=1)),
        median(sigmas[:, 3:].max(axis=1)),
    )
    return unwrapped(table.stack(*_ANGLES)), table.stack(*_POSITION), medians


# Thumbnails: three curves of a run in one small drawing, with a common scale.

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
        f"{name} {svg.number(span[0])} to {svg.number(span[1])}"
        for name, span in zip(names, spans, strict=True)
        if span
    )
    paths = "".join(
        f'<path class="{css}" d="{_thumbnail_path(values[:, k], span, scale, points)}"/>'
        for k, (css, span) in enumerate(zip("abc", spans, strict=True))
        if span is not None
    )
    return (
        f'<svg class="t" viewBox="0 0 {WIDTH} {HEIGHT}" role="img"><title>{escape(words)} {unit}</title>{paths}</svg>'
    )


def _span(y: Array) -> tuple[float, float] | None:
    finite = y[np.isfinite(y)]
    return (float(finite.min()), float(finite.max())) if finite.size else None


def _thumbnail_path(y: Array, span: tuple[float, float], scale: float, points: int) -> str:
    """The `d` of a curve, in whole viewBox units relative to the point before."""
    n = len(y)
    x, y = svg.envelope(np.arange(n, dtype=float), y, max(points // 2, 1))
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


# Trends of a batch: quantities of its runs over the day of the recording.


_WIDTH, _HEIGHT = 540.0, 150.0
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
    p = svg.PlotArea(svg.Scale(*limits, 54.0, _WIDTH - 10.0), svg.Scale(lo, hi, _HEIGHT - 24.0, 22.0), _WIDTH, _HEIGHT)
    marks = svg.ticks(lo, hi, 4)
    out = [svg.y_ticks(p, marks, svg.tick_texts(marks), grid=True), svg.x_ticks(p, *svg.date_ticks(*limits))]
    days, medians = _medians(day, values)
    if len(days) >= _LEAST_DAYS_OF_A_MEDIAN:
        d = svg.line_path(p.X(days), p.Y(np.clip(medians, lo, hi)))
        out.append(f'<path class="line median" d="{d}"><title>Median of the runs of each day</title></path>')
    status = np.array(statuses)
    for name in dict.fromkeys(statuses):
        which = (status == name) & np.isfinite(values)
        # A line of length zero with round ends is a dot: a tenth of the bytes of a circle.
        places = zip(p.X(day[which]).tolist(), p.Y(np.clip(values[which], lo, hi)).tolist(), strict=True)
        d = "".join(map("M%.0f %.0fh0".__mod__, places))
        css = name if name in _LEVELS else "error"
        out.append(f'<path class="dots {css}" d="{d}"/>')
    if np.nanmax(values) > hi:
        out.append(svg.text(p.X.b, 14, f"▲ up to {format_number(float(np.nanmax(values)))} {unit}", "end"))
    out.append(svg.heading(p, f"{title} ({unit})"))
    return svg.svg_of(p, title, [*out, svg.frame(p, closed=False)])


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


# The index of a batch: one row per run with a link to its report, the worst runs first.


FILE_NAME = "index.html"
_MANY = 500  # runs from which the thumbnails have fewer points
_POINTS = (64, 20)  # per curve of a thumbnail: of few runs, of many
_LEAST_DEG, _LEAST_M = 0.1, 0.001  # ranges that fill a thumbnail's height
# Keys of a row that have a column of their own, or that its other columns imply.
_SHOWN = {
    "run", "name", "folder", "status", "exit_status", "frames", "measured_frames", "measured_share", "seconds",
    "results", "message", "report",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Cell:
    """The text of a cell, its class, and its sort key where the text is not a plain number or word."""

    text: str | Markup
    css: str = ""
    by: str = ""


@dataclass(frozen=True, slots=True)
class Column:
    """A heading, with an explanation and the class of its cells."""

    title: str
    meaning: str = ""
    css: str = ""


def write_index(rows: Sequence[Mapping[str, Any]], out: Path) -> Path:
    """Write index.html into the batch's folder `out`; returns its path.

    rows: those of batch.csv, a mapping per run; other keys become columns. The rest is read from the result folders as
    far as it is there.
    """
    runs = sorted((indexed_run(row, Path(out)) for row in rows), key=lambda run: run.badness)
    above = _common_folder([run.folder for run in runs])
    added = list(dict.fromkeys(key for row in rows for key in row if key not in _SHOWN))
    points = _POINTS[len(runs) > _MANY]
    counts = {(run.rank, run.status): 0 for run in runs}
    for run in runs:
        counts[run.rank, run.status] += 1
    columns = [*_COLUMNS, *(Column(key.replace("_", " ")) for key in added)]
    cells = [[*_cells(run, points), *(_other_cell(run.row.get(key)) for key in added)] for run in runs]
    kept = [i for i in range(len(columns)) if any(row[i].text for row in cells)]  # no column without a value
    word_of = {run.status: run.word for run in reversed(runs)}  # of the first run of each status
    text = environment().get_template("index.html.j2").render(
        columns=[columns[i] for i in kept],
        runs=[
            (run, _path(run, above), _why(run, above), [row[i] for i in kept])
            for run, row in zip(runs, cells, strict=True)
        ],
        above=above, counts=[(status, word_of[status], n) for (_, status), n in counts.items()],
        trends=[Markup(t) for t in trends(runs)], dated=len(dated(runs)),
    )  # fmt: skip
    path = Path(out) / FILE_NAME
    atomic_write_text(text.encode("utf-8", "replace").decode(), path)  # names of folders need not be valid text
    return path


def _common_folder(folders: Sequence[str]) -> str:
    """The folder that the folders of all runs are in, to be stated once; empty if there is none."""
    try:
        above = os.path.commonpath([os.path.dirname(folder) for folder in folders if folder])
    except ValueError:  # no folder, or absolute and relative ones
        return ""
    return "" if above == os.path.sep else above


def _path(run: IndexedRun, above: str) -> str:
    """The run folder below the common one; empty where the name says it."""
    path = os.path.relpath(run.folder, above) if run.folder and above else run.folder
    return "" if path == run.name else path


def _why(run: IndexedRun, above: str) -> str:
    """The message, without the folder that the page states; that of a PASS says no more than the verdict."""
    text = "" if run.status == "pass" else str(run.row.get("message") or "")
    return text.replace(above + os.path.sep, "") if above else text


_COLUMNS = (
    Column("yaw, pitch, roll", "Over time, each about its middle, with one scale; the range in the tooltip", "curve"),
    Column("x, y, z", "Position over time, each about its middle, with one scale; the range in the tooltip", "curve"),
    Column("recorded", "Day of the recording, as run.yaml states it", "day"),
    Column("frames", "Frames of the recording", "n"),
    Column("measured", "Share of the frames with a measured pose", "n"),
    Column("rms (px)", "Median of the residual rms of the measured frames", "n"),
    Column("mean res. (px)", "Largest mean residual of a camera: grows when a camera or a screen has moved", "n"),
    Column("σ\u00a0attitude (°)", "Median over the frames of the largest sigma of yaw, pitch and roll", "n"),
    Column("σ\u00a0position (mm)", "Median over the frames of the largest sigma of x, y and z", "n"),
    Column("calib. age (d)", "Age of the calibration at the recording, days", "n"),
    Column("time (s)", "Duration of the processing", "n"),
)


def _cells(run: IndexedRun, points: int) -> list[Cell]:
    share, mm = run.measured_share, None if run.sigma_position_m is None else 1e3 * run.sigma_position_m
    angles = thumbnail(run.angles_deg, ("yaw", "pitch", "roll"), "°", _LEAST_DEG, points)
    position = thumbnail(run.position_m, ("x", "y", "z"), "m", _LEAST_M, points)
    return [
        Cell(Markup(angles), "curve", _spread(run.angles_deg)),
        Cell(Markup(position), "curve", _spread(run.position_m)),
        Cell("" if run.recorded is None else run.recorded.isoformat(), "day"),
        Cell("" if run.frames is None else str(run.frames), "n"),
        Cell("" if share is None else format_percent(share), "n"),
        _number_cell(run.rms_px),
        _number_cell(run.mean_residual_px),
        _number_cell(run.sigma_attitude_deg),
        _number_cell(mm),
        Cell("" if run.calibration_age is None else str(run.calibration_age), "n"),
        _other_cell(run.row.get("seconds"), 3),
    ]


def _spread(values: Array) -> str:
    """The sort key of a thumbnail: the largest range of its curves."""
    known = [y[np.isfinite(y)] for y in values.T]
    sizes = [float(np.ptp(y)) for y in known if y.size]
    return f"{max(sizes):.3g}" if sizes else ""


def _number_cell(value: float | None, digits: int = 3) -> Cell:
    if value is None:
        return Cell("", "n")
    shown = format_number(value, digits)
    plain = shown.replace(".", "", 1).isdigit()
    return Cell(shown, "n", "" if plain else f"{value:.6g}")


def _other_cell(value: Any, digits: int = 4) -> Cell:
    if value is None or value == "":
        return Cell("")
    if isinstance(value, bool):
        return Cell("yes" if value else "no")
    try:
        number = float(value)
    except (TypeError, ValueError):
        return Cell(str(value))
    if number.is_integer() and abs(number) < 1e9:
        return Cell(str(int(number)), "n")
    return _number_cell(number, digits)
