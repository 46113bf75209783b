"""`beampose track point`: the centre of one target over a recording, with table, summary, report and overlay video."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lab.errors import InputError
from lab.files.run.fingerprints import fingerprints_of
from lab.files.run.parameter_overrides import with_overrides
from lab.files.text.atomic_write import atomic_folder
from lab.files.text.json_text import has_schema, write_json
from lab.targets.point_recording import DETECTORS, TABLE, Progress, read_recording
from lab.targets.point_results import PointOutcome, reasons_of, statistics_of, status_of, write_track
from lab.versions import versions
from tracking.parameters import DetectParameters
from tracking.single_target.parameters import BlobParameters, PointParameters, TargetStatus
from tracking.single_target.point_tracker import track_point

SCHEMA = "beampose/track-point/1"
OVERLAY = "overlay.mp4"


@dataclass(frozen=True, slots=True)
class PointSettings:
    """All parameters that --set can replace, as NAME=VALUE with dotted names."""

    track: PointParameters = field(default_factory=PointParameters)
    detect: DetectParameters = field(default_factory=DetectParameters)  # of the detector `spots`
    blobs: BlobParameters = field(default_factory=BlobParameters)  # of the detectors `darker`, `brighter`, `colour`


@dataclass(frozen=True, slots=True)
class PointOptions:
    """The options of the command."""

    detector: str = "spots"  # one of DETECTORS; not used for a table
    start_px: tuple[float, float] | None = None  # where the target is at the start
    rate_hz: float | None = None  # frames per second; None: of the video or the table
    camera: str | None = None  # of a table with several
    limit: int | None = None  # largest number of pictures
    min_measured: float = 0.5  # the gate: least share of measured frames
    overlay: bool = False  # also write a video with the track
    overrides: Mapping[str, Any] = field(default_factory=dict)  # of PointSettings
    colour: str | None = None  # of the detector `colour`: a name or #rrggbb

    def settings(self) -> PointSettings:
        """The parameters. Raises InputError: an override is not one of them, or the detector does not exist."""
        if self.detector not in DETECTORS:
            raise InputError(f"--detector: expected one of {', '.join(DETECTORS)}, got {self.detector!r}")
        made = with_overrides(PointSettings(), self.overrides)
        track = made.track if self.start_px is None else dataclasses.replace(made.track, start_px=self.start_px)
        polarity: Any = self.detector if self.detector in ("darker", "brighter") else made.blobs.polarity
        return dataclasses.replace(made, track=track, blobs=dataclasses.replace(made.blobs, polarity=polarity))


def track_target(
    path: Path, out: Path, options: PointOptions = PointOptions(), progress: Progress | None = None
) -> PointOutcome:
    """Track one target and write track.csv, summary.json, report.html, and overlay.mp4 on request, into `out`.

    Raises:
        InputError: the path or an option cannot be used; `out` is then unchanged.
    """
    started = time.perf_counter()
    settings = options.settings()
    if options.overlay and path.suffix.lower() == ".csv":
        raise InputError(f"{path}: expected pictures or a video for --overlay, got a table")
    with atomic_folder(out, may_replace=is_a_track) as folder:
        recording = read_recording(
            path, options.detector, settings.detect, settings.blobs, options.rate_hz, options.camera, options.limit,
            progress, options.colour,
        )  # fmt: skip
        track = track_point(recording.steps, recording.found, settings.track)
        statistics = statistics_of(recording, track)
        reasons = reasons_of(recording, statistics, settings.track, options.min_measured)
        verdict, exit_status = status_of(reasons)
        outcome = PointOutcome(recording, tuple(track), statistics, tuple(reasons), verdict, exit_status, Path(out))
        write_track(recording, track, folder / "track.csv")
        if options.overlay:
            from lab.targets.point_overlay import write_overlay  # only on request

            write_overlay(recording, track, folder / OVERLAY, options.limit)
        write_json(_summary(outcome, settings, options, time.perf_counter() - started), folder / "summary.json")
        from lab.targets.point_page import write_point_page  # imports the template engine, needed only here

        write_point_page(outcome, folder)
    return outcome


def is_a_track(folder: Path) -> bool:
    """Whether a folder holds the results of an earlier call."""
    return has_schema(folder, SCHEMA)


def _summary(outcome: PointOutcome, settings: PointSettings, options: PointOptions, wall_s: float) -> dict[str, Any]:
    recording, statistics = outcome.recording, outcome.statistics
    used = {"track": settings.track}
    if recording.detector != TABLE:
        used |= {"detect": settings.detect} if recording.detector == "spots" else {"blobs": settings.blobs}  # type: ignore[dict-item]
    return {
        "schema": SCHEMA,
        "name": recording.name,
        "source": str(recording.path.resolve()),
        "detector": recording.detector,
        "verdict": {
            "status": outcome.verdict,
            "reasons": [r.what for r in outcome.reasons],
            "exit_status": outcome.exit_status,
            "evidence": [{"code": r.code, "fails": r.fails, "remedy": r.remedy} for r in outcome.reasons],
        },
        "counts": {
            "frames": statistics.frames,
            "status": statistics.counts,
            "longest_interval_predicted": statistics.longest_miss,
            "detections_per_picture": statistics.detections_mean,
            "no_picture": recording.missing,
        },
        "rates": {
            "measured_share": statistics.share(TargetStatus.MEASURED),
            "frame_rate_hz": recording.rate_hz,
            "nis_per_number": statistics.nis_mean,
        },
        "parameters": {
            **{name: dataclasses.asdict(value) for name, value in used.items()},
            **({} if options.colour is None else {"colour": options.colour}),
            "min_measured": options.min_measured,
            "limit": options.limit,
        },
        "timings": {"wall_s": wall_s},
        "versions": versions(),
        "inputs": fingerprints_of((), (recording.path,)),
        "notes": recording.notes,
        "events": list(statistics.events),
    }
