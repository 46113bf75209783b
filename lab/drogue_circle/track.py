"""Tracks a circle through a video or a folder of pictures; writes circle.csv, summary.json, report.html and a video."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lab.detect.inputs import open_inputs
from lab.drogue_circle.circle_table import CIRCLE, circle_row
from lab.drogue_circle.options import CircleOptions
from lab.drogue_circle.series import CircleSeries
from lab.drogue_circle.verdict import findings_of
from lab.files.text.atomic_write import atomic_folder
from lab.files.text.csv_text import write_table
from lab.files.text.json_text import write_json
from lab.target.follow import follow
from lab.target.frame_series import frame_rate
from lab.target.results import Content, Progress, TargetOutcome, quantiles, results_of, summary_of

SCHEMA = "beampose/circle/1"
DEFAULTS = CircleOptions()


def track_circle(
    given: Path,
    out: Path,
    options: CircleOptions = DEFAULTS,
    progress: Progress | None = None,
    more: Mapping[str, Any] | None = None,
) -> TargetOutcome:
    """Track one circle through the pictures of a folder or a video, and write the results into the folder `out`.

    more: additional content of summary.json.

    Raises:
        InputError: the input or an option cannot be used, or no picture can be read; `out` is then unchanged.
    """
    started = time.perf_counter()
    tracker = options.tracker()
    inputs = open_inputs([given])
    rate_hz, notes = frame_rate(inputs, options.rate_hz)
    series = CircleSeries(
        name=inputs.camera, source=str(given), rate_hz=rate_hz, form=options.form, notes=[*inputs.notes, *notes]
    )
    with atomic_folder(out, may_replace=results_of(SCHEMA)) as folder:
        overlay = folder if options.overlay else None
        tracking_s = follow(
            series, inputs, given, tracker.step, lambda frame: frame.state[:3], overlay, options.limit, progress
        )
        findings = findings_of(series)
        rows = (circle_row(n, rate_hz, f) for n, f in zip(series.numbers, series.frames, strict=True))
        write_table(folder / "circle.csv", CIRCLE, rows)
        summary = summary_of(
            series, findings, given,
            Content(SCHEMA, "circle", _summary_block(series), options.as_mapping(), "circles"),
            (tracking_s, time.perf_counter() - started),
        )  # fmt: skip
        write_json({**summary, **(more or {})}, folder / "summary.json")
        from lab.drogue_circle.page import write_circle_page  # imports the template engine, needed only here

        write_circle_page(series, findings, options, folder)
    return TargetOutcome(
        series.name, Path(out), len(series.frames), summary["counts"]["status"]["measured"], tuple(findings)
    )


def _summary_block(series: CircleSeries) -> dict[str, Any]:
    measured = np.isfinite(series.fits[:, 0])
    quality = series.quality()
    return {
        "radius_px": quantiles(series.states[:, 2]),
        "sigma_centre_px": quantiles(np.hypot(*series.sigmas[:, :2].T)[measured]),
        "occlusion": quantiles(quality[:, 0]),
        "coverage": quantiles(quality[:, 1]),
        "rms_px": quantiles(quality[:, 2]),
    }
