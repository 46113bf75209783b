"""Tracks one target through a recording: its table, summary.json, report.html and overlay video."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lab.files.run.fingerprints import fingerprints_of
from lab.files.text.atomic_write import atomic_folder
from lab.files.text.csv_text import write_table
from lab.files.text.json_text import has_schema, write_json
from lab.findings.finding import Finding
from lab.progress import Progress
from lab.targets.overlay import write_overlay
from lab.targets.page import write_target_page
from lab.targets.target import F, Target, Track
from lab.targets.verdict import Outcome, findings_of, verdict_block
from lab.versions import versions

MOST_EVENTS = 500  # listed in summary.json; of the others the number is reported


def track_target(
    target: Target[F], given: Path, out: Path, progress: Progress | None = None, more: Mapping[str, Any] | None = None
) -> Outcome[Track[F]]:
    """Track one target, and write the results into the folder `out`.

    more: additional content of summary.json.

    Raises:
        InputError: the input or an option cannot be used, or no picture can be read; `out` is then unchanged.
        RunError: OpenCV cannot write the video.
    """
    started = time.perf_counter()
    with atomic_folder(out, may_replace=lambda folder: has_schema(folder, target.schema)) as folder:
        track = target.read(given, progress)
        findings = findings_of(target, track)
        write_table(folder / target.table, target.columns, (target.row(track, k) for k in range(len(track.frames))))
        if target.options.overlay:
            write_overlay(target, track, folder)
        summary = _summary(target, track, findings, time.perf_counter() - started)
        write_json({**summary, **(more or {})}, folder / "summary.json")
        write_target_page(target, track, findings, folder)
    measured = int(track.measured.sum())
    return Outcome(track.recording.name, Path(out), len(track.frames), measured, findings, track)


def _summary(target: Target[F], track: Track[F], findings: Sequence[Finding], wall_s: float) -> dict[str, Any]:
    recording, events = track.recording, track.events()
    content: dict[str, Any] = {
        "schema": target.schema,
        "name": recording.name,
        "source": str(recording.path.resolve()),
        "verdict": verdict_block(findings),
        "counts": {
            "frames": len(track.frames),
            "pictures": recording.pictures,
            "status": track.statuses(),
            "not_measured": {cause.value: count for cause, count in track.causes().items()},
            "no_image_reasons": recording.missing,
            "events": len(events),
        },
        "rates": {
            "measured_share": float(track.measured.mean()),
            "frame_rate_hz": recording.rate_hz,
            "processed_frames_per_s": len(track.frames) / wall_s if wall_s > 0 else None,
        },
        "timings": {"tracking_process_s": track.tracking_s, "wall_s": wall_s},
        "versions": versions(),
        "parameters": target.parameters(),
        "inputs": fingerprints_of((), (recording.path,)),
        "notes": recording.notes,
        "events": [
            {"frame": number, "kind": f.event, f"{target.subject}s": f.found} for number, f in events[:MOST_EVENTS]
        ],
    }
    for name, value in target.figures(track).items():
        content[name] = {**content.get(name, {}), **value} if isinstance(value, Mapping) else value
    return content
