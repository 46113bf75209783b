"""Tracks a circle through a video or a folder of pictures; writes circle.csv, summary.json, report.html and a video."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from calibration.findings import Finding, Level, verdict
from lab.detect.frame_series import MOST_EVENTS, every_frame, frame_rate
from lab.detect.inputs import open_inputs
from lab.drogue_circle.circle_table import CIRCLE, circle_row
from lab.drogue_circle.options import CircleOptions
from lab.drogue_circle.overlay import OverlayVideo, label_of
from lab.drogue_circle.series import CircleSeries
from lab.drogue_circle.verdict import WORDS, exit_status, findings_of
from lab.files.run.fingerprints import fingerprints_of
from lab.files.text.atomic_write import atomic_folder
from lab.files.text.csv_text import write_table
from lab.files.text.json_text import write_json
from lab.pictures.picture_file import MissingPicture
from lab.versions import versions

SCHEMA = "beampose/circle/1"
DEFAULTS = CircleOptions()

Progress = Callable[[int, int | None], None]  # frames done, total number where known


@dataclass(frozen=True, slots=True)
class CircleOutcome:
    """The outcome of one call."""

    name: str
    out: Path
    frames: int
    measured: int
    findings: tuple[Finding, ...]  # failures first

    @property
    def exit_status(self) -> int:
        """0, or 4 where a quality gate failed."""
        return exit_status(verdict(self.findings))

    def line(self) -> str:
        """One line for the command line; where a gate failed, with the remedy."""
        level = verdict(self.findings)
        reasons = "; ".join(f.what for f in self.findings if f.level is level)
        if level is Level.WARN:
            reasons = f"{self.measured} of {self.frames} frames measured; {reasons}"
        remedy = f" {self.findings[0].remedy}" if level is Level.FAIL else ""
        return f"{self.name}: {WORDS[level].upper()}: {reasons}{remedy} -> {self.out}"


def track_circle(
    given: Path,
    out: Path,
    options: CircleOptions = DEFAULTS,
    progress: Progress | None = None,
    more: Mapping[str, Any] | None = None,
) -> CircleOutcome:
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
    with atomic_folder(out, may_replace=are_circle_results) as folder:
        tracking_s = 0.0
        with OverlayVideo(folder, rate_hz) if options.overlay else contextlib.nullcontext() as overlay:
            total = inputs.count(1)
            for number, picture in islice(every_frame(inputs), options.limit):
                usable = None if isinstance(picture, MissingPicture) else picture
                begun = time.process_time()
                frame = tracker.step(usable)
                tracking_s += time.process_time() - begun
                series.add(number, frame)
                series.count(picture)
                if overlay is not None:
                    label = label_of(number, frame.status, frame.cause.value)
                    overlay.add(usable, label, frame.status, frame.state[:3])
                if progress is not None:
                    progress(len(series.frames), total)
        series.require_pictures(given, total, options.limit)
        findings = findings_of(series)
        rows = (circle_row(n, rate_hz, f) for n, f in zip(series.numbers, series.frames, strict=True))
        write_table(folder / "circle.csv", CIRCLE, rows)
        summary = _summary(series, options, findings, given, tracking_s, time.perf_counter() - started)
        write_json({**summary, **(more or {})}, folder / "summary.json")
        from lab.drogue_circle.page import write_circle_page  # imports the template engine, needed only here

        write_circle_page(series, findings, options, folder)
    return CircleOutcome(
        series.name, Path(out), len(series.frames), summary["counts"]["status"]["measured"], tuple(findings)
    )


def are_circle_results(folder: Path) -> bool:
    """Whether a folder holds the results of an earlier call."""
    try:
        return bool(json.loads((folder / "summary.json").read_text("utf-8")).get("schema") == SCHEMA)
    except (OSError, ValueError, AttributeError):
        return False


def _summary(
    series: CircleSeries,
    options: CircleOptions,
    findings: list[Finding],
    given: Path,
    tracking_s: float,
    wall_s: float,
) -> dict[str, Any]:
    measured = np.isfinite(series.fits[:, 0])
    quality = series.quality()
    events = series.events()
    level = verdict(findings)

    def quantiles(values: np.ndarray) -> dict[str, float] | None:
        values = values[np.isfinite(values)]
        if not len(values):
            return None
        return dict(zip(("p5", "median", "p95"), np.percentile(values, [5, 50, 95]).tolist(), strict=True))

    return {
        "schema": SCHEMA,
        "name": series.name,
        "source": str(given.resolve()),
        "verdict": {
            "status": WORDS[level],
            "reasons": [f.what for f in findings],
            "exit_status": exit_status(level),
            "evidence": [
                {"level": WORDS[f.level], "what": f.what, "why": f.why, "remedy": f.remedy, "code": f.code}
                for f in findings
            ],
        },
        "counts": {
            "frames": len(series.frames),
            "pictures": series.pictures,
            "status": series.statuses(),
            "not_measured": series.causes(),
            "no_image_reasons": dict(series.missing),
            "events": len(events),
        },
        "rates": {
            "measured_share": series.statuses()["measured"] / len(series.frames),
            "frame_rate_hz": series.rate_hz,
            "processed_frames_per_s": len(series.frames) / wall_s if wall_s > 0 else None,
        },
        "circle": {
            "radius_px": quantiles(series.states[:, 2]),
            "sigma_centre_px": quantiles(np.hypot(*series.sigmas[:, :2].T)[measured]),
            "occlusion": quantiles(quality[:, 0]),
            "coverage": quantiles(quality[:, 1]),
            "rms_px": quantiles(quality[:, 2]),
        },
        "timings": {"tracking_process_s": tracking_s, "wall_s": wall_s},
        "versions": versions(),
        "parameters": options.as_mapping(),
        "inputs": fingerprints_of((), (given,)),
        "notes": series.notes,
        "events": events[:MOST_EVENTS],
    }
