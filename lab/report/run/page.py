"""The report of one run: a single self-contained HTML file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from lab.errors import InputError
from lab.files.run.run_file import Run
from lab.files.text.atomic_write import atomic_write_text
from lab.report.failure import Failure, files_beside, write_failure_report
from lab.report.html import environment
from lab.report.plot.axes import POSE_COLOURS, SPOT_COLOURS
from lab.report.run import figures, pose_curves, tables, trust
from lab.report.run.blocks.model_fit import HEADS as MODEL_FIT_HEADS
from lab.report.run.blocks.model_fit import model_fit
from lab.report.run.blocks.scene import scene_of
from lab.report.run.events import ShownEvent, events, selected
from lab.report.run.pictures import pictures
from lab.report.run.report_data import ReportData, read_report_data
from lab.report.run.tracks import timeline_figure, tracks_figure, zoom_data
from lab.runs.score.score import ResultTables
from tracking.statuses import PoseStatus, SpotStatus

FILE_NAME = "report.html"
_MOST_EVENTS = 200


def write_report(
    results: Path, run_folder: Path | None = None, run: Run | None = None, result_tables: ResultTables | None = None
) -> Path:
    """Write report.html into a results folder, from its tables alone; returns its path.

    Where the run folder can be read (the one given, or the one that summary.json names), pictures, residuals and
    errors against truth are added. run, result_tables: those of the folders, where they are known already.

    Raises:
        InputError: the tables cannot be read; report.html then says so.
    """
    path = results / FILE_NAME
    try:
        data = read_report_data(results, run_folder, run, result_tables)
    except InputError as error:
        if results.is_dir():
            folder = "" if run_folder is None else str(run_folder)
            write_failure_report(
                path,
                Failure(
                    results.resolve().name, str(error), folder, error.code, error.exit_status, files=files_beside(path)
                ),
            )
        raise
    atomic_write_text(page(data, results), path)
    return path


def page(m: ReportData, results: Path) -> str:
    """The HTML text of a report."""
    found = events(m)
    listed = _event_rows(m, found)
    heads, rows = tables.spot_rows(m)
    fit = model_fit(m.summary.model_check)
    zoom = zoom_data(m)
    method, details = m.summary.method, m.summary.details
    context: dict[str, Any] = {
        "name": m.name,
        "verdict": m.summary.verdict,
        "evidence": trust.evidence(m, fit),
        "methods": trust.methods(m, fit),
        "keys": tables.key_figures(m),
        "truth_keys": tables.truth_figures(m.errors),
        "pixel_rows": tables.pixel_rows(m.errors),
        "run_line": _run_line(m),
        "pose_figure": Markup(pose_curves.pose_figure(m, zoom)),
        "motion_figure": Markup(pose_curves.motion_figure(m, zoom)),
        "smoothed": m.causal is not None,
        "method": method,
        "budget_heads": tables.HEADS,
        "budget_rows": tables.budget_rows(m),
        "budget_words": tables.words(m),
        "tracks": [Markup(t) for c in m.spots.cameras if (t := tracks_figure(m, c, zoom))],
        "scene": scene_of(m.name, None if m.run is None else m.run.rig, m.poses),
        "timeline": Markup(timeline_figure(m)) if len(m.spots.frames) and m.spots.views else "",
        "spot_legend": [(str(s), SPOT_COLOURS[s], s.meaning_for(method)) for s in SpotStatus],
        "pose_legend": [(str(s), POSE_COLOURS[s], s.meaning) for s in PoseStatus],
        "truth_grid": Markup(figures.error_grid(m, columns, zoom=zoom))
        if (columns := figures.truth_columns(m))
        else "",
        "nees_figure": Markup(figures.nees_figure(m, zoom)),
        "rms_figure": Markup(figures.rms_figure(m, zoom)),
        "residual_grid": Markup(figures.error_grid(m, figures.residual_columns(m), zoom=zoom)),
        "residual_known": m.residual_px is not None,
        "model_fit": fit,
        "model_fit_heads": MODEL_FIT_HEADS,
        "model_fit_drawings": [] if fit is None else [Markup(d) for d in fit.drawings],
        "error_rows": tables.error_rows(m.errors),
        "has_truth": m.errors is not None,
        "spot_heads": heads,
        "spot_rows": rows,
        "pictures": [Markup(p) for p in pictures(m, results, selected(m, found))],
        "events": listed[:_MOST_EVENTS],
        "label_words": tables.label_words(m),
        "more_events": max(len(listed) - _MOST_EVENTS, 0),
        "no_image": tables.no_image_ranges(m),
        "notes": m.summary.notes,
        "run_notes": "" if m.run is None else m.run.notes,
        "missing": _missing(m),
        "parameters": details["parameters"],
        "smoother": details["smoother"],
        "timings": details["timings"],
        "rates": details["rates"],
        "versions": details["versions"],
        "inputs": m.summary.inputs,
    }
    context["zoom_data"] = "" if zoom is None else Markup(zoom.encoded())
    return environment().get_template("report.html.j2").render(context)


def _run_line(m: ReportData) -> str:
    parts = []
    if len(m.spots.frames):
        parts.append(f"frames {m.spots.frames[0]} to {m.spots.frames[-1]}")
    if m.run is not None:
        parts.append(f"{m.run.frame_rate_hz:g} Hz")
    cameras = m.spots.cameras
    parts.append(f"{len(cameras)} camera{'s' if len(cameras) != 1 else ''} ({', '.join(cameras)})" if cameras else "")
    parts.append(f"{len(dict.fromkeys(s for _, s in m.spots.views))} spots")
    if m.summary.stated_method:
        parts.append(f"tracker: {m.summary.stated_method}")
    return " · ".join(p for p in parts if p)


def _event_rows(m: ReportData, found: list[ShownEvent]) -> list[tuple[str, str, str, str, str]]:
    """Frame, time, camera and text of each event, and the address of its place in the plots.

    Without occlusions: they are many and in the status figure.
    """
    clock = m.time_name != "frame"
    return [
        (
            str(m.spots.frames[e.index]),
            f"{m.t_s[e.index]:.3f}" if clock else "",
            e.camera,
            e.text,
            trust.time_link(m, e.index, e.index),
        )
        for e in found
        if e.kind != "occluded"
    ]


def _missing(m: ReportData) -> list[str]:
    """The parts that are missing from this report, with the reason."""
    out = []
    if not m.summary.present:
        out.append("summary.json is missing: no verdict, parameters, versions or fingerprints.")
    if not np.array_equal(m.spots.frames, m.poses.frames):
        out.append("spots.csv and attitude.csv have different frames: a file was changed; process the run again.")
    if m.run_folder is None:
        out.append("The run folder could not be read: no pictures, no residuals per spot, no errors against truth.")
    elif m.run is None:
        out.append("The run folder's run.yaml or its rig cannot be read: no pictures and no residuals per spot.")
    if m.run_folder is not None and m.errors is None:
        out.append("The run has no truth: no errors against truth.")
    return out
