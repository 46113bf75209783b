"""Counts, events and the verdict of a tracked target."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lab.errors import QUALITY_GATE_FAILED
from lab.files.text.csv_text import write_table
from lab.number_format import format_percent
from lab.targets.point_recording import PointRecording
from tracking.detections import UNMATCHED
from tracking.single_target.parameters import PointParameters, TargetStatus
from tracking.single_target.point_tracker import PointEstimate

GOOD_SHARE = 0.95  # of measured frames; below it the verdict is CHECK
MOST_MISSING = 0.05  # share of missing pictures
LARGEST_NIS = 1.6  # mean of the normalised innovation per number, 1 for a correct model
SIMILAR_SHARE = 0.05  # of the frames in which another target of at least this brightness ...
SIMILAR_FLUX = 0.5  # ... relative to the tracked one is in view


@dataclass(frozen=True, slots=True)
class Reason:
    """One reason of a verdict."""

    fails: bool
    code: str
    what: str
    remedy: str


@dataclass(frozen=True, slots=True)
class PointStatistics:
    """Figures of a track."""

    counts: dict[str, int]  # frames by status
    events: tuple[dict[str, Any], ...]  # acquired, lost and found again, with their frames
    longest_miss: int  # frames predicted in a row
    nis_mean: float  # of measured frames, per number; nan without
    similar_share: float  # of the frames, those with another target of similar brightness
    detections_mean: float  # per picture

    @property
    def frames(self) -> int:
        """Number of frames."""
        return sum(self.counts.values())

    def share(self, status: TargetStatus) -> float:
        """Share of the frames with a status."""
        return self.counts[status.value] / max(self.frames, 1)


def statistics_of(recording: PointRecording, track: list[PointEstimate]) -> PointStatistics:
    """The figures of a track."""
    statuses = [e.status for e in track]
    counts = {s.value: statuses.count(s) for s in TargetStatus}
    events: list[dict[str, Any]] = []
    miss = longest = 0
    for k, status in enumerate(statuses):
        before = statuses[k - 1] if k else TargetStatus.LOST
        miss = miss + 1 if status is TargetStatus.PREDICTED else 0
        longest = max(longest, miss)
        if (before is TargetStatus.LOST) != (status is TargetStatus.LOST):
            again = any(e["kind"] != "lost" for e in events)
            kind = "lost" if status is TargetStatus.LOST else "found again" if again else "acquired"
            events.append({"frame": int(recording.frames[k]), "kind": kind})
    nis = np.array([e.nis for e in track if e.status is TargetStatus.MEASURED])
    pictures = [f for f in recording.found if f is not None]
    return PointStatistics(
        counts,
        tuple(events),
        longest,
        float(np.nanmean(nis)) / 2 if np.isfinite(nis).any() else float("nan"),
        _similar(recording, track),
        sum(map(len, pictures)) / max(len(pictures), 1),
    )


def _similar(recording: PointRecording, track: list[PointEstimate]) -> float:
    """The share of the measured frames with another detection of similar brightness."""
    others = measured = 0
    for found, e in zip(recording.found, track, strict=True):
        if found is None or e.status is not TargetStatus.MEASURED:
            continue
        measured += 1
        flux = found.flux[e.row]
        bright = np.delete(found.flux, e.row) >= SIMILAR_FLUX * flux
        others += bool(bright.any()) if np.isfinite(flux) else len(found) > 1
    return others / max(measured, 1)


def reasons_of(
    recording: PointRecording, statistics: PointStatistics, parameters: PointParameters, min_measured: float
) -> list[Reason]:
    """What is wrong with a track, the worst first. min_measured: the gate of the share of measured frames."""
    measured = statistics.share(TargetStatus.MEASURED)
    pictures = sum(f is not None for f in recording.found)
    out = []
    if not statistics.counts[TargetStatus.MEASURED.value]:
        mean = statistics.detections_mean
        seen = f"{mean:.3g} detection{'' if mean == 1 else 's'} per picture"
        out.append(
            Reason(
                True,
                "BP-N01",
                f"the target was never found: {seen}, none of which moves steadily over {parameters.confirm} pictures",
                "Look at the pictures; choose the detector (--detector) that suits the target, or lower its threshold.",
            )
        )
    elif measured < GOOD_SHARE:
        out.append(
            Reason(
                measured < min_measured,
                "BP-N02",
                f"measured in {format_percent(measured)} of the frames (gate {format_percent(min_measured)}); the"
                f" longest interval without a detection has {statistics.longest_miss} frames",
                "Improve light and contrast, or accept predicted positions with their sigmas.",
            )
        )
    lost = [e["frame"] for e in statistics.events if e["kind"] == "lost"]
    if lost:
        out.append(
            Reason(
                False,
                "BP-N03",
                f"lost at frame {', '.join(map(str, lost[:5]))}{', ...' if len(lost) > 5 else ''}",
                "Check these frames. What is found afterwards has a similar brightness, but can be another target.",
            )
        )
    if statistics.nis_mean > LARGEST_NIS:
        out.append(
            Reason(
                False,
                "BP-N04",
                f"the innovations are {np.sqrt(statistics.nis_mean):.1f} times as large as their sigmas",
                "State a larger --set track.sigma_model_px (the target changes its shape) or track.sigma_a_px (it"
                " accelerates).",
            )
        )
    if statistics.similar_share > SIMILAR_SHARE and parameters.start_px is None:
        out.append(
            Reason(
                False,
                "BP-N05",
                f"another target of similar brightness is in view in {format_percent(statistics.similar_share)} of the"
                " frames",
                "Choose the target with --start U,V.",
            )
        )
    if pictures < (1 - MOST_MISSING) * statistics.frames:
        what = "; ".join(f"{count} {reason}" for reason, count in recording.missing.items())
        out.append(Reason(False, "BP-N06", f"missing pictures: {what}", "Check the camera, its disk and its cable."))
    return out


def status_of(reasons: list[Reason]) -> tuple[str, int]:
    """The word of the verdict (PASS, CHECK, FAIL) and the exit status."""
    if any(r.fails for r in reasons):
        return "FAIL", QUALITY_GATE_FAILED
    return ("CHECK" if reasons else "PASS"), 0


# The outcome of `beampose track point`: the track with its figures and verdict.


@dataclass(frozen=True, slots=True)
class PointOutcome:
    """The outcome of one call."""

    recording: PointRecording
    track: tuple[PointEstimate, ...]
    statistics: PointStatistics
    reasons: tuple[Reason, ...]
    verdict: str
    exit_status: int
    out: Path

    def line(self) -> str:
        """One line for the command line."""
        s = self.statistics
        first = f" ({self.reasons[0].what})" if self.reasons else ""
        measured = format_percent(s.share(TargetStatus.MEASURED))
        return f"{self.verdict} {self.recording.name}: {s.frames} frames, {measured} measured{first} -> {self.out}"


# track.csv: the target's position, velocity and covariance in every frame.


_UPPER = np.triu_indices(4)
COLUMNS = (
    "frame", "t_s", "u_px", "v_px", "sigma_u_px", "sigma_v_px", "status", "predicted_u_px", "predicted_v_px", "nis",
    "measured_u_px", "measured_v_px", "velocity_u_px_frame", "velocity_v_px_frame", "velocity_u_px_s",
    "velocity_v_px_s", *(f"c{i}{j}" for i in range(4) for j in range(i, 4)),
)  # fmt: skip
"""The entries c00 to c33 are the upper triangle of the covariance of u, v (px) and their rates (px/frame)."""


def write_track(recording: PointRecording, track: list[PointEstimate], path: Path) -> None:
    """Write the table: a row per frame number, with empty fields for what is not known.

    Raises:
        InputError: the file cannot be written.
    """
    write_table(path, COLUMNS, (_row(recording, track, k) for k in range(len(track))))


def _row(recording: PointRecording, track: list[PointEstimate], k: int) -> list[object]:
    e, found = track[k], recording.found[k]
    t = None if recording.t_s is None else float(recording.t_s[k])
    measured = [np.nan, np.nan] if found is None or e.row == UNMATCHED else found.uv_px[e.row].tolist()
    rate = np.nan if recording.rate_hz is None else recording.rate_hz
    sigma = np.sqrt(np.diagonal(e.P)[:2]).tolist()
    velocity = [*e.x[2:].tolist(), *(e.x[2:] * rate).tolist()]
    numbers = [*measured, *velocity, *e.P[_UPPER].tolist()]
    return [
        int(recording.frames[k]),
        _number(t),
        *map(_number, (*e.x[:2].tolist(), *sigma)),
        e.status.value,
        *map(_number, (*e.predicted_px.tolist(), e.nis)),
        *map(_number, numbers),
    ]


def _number(value: float | None) -> str:
    """Ten significant digits; empty for None and nan."""
    return "" if value is None or value != value else f"{value:.10g}"
