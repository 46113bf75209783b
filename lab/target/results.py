"""Verdict words, outcome of a call and summary.json of a tracked target."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.findings import Finding, Level, verdict
from geometry.arrays import Array
from lab.errors import QUALITY_GATE_FAILED
from lab.files.run.fingerprints import fingerprints_of
from lab.files.text.json_text import has_schema
from lab.target.frame_series import MOST_EVENTS, F, FrameSeries
from lab.versions import versions

WORDS = {Level.PASS: "pass", Level.WARN: "check", Level.FAIL: "fail"}
Progress = Callable[[int, int | None], None]  # frames done, total number where known


@dataclass(frozen=True, slots=True)
class TargetOutcome:
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
        remedy = f". {self.findings[0].remedy}" if level is Level.FAIL else ""
        return f"{self.name}: {WORDS[level].upper()}: {reasons}{remedy} -> {self.out}"


@dataclass(frozen=True, slots=True)
class Content:
    """What a command adds to the summary."""

    schema: str
    block: str  # name of its own figures
    figures: dict[str, Any]
    parameters: dict[str, Any]
    targets: str  # name of the number of targets of an event


def exit_status(level: Level) -> int:
    """0, or 4 where a quality gate failed."""
    return QUALITY_GATE_FAILED if level is Level.FAIL else 0


def results_of(schema: str) -> Callable[[Path], bool]:
    """Whether a folder holds the results of an earlier call, by the schema of its summary."""

    def are_results(folder: Path) -> bool:
        return has_schema(folder, schema)

    return are_results


def quantiles(values: Array) -> dict[str, float] | None:
    """5 %, median and 95 % of the finite values; None without one."""
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    return dict(zip(("p5", "median", "p95"), np.percentile(values, [5, 50, 95]).tolist(), strict=True))


def summary_of(
    series: FrameSeries[F],
    findings: Sequence[Finding],
    given: Path,
    content: Content,
    timings_s: tuple[float, float],
) -> dict[str, Any]:
    """The content of summary.json. timings_s: process time of the tracker, wall time of the call."""
    events = series.events(content.targets)
    level = verdict(findings)
    tracking_s, wall_s = timings_s
    return {
        "schema": content.schema,
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
        content.block: content.figures,
        "timings": {"tracking_process_s": tracking_s, "wall_s": wall_s},
        "versions": versions(),
        "parameters": content.parameters,
        "inputs": fingerprints_of((), (given,)),
        "notes": series.notes,
        "events": events[:MOST_EVENTS],
    }
