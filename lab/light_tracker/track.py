"""Tracks a drogue through a video or pictures; writes drogue.csv, summary.json, report.html and a video."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lab.detect.inputs import open_inputs
from lab.files.text.atomic_write import atomic_folder
from lab.files.text.csv_text import write_table
from lab.files.text.json_text import write_json
from lab.light_tracker.drogue_table import DROGUE, drogue_row
from lab.light_tracker.options import DrogueOptions
from lab.light_tracker.series import DrogueSeries
from lab.light_tracker.verdict import findings_of
from lab.target.follow import follow
from lab.target.frame_series import frame_rate
from lab.target.results import Content, Progress, TargetOutcome, quantiles, results_of, summary_of
from tracking.light_tracker.frames import DrogueFrame
from tracking.statuses import PoseStatus

SCHEMA = "beampose/drogue/1"
DEFAULTS = DrogueOptions()


def track_drogue(
    given: Path,
    out: Path,
    options: DrogueOptions = DEFAULTS,
    progress: Progress | None = None,
    more: Mapping[str, Any] | None = None,
) -> TargetOutcome:
    """Track one drogue through the pictures of a folder or a video, and write the results into the folder `out`.

    more: additional content of summary.json.

    Raises:
        InputError: the input or an option cannot be used, or no picture can be read; `out` is then unchanged.
    """
    started = time.perf_counter()
    tracker = options.tracker()
    inputs = open_inputs([given])
    rate_hz, notes = frame_rate(inputs, options.rate_hz)
    series = DrogueSeries(name=inputs.camera, source=str(given), rate_hz=rate_hz, notes=[*inputs.notes, *notes])
    with atomic_folder(out, may_replace=results_of(SCHEMA)) as folder:
        overlay = folder if options.overlay else None
        tracking_s = follow(series, inputs, given, tracker.step, _circle, overlay, options.limit, progress)
        findings = findings_of(series)
        rows = (drogue_row(n, rate_hz, f) for n, f in zip(series.numbers, series.frames, strict=True))
        write_table(folder / "drogue.csv", DROGUE, rows)
        content = Content(SCHEMA, "drogue", _figures(series), options.as_mapping(), "drogues")
        summary = summary_of(series, findings, given, content, (tracking_s, time.perf_counter() - started))
        write_json({**summary, **(more or {})}, folder / "summary.json")
        from lab.light_tracker.page import write_drogue_page  # imports the template engine, needed only here

        write_drogue_page(series, findings, options, folder)
    measured = int(series.has_status(PoseStatus.MEASURED).sum())
    return TargetOutcome(series.name, Path(out), len(series.frames), measured, tuple(findings))


def _circle(frame: DrogueFrame) -> np.ndarray:
    return np.array([*frame.centre_px, frame.diameter_px / 2])


def _figures(series: DrogueSeries) -> dict[str, Any]:
    measured = series.has_status(PoseStatus.MEASURED)
    checks, confirmed = series.checks()
    return {
        "diameter_px": quantiles(series.circles[:, 2]),
        "sigma_centre_px": quantiles(np.hypot(*series.sigmas[:, :2].T)[measured]),
        "confidence": quantiles(series.confidences[measured]),
        "correlation": quantiles(series.correlations[measured]),
        "sources": series.sources(),
        "detector_searched": series.searches(),
        "checks": checks,
        "confirmed_checks": confirmed,
    }
