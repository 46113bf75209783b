"""Options of `beampose track drogue`."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.findings import Finding, Level, unless_pass
from geometry.arrays import Array
from lab.detect.inputs import open_inputs
from lab.errors import InputError
from lab.files.text.atomic_write import atomic_folder
from lab.files.text.csv_text import write_table
from lab.files.text.json_text import write_json
from lab.number_format import format_number, format_percent
from lab.report.calibration.calibration_page import PageDrawing, PageTable, Section
from lab.report.plot.axes import BLUE, SKY, VERMILLION
from lab.report.plot.series import Band, Line, time_panel
from lab.targets.page import Words, path_section, status_shades, write_target_page
from lab.targets.series import (
    Content,
    FrameSeries,
    Progress,
    TargetOutcome,
    follow,
    frame_rate,
    quantiles,
    results_of,
    summary_of,
)
from lab.targets.verdict import WHY_MEASURED_MATTERS, far_reacquisitions, measured_share, missing_pictures, some_frames
from tracking.learned_detector.detector import learned_detector
from tracking.light_tracker.frames import Cause, DrogueFrame, LightParameters, Source
from tracking.light_tracker.tracker import DrogueTracker
from tracking.statuses import PoseStatus


@dataclass(frozen=True, slots=True)
class DrogueOptions:
    """Which drogue to track, and how."""

    near_px: tuple[float, float] | None = None  # centre of the first drogue, within 20 px or its radius
    check_every: int = LightParameters().check_every  # frames between two checks by the detector
    smallest_px: float = LightParameters().smallest_px  # diameters that are looked for
    largest_px: float | None = None  # None: the picture's smaller side
    rate_hz: float | None = None  # None: that of the video
    overlay: bool = False  # write overlay.avi
    limit: int | None = None  # largest number of pictures

    def parameters(self) -> LightParameters:
        """The parameters of the tracker.

        Raises:
            InputError: the diameters do not make a range.
        """
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

    def as_mapping(self) -> dict[str, Any]:
        """All options and parameters, for summary.json."""
        return {"options": asdict(self), "tracker": asdict(self.parameters())}


# The frames of a whole recording, as arrays for the summary, the verdict and the report.


@dataclass(slots=True, kw_only=True)
class DrogueSeries(FrameSeries[DrogueFrame]):
    """All frames so far."""

    @property
    def circles(self) -> Array:
        """(n, 3) u, v and diameter, px; nan where nothing is known."""
        return np.array([[*f.centre_px, f.diameter_px] for f in self.frames]).reshape(-1, 3)

    @property
    def sigmas(self) -> Array:
        """(n, 3) standard deviations of `circles`."""
        rows = [[*np.sqrt(np.diag(f.covariance)), f.sigma_diameter_px] for f in self.frames]
        return np.array(rows).reshape(-1, 3)

    @property
    def confidences(self) -> Array:
        """(n,)"""
        return np.array([f.confidence for f in self.frames])

    @property
    def correlations(self) -> Array:
        """(n,) nan without a match."""
        return np.array([f.correlation for f in self.frames])

    def sources(self) -> dict[str, int]:
        """Number of measured frames by source, all sources."""
        counts = Counter(f.source for f in self.frames if f.status is PoseStatus.MEASURED)
        return {s.value: counts[s] for s in Source if s is not Source.NONE}

    def searches(self) -> dict[str, int]:
        """Number of frames by what the detector searched in them."""
        counts = Counter(f.searched or "none" for f in self.frames)
        return {name: counts[name] for name in ("none", "window", "picture", "both")}

    def checks(self) -> tuple[int, int]:
        """Checks of measured frames by the detector, and those that confirmed the drogue."""
        checked = [f for f in self.frames if f.status is PoseStatus.MEASURED and f.searched and not f.event]
        return len(checked), sum(f.source is Source.BOTH for f in checked)


# drogue.csv: a row for every frame number from the first to the last, dropped ones too.


DROGUE = (
    "frame", "t_s", "u_px", "v_px", "diameter_px", "sigma_u_px", "sigma_v_px", "sigma_diameter_px", "status", "cause",
    "confidence", "source", "correlation", "rate_u_px_s", "rate_v_px_s", "cov_uv_px2", "searched", "found", "event",
)  # fmt: skip


def drogue_row(number: int, rate_hz: float, frame: DrogueFrame) -> list[object]:
    """The row of one frame. Fields without a value are empty."""
    sigma = np.sqrt(np.diag(frame.covariance)).tolist()
    rates = (rate_hz * frame.rate_px).tolist()
    return [
        number,
        f"{number / rate_hz:.9g}",
        *map(_text, (*frame.centre_px.tolist(), frame.diameter_px, *sigma, frame.sigma_diameter_px)),
        frame.status.value,
        frame.cause.value,
        _text(frame.confidence),
        frame.source.value,
        *map(_text, (frame.correlation, *rates)),
        _text(float(frame.covariance[0, 1]), 7),
        frame.searched,
        frame.found if frame.searched else "",
        frame.event,
    ]


def _text(value: float, decimals: int = 4) -> str:
    return f"{value:.{decimals}f}" if np.isfinite(value) else ""


# The verdict on a tracked drogue: pass, check or fail, with the reasons and what to do.


GOOD_CONFIDENCE = 0.8  # mean of the measured frames
LEAST_CONFIRMED = 0.5  # share of the checks in which the detector finds the drogue
_LEAST_CHECKS = 5  # with fewer, that share is not judged
_LARGEST_STEP = 1.0  # of the diameter: a reacquisition farther from the last known place is reported
_NONE_FOUND = "There is no drogue in view, it is larger than the picture, or several are alike."
_REMEDIES = {
    Cause.NO_IMAGE.value: "Check the camera and the file: pictures are missing or damaged.",
    Cause.NOT_FOUND.value: "Look at the pictures: is the drogue in view, and its diameter in the searched range"
    " (--min-diameter, --max-diameter)?",
    Cause.NO_MATCH.value: "Keep the drogue free, or use the predicted positions with their sigmas.",
    Cause.UNCERTAIN.value: "Improve light and contrast, or let the detector check more often (--every).",
    Cause.AMBIGUOUS.value: "State the place of the drogue in the first picture (--near), or its range of diameters.",
    Cause.OUT_OF_VIEW.value: "Keep the drogue inside the picture.",
}


def findings_of(series: DrogueSeries) -> list[Finding]:
    """The findings, failures first."""
    found = [
        _measured(series),
        *_ambiguous(series),
        *_jumps(series),
        *_doubts(series),
        *_missing(series),
    ]
    return sorted(found, key=lambda f: -f.level)


def _measured(series: DrogueSeries) -> Finding:
    share = measured_share(series, "drogue", _REMEDIES)
    if share.none:
        return Finding(Level.FAIL, share.what, _NONE_FOUND, share.remedy, code="BP-G01")
    return unless_pass(share.level, share.what, WHY_MEASURED_MATTERS, share.remedy, code="BP-G02")


def _ambiguous(series: DrogueSeries) -> list[Finding]:
    frames = [n for n, f in zip(series.numbers, series.frames, strict=True) if f.cause is Cause.AMBIGUOUS]
    if not frames:
        return []
    most = max(f.found for f in series.frames if f.cause is Cause.AMBIGUOUS)
    return [
        Finding(
            Level.WARN,
            f"{len(frames)} frames show several drogues (first: frame {frames[0]}; up to {most})",
            "None of them is reported, since the choice would be a guess.",
            _REMEDIES[Cause.AMBIGUOUS.value],
            code="BP-G04",
        )
    ]


def _jumps(series: DrogueSeries) -> list[Finding]:
    """Reacquisitions far from the last known place: it may be another object."""
    far = far_reacquisitions(series, series.circles, _LARGEST_STEP)
    if not far:
        return []
    return [
        Finding(
            Level.WARN,
            f"{len(far)} reacquisition{' lies' if len(far) == 1 else 's lie'} more than a diameter from the last known"
            f" place (frame {some_frames(far)})",
            "What was found there, or what was followed before, may be another object.",
            "Compare these frames in the overlay (--video).",
            code="BP-G05",
        )
    ]


def _doubts(series: DrogueSeries) -> list[Finding]:
    """A low confidence, or checks in which the detector does not find the drogue."""
    out = []
    measured = series.has_status(PoseStatus.MEASURED)
    if measured.any() and (mean := float(series.confidences[measured].mean())) < GOOD_CONFIDENCE:
        out.append(
            Finding(
                Level.WARN,
                f"the mean confidence of the measured frames is {mean:.2f} (usual: {GOOD_CONFIDENCE} and more)",
                "That share of the frames is expected to be right.",
                "Use frames with a high confidence only, or let the detector check more often (--every).",
                code="BP-G06",
            )
        )
    checks, confirmed = series.checks()
    if checks >= _LEAST_CHECKS and confirmed < LEAST_CONFIRMED * checks:
        out.append(
            Finding(
                Level.WARN,
                f"the detector finds the drogue in {format_percent(confirmed / checks)} of its {checks} checks",
                "What is followed may be another object.",
                "Look at the overlay (--video).",
                code="BP-G07",
            )
        )
    return out


def _missing(series: DrogueSeries) -> list[Finding]:
    if not (what := missing_pictures(series)):
        return []
    why = "The drogue is predicted there."
    return [Finding(Level.WARN, what, why, _REMEDIES[Cause.NO_IMAGE.value], code="BP-G03")]


# The page of a tracked drogue: verdict, key figures, position and diameter over time, confidence, path, events.


_WORDS = Words("drogue", "drogues", "several drogues; none is chosen", lambda cause: Cause(cause).meaning)


def write_drogue_page(series: DrogueSeries, findings: Sequence[Finding], options: DrogueOptions, folder: Path) -> Path:
    """Write report.html into a folder. Returns its path."""
    path = path_section(series.size_px, series.circles[:, :2], series.has_status(PoseStatus.PREDICTED))
    sections = [_motion(series), _confidence(series), path, _sources(series)]
    method = f"learned detector, checks every {options.check_every} frames; light tracker between them"
    return write_target_page(series, findings, _WORDS, _key_figures(series), sections, method, folder)


def _key_figures(series: DrogueSeries) -> list[tuple[str, str, str]]:
    measured = series.has_status(PoseStatus.MEASURED)
    if not measured.any():
        return []
    sigma = np.median(series.sigmas[measured], axis=0)
    diameter, confidence = series.circles[measured, 2], series.confidences[measured]
    checks, confirmed = series.checks()
    figures = [
        ("Centre", f"± {format_number(float(np.hypot(*sigma[:2])), 2)} px", "median sigma, both axes together"),
        (
            "Diameter",
            f"{format_number(float(np.median(diameter)))} px",
            f"{diameter.min():.1f} to {diameter.max():.1f} px",
        ),
        ("Confidence", f"{confidence.mean():.2f}", f"mean of the measured frames; smallest {confidence.min():.2f}"),
    ]
    if checks:
        figures.append(("Checks", format_percent(confirmed / checks), f"confirmed by the detector; {checks} checks"))
    return figures


def _motion(series: DrogueSeries) -> Section:
    names = ("u of the centre", "v of the centre", "diameter")
    panels = [
        time_panel(
            series.t_s, name, "px", lines=(Line(series.circles[:, i], BLUE, name),),
            bands=(Band.about(series.circles[:, i], series.sigmas[:, i], 3.0, SKY, "3 sigma", 0.5),),
            shades=status_shades(series), width=1100, height=150, time_name="s",
        )
        for i, name in enumerate(names)
    ]  # fmt: skip
    words = (
        "Centre and diameter of the rim's image, with a band of 3 sigma. Shaded: frames without a measurement"
        " (predicted), and frames in which nothing is known (lost)."
    )
    return Section("Position and diameter", words, [PageDrawing(p, wide=True) for p in panels])


def _confidence(series: DrogueSeries) -> Section:
    confidence: Array = np.where(series.has_status(PoseStatus.LOST), np.nan, series.confidences)
    panel = time_panel(
        series.t_s, "Confidence (blue) and correlation of the match (orange)", "", shades=status_shades(series),
        lines=(Line(confidence, BLUE, "confidence"), Line(series.correlations, VERMILLION, "correlation")),
        y_range=(0.0, 1.05), width=1100, height=170, time_name="s",
    )  # fmt: skip
    words = (
        "The confidence is the probability that the centre is right to a quarter of the diameter. It comes from the"
        " detector's checks of the drogue and was fitted on rendered drogues. Of a predicted frame it falls with the"
        " growing sigma."
    )
    return Section("Confidence", words, [PageDrawing(panel, wide=True)])


def _sources(series: DrogueSeries) -> Section:
    rows = [[Source(name).meaning, count] for name, count in series.sources().items()]
    return Section("What measured the drogue", (), (), PageTable(("measured by", "frames"), rows))


# Tracks a drogue through a video or pictures; writes drogue.csv, summary.json, report.html and a video.


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
