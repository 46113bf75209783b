"""The index of a batch: one row per run with a link to its report, the worst runs first."""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from geometry.arrays import Array
from lab.files.text.atomic_write import atomic_write_text
from lab.number_format import format_number
from lab.report.html import environment
from lab.report.index.indexed_run import LINK, NAME, VERDICT, IndexedRun, indexed_run
from lab.report.index.thumbnails import thumbnail
from lab.report.index.trends import dated, trends

FILE_NAME = "index.html"
_MANY = 500  # runs from which the thumbnails have fewer points
_POINTS = (64, 20)  # per curve of a thumbnail: of few runs, of many
_LEAST_DEG, _LEAST_M = 0.1, 0.001  # ranges that fill a thumbnail's height
# Keys of a row that have a column of their own, or that its other columns imply.
_SHOWN = {
    *NAME, *VERDICT, *LINK, "folder", "frames", "measured_share", "measured_frames", "exit_status", "seconds",
    "message",
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

    rows: those of batch.csv, a mapping per run. Known keys: `name`, `run` (its folder), `status` (or `verdict`): pass,
    check, fail or error, `report` or `results` (a path relative to `out`; default: the folder of the run's name, but
    none for an error), `frames`, `measured_share`, `seconds`, `message`. Every other key becomes a column. The rest is
    read from the result folders as far as it is there. The row of an error links a report only if the row names it and
    its summary.json has no verdict of an earlier processing.
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
    script = environment().get_template("index.js").render().strip()
    text = (
        environment()
        .get_template("index.html.j2")
        .render(
            columns=[columns[i] for i in kept],
            runs=[
                (run, _path(run, above), _why(run, above), [row[i] for i in kept])
                for run, row in zip(runs, cells, strict=True)
            ],
            above=above,
            counts=[(status, _word(runs, status), n) for (_, status), n in counts.items()],
            trends=[Markup(t) for t in trends(runs)],
            dated=len(dated(runs)),
            script=Markup(script),
            script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        )
    )
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


def _word(runs: Sequence[IndexedRun], status: str) -> str:
    return next(run.word for run in runs if run.status == status)


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
        Cell("" if share is None else _percent(share), "n"),
        _number_cell(run.rms_px),
        _number_cell(run.mean_residual_px),
        _number_cell(run.sigma_attitude_deg),
        _number_cell(mm),
        Cell("" if run.calibration_age is None else str(run.calibration_age), "n"),
        _other_cell(run.row.get("seconds"), 3),
    ]


def _percent(share: float) -> str:
    """With one decimal; 100 % and 0 % mean exactly all and none."""
    if share in (0.0, 1.0):
        return f"{100 * share:.0f} %"
    return f"{min(max(100 * share, 0.1), 99.9):.1f} %"


def _spread(values: Array) -> str:
    """The sort key of a thumbnail: the largest range of its curves."""
    known = [y[np.isfinite(y)] for y in values.T]
    sizes = [float(np.ptp(y)) for y in known if y.size]
    return f"{max(sizes):.3g}" if sizes else ""


def _number_cell(value: float | None) -> Cell:
    return Cell("", "n") if value is None else _shown(value, 3)


def _shown(value: float, digits: int) -> Cell:
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
    return _shown(number, digits)
