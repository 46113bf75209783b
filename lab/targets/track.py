"""Tracks one target through a recording: its table, summary.json, report.html and overlay video."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lab.files.run.fingerprints import fingerprints_of
from lab.files.text.csv_text import write_table
from lab.findings.outcome import Outcome, Verdict
from lab.progress import Progress
from lab.runs.processed import Processed, write_processed
from lab.targets.overlay import write_overlay
from lab.targets.page import write_target_page
from lab.targets.target import F, Target, Track
from lab.targets.verdict import findings_of

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
    return write_processed(out, target.schema, lambda folder: _tracked(target, given, folder, progress), more)


def _tracked(target: Target[F], given: Path, folder: Path, progress: Progress | None) -> Processed[Track[F]]:
    """The track through a recording, whose table and video are written into a folder."""
    track = target.read(given, progress)
    recording, events, findings = track.recording, track.events(), findings_of(target, track)
    write_table(folder / target.table, target.columns, (target.row(track, k) for k in range(len(track.frames))))
    if target.options.overlay:
        write_overlay(target, track, folder)
    blocks: dict[str, Any] = {
        "source": str(recording.path.resolve()),
        "counts": {
            "pictures": recording.pictures,
            "status": track.statuses(),
            "not_measured": {cause.value: count for cause, count in track.causes().items()},
            "no_image_reasons": recording.missing,
            "events": len(events),
        },
        "timings": {"tracking_process_s": track.tracking_s},
        "events": [
            {"frame": number, "kind": f.event, f"{target.subject}s": f.found} for number, f in events[:MOST_EVENTS]
        ],
    }
    for name, value in target.figures(track).items():
        blocks[name] = {**blocks.get(name, {}), **value} if isinstance(value, Mapping) else value
    return Processed(
        schema=target.schema,
        name=recording.name,
        result=track,
        verdict=Verdict(findings),
        frames=len(track.frames),
        measured=int(track.measured.sum()),
        frame_rate_hz=recording.rate_hz,
        parameters=target.parameters(),
        inputs=fingerprints_of((), (recording.path,)),
        notes=recording.notes,
        blocks=blocks,
        page=lambda work, _: write_target_page(target, track, findings, work),
    )
