"""The report of one run: a single self-contained HTML file.

The scene of a run in three dimensions: two drawings, and data for a scene that turns and follows the cursor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from geometry.rig import Rig
from lab.errors import InputError
from lab.files.run.results import PoseTrack
from lab.files.run.run_file import Run
from lab.files.text.atomic_write import atomic_write_text
from lab.number_format import format_count
from lab.report.calibration.calibration_scene import LAB_VIEWS, scene_views
from lab.report.page import Failure, as_script, environment, files_beside, write_failure_report
from lab.report.plot.svg import POSE_COLOURS, SPOT_COLOURS
from lab.report.run import figures, tables, trust
from lab.report.run.events import ShownEvent, events, pictures, selected
from lab.report.run.figures import timeline_figure, tracks_figure, zoom_data
from lab.report.run.methods import methods
from lab.report.run.report_data import ReportData, read_report_data
from lab.report.run.trust import HEADS as MODEL_FIT_HEADS
from lab.report.run.trust import model_fit
from lab.results.view.page import content_of_poses, scene_data, view_of
from lab.runs.verdict.score import ResultTables
from tracking.statuses import PoseStatus, SpotStatus

_MOMENTS, _POINTS = 40, 160  # of the playback and of the trajectory: together 9 kB
_DIGITS = 3  # of coordinates in m


@dataclass(frozen=True, slots=True)
class ReportScene:
    """What the template shows."""

    stills: list[Markup]
    data: Markup
    frame: int  # of the drawings
    moments: int
    poses: int


def scene_of(name: str, rig: Rig | None, poses: PoseTrack) -> ReportScene | None:
    """The scene of a run; None without its rig, or without a pose."""
    if rig is None or not poses.known.any():
        return None
    content = content_of_poses(name, rig, poses)
    index = content.at_frame(None)
    assert index is not None  # a pose is known
    view = view_of(content, index, most_points=_POINTS, most_ellipsoids=0)
    known = int(np.count_nonzero(content.known))
    data = _packed(scene_data(view, index, _MOMENTS, _DIGITS))
    stills = scene_views([*view.fixed, *view.moving(index)], "Screens, cameras and beams", LAB_VIEWS[:2])
    return ReportScene(
        [Markup(s) for s in stills], as_script(data), int(content.frames[index]), len(data["packed"]), known
    )


def _packed(data: dict[str, Any]) -> dict[str, Any]:
    """The data of `scene_data` in a quarter of the bytes, which view.js expands: whole mm, and each spot's name once.

    A moment is frame, time, whether measured, place of the vehicle, and for each spot its number, its place and, where
    its beam does not start at the vehicle, that start.
    """
    lines = [{**line, "p": [p and _mm(p) for p in line["p"]]} for line in data["lines"]]
    names: list[str] = []
    packed = []
    for moment in data["moments"]:
        *spots, vehicle = moment["s"]
        origin = _mm(vehicle[2:])
        parts = []
        for (name, _, *place), (start, _) in zip(spots, moment["r"], strict=True):
            if name not in names:
                names.append(name)
            begin = _mm(start)
            parts.append([names.index(name), *_mm(place), *([] if begin == origin else begin)])
        packed.append([moment["k"], moment["t"], int(moment["m"]), origin, parts])
    return {"first": data["first"], "lines": lines, "names": names, "packed": packed}


def _mm(place: Sequence[float]) -> list[int]:
    """A place (3,) in m as whole mm."""
    return [round(1000 * v) for v in place]


FILE_NAME = "report.html"
_MOST_EVENTS = 200


def write_report(
    results: Path, run_folder: Path | None = None, run: Run | None = None, result_tables: ResultTables | None = None
) -> Path:
    """Write report.html into a results folder, from its tables alone; returns its path.

    Where the run folder can be read (the one given, or the one that summary.json names), pictures, residuals and errors
    against truth are added. run, result_tables: those of the folders, where they are known already. Raises InputError:
    the tables cannot be read; report.html then says so.
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
        "methods": methods(m, fit),
        "keys": tables.key_figures(m),
        "truth_keys": tables.truth_figures(m.errors),
        "pixel_rows": tables.pixel_rows(m.errors),
        "run_line": _run_line(m),
        "pose_figure": Markup(figures.pose_figure(m, zoom)),
        "motion_figure": Markup(figures.motion_figure(m, zoom)),
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
        "label_words": f"Labels: {'; '.join(labels)}." if (labels := tables.label_counts(m)) else "",
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
        "refined": m.summary.refined,
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
    parts.append(f"{format_count(len(cameras), 'camera')} ({', '.join(cameras)})" if cameras else "")
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
