"""`beampose track drogue`: a refuelling drogue, by the learned detector and the light tracker (Zhou 2020)."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geometry.arrays import Array
from lab.errors import InputError
from lab.findings.finding import Finding, Level, finding
from lab.number_format import format_percent
from lab.progress import Progress
from lab.report.page import PageTable, Section
from lab.report.plot.series import Line
from lab.report.plot.svg import BLUE, VERMILLION
from lab.runs.processed import quantiles
from lab.targets.page import TimeAxis
from lab.targets.target import Codes, Target, Track, TrackOptions, texts, track_pictures
from tracking.learned_detector.detector import learned_detector
from tracking.light_tracker.frames import DrogueFrame, LightParameters, MeasuredBy
from tracking.light_tracker.tracker import DrogueTracker
from tracking.statuses import PoseStatus

GOOD_CONFIDENCE = 0.8  # mean of the measured frames
LEAST_CONFIRMED = 0.5  # share of the checks in which the detector finds the drogue
_LEAST_CHECKS = 5  # with fewer, that share is not judged


@dataclass(frozen=True, slots=True)
class DrogueOptions(TrackOptions):
    """Which drogue to track, and how."""

    near_px: tuple[float, float] | None = None  # centre of the first drogue, within 20 px or its radius
    check_every: int = LightParameters().check_every  # frames between two checks by the detector
    smallest_px: float = LightParameters().smallest_px  # diameters that are looked for
    largest_px: float | None = None  # None: the picture's smaller side

    def parameters(self) -> LightParameters:
        """The parameters of the tracker. Raises InputError: the diameters do not make a range."""
        if self.largest_px is not None and self.largest_px <= self.smallest_px:
            raise InputError(
                f"--max-diameter: expected more than --min-diameter ({self.smallest_px:g} px), got {self.largest_px:g}"
            )
        return LightParameters(check_every=self.check_every, smallest_px=self.smallest_px, largest_px=self.largest_px)

    def tracker(self) -> DrogueTracker:
        """A tracker before its first picture. Raises InputError as `parameters` does."""
        parameters = self.parameters()
        largest = None if self.largest_px is None else self.largest_px / 2
        return DrogueTracker(learned_detector(self.smallest_px / 2, largest), parameters, self.near_px)


# drogue.csv: a row for every frame number from the first to the last, dropped ones too.


DROGUE = (
    "frame", "t_s", "u_px", "v_px", "diameter_px", "sigma_u_px", "sigma_v_px", "sigma_diameter_px", "status", "cause",
    "confidence", "source", "correlation", "rate_u_px_s", "rate_v_px_s", "cov_uv_px2", "searched", "found", "event",
)  # fmt: skip


class DrogueTarget(Target[DrogueFrame]):
    """A drogue as a whole."""

    schema, table, columns = "beampose/drogue/1", "drogue.csv", DROGUE
    subject, size_name, size_radii, several = "drogue", "diameter", 2.0, "several drogues"
    codes = Codes(none="BP-G01", few="BP-G02", missing="BP-G03", ambiguous="BP-G04", far="BP-G05")
    far_sizes, far_words = 1.0, "a diameter"
    options: DrogueOptions

    def __init__(self, options: DrogueOptions = DrogueOptions()) -> None:
        self.options = options
        self.tracker = options.tracker()

    def read(self, path: Path, progress: Progress | None) -> Track[DrogueFrame]:
        return track_pictures(path, self.tracker.step, self.options, progress)

    def row(self, track: Track[DrogueFrame], k: int) -> list[object]:
        number, rate_hz, frame = int(track.recording.numbers[k]), track.recording.rate_hz, track.frames[k]
        assert rate_hz is not None  # assumed where it is not stated
        return [
            number,
            f"{number / rate_hz:.9g}",
            *texts([*frame.place, *frame.sigmas]),
            frame.status.value,
            frame.cause.value,
            *texts([frame.confidence]),
            frame.source.value,
            *texts([frame.correlation, *(rate_hz * frame.rate_px)]),
            *texts([frame.covariance[0, 1]], 7),
            frame.searched,
            frame.found if frame.searched else "",
            frame.event,
        ]

    def findings(self, track: Track[DrogueFrame]) -> list[Finding]:
        """A low confidence, or checks in which the detector does not find the drogue."""
        out = []
        if track.measured.any() and (mean := float(_confidences(track)[track.measured].mean())) < GOOD_CONFIDENCE:
            what = f"the mean confidence of the measured frames is {mean:.2f} (usual: {GOOD_CONFIDENCE} and more)"
            out.append(finding("BP-G06", Level.WARN, what))
        checks, confirmed = _checks(track)
        if checks >= _LEAST_CHECKS and confirmed < LEAST_CONFIRMED * checks:
            what = f"the detector finds the drogue in {format_percent(confirmed / checks)} of its {checks} checks"
            out.append(finding("BP-G07", Level.WARN, what))
        return out

    def figures(self, track: Track[DrogueFrame]) -> dict[str, Any]:
        searches = Counter(f.searched or "none" for f in track.frames)
        checks, confirmed = _checks(track)
        block = {
            "diameter_px": quantiles(track.places[:, 2]),
            "sigma_centre_px": quantiles(np.hypot(*track.sigmas[:, :2].T)[track.measured]),
            "confidence": quantiles(_confidences(track)[track.measured]),
            "correlation": quantiles(_correlations(track)[track.measured]),
            "sources": {source.value: count for source, count in _sources(track).items()},
            "detector_searched": {name: searches[name] for name in ("none", "window", "picture", "both")},
            "checks": checks,
            "confirmed_checks": confirmed,
        }
        return {"drogue": block}

    def parameters(self) -> dict[str, Any]:
        return {"options": asdict(self.options), "tracker": asdict(self.options.parameters())}

    def method(self) -> str:
        return f"learned detector, checks every {self.options.check_every} frames; light tracker between them"

    def key_figures(self, track: Track[DrogueFrame]) -> list[tuple[str, str, str]]:
        confidence = _confidences(track)[track.measured]
        words = f"mean of the measured frames; smallest {confidence.min():.2f}"
        out = [("Confidence", f"{confidence.mean():.2f}", words)]
        checks, confirmed = _checks(track)
        if checks:
            out.append(("Checks", format_percent(confirmed / checks), f"confirmed by the detector; {checks} checks"))
        return out

    def sections(self, track: Track[DrogueFrame]) -> list[Section]:
        confidence: Array = np.where(track.has_status(PoseStatus.LOST), np.nan, _confidences(track))
        drawing = TimeAxis.of(track).panel(
            "Confidence (blue) and correlation of the match (orange)", "", Line(confidence, BLUE, "confidence"),
            Line(_correlations(track), VERMILLION, "correlation"), y_range=(0.0, 1.05), height=170,
        )  # fmt: skip
        words = (
            "The confidence is the probability that the centre is right to a quarter of the diameter. It comes from the"
            " detector's checks of the drogue and was fitted on rendered drogues. Of a predicted frame it falls with"
            " the growing sigma."
        )
        rows = [[source.meaning, count] for source, count in _sources(track).items()]
        by = Section("What measured the drogue", (), (), PageTable(("measured by", "frames"), rows))
        return [Section("Confidence", words, [drawing]), by]


def _confidences(track: Track[DrogueFrame]) -> Array:
    """(n,)"""
    return np.array([f.confidence for f in track.frames])


def _correlations(track: Track[DrogueFrame]) -> Array:
    """(n,) nan without a match."""
    return np.array([f.correlation for f in track.frames])


def _sources(track: Track[DrogueFrame]) -> dict[MeasuredBy, int]:
    """Number of measured frames by source, all sources."""
    counts = Counter(f.source for f in track.frames if f.status is PoseStatus.MEASURED)
    return {s: counts[s] for s in MeasuredBy if s is not MeasuredBy.NONE}


def _checks(track: Track[DrogueFrame]) -> tuple[int, int]:
    """Checks of measured frames by the detector, and those that confirmed the drogue."""
    checked = [f for f in track.frames if f.status is PoseStatus.MEASURED and f.searched and not f.event]
    return len(checked), sum(f.source is MeasuredBy.BOTH for f in checked)
