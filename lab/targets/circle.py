"""Options of `beampose track circle`, and the detectors that it offers."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from calibration.findings import Finding, Level, unless_pass
from geometry.arrays import Array
from lab.detect.inputs import open_inputs
from lab.errors import InputError
from lab.files.text.atomic_write import atomic_folder
from lab.files.text.csv_text import write_table
from lab.files.text.json_text import write_json
from lab.number_format import format_number, format_percent
from lab.report.calibration.calibration_page import PageDrawing, Section
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
from tracking.drogue_circle.candidates import CircleDetector
from tracking.drogue_circle.detectors import classical_detector
from tracking.drogue_circle.parameters import CircleParameters
from tracking.drogue_circle.printed import PrintedTracker
from tracking.drogue_circle.rim_fit import Cause, CircleFrame
from tracking.drogue_circle.tracker import CircleTracker
from tracking.learned_detector.detector import learned_detector
from tracking.statuses import PoseStatus

Tracker: TypeAlias = CircleTracker | PrintedTracker

# Name for --detector: its maker. Another detector needs its line here; the rim fit after it is the same for all.
DETECTORS: Mapping[str, Callable[[CircleParameters], CircleDetector]] = {
    "classical": classical_detector,
    "learned": lambda p: learned_detector(p.min_radius_px, p.max_radius_px),
}
SOUND, PRINTED = "sound", "printed"
FORMS = (SOUND, PRINTED)


@dataclass(frozen=True, slots=True)
class CircleOptions:
    """Which circle to track, and how."""

    near_px: tuple[float, float] | None = None  # centre of the first circle, within 20 px
    min_radius_px: float = CircleParameters().min_radius_px
    max_radius_px: float | None = None  # None: half of the picture's smaller side
    rate_hz: float | None = None  # None: that of the video
    form: str = SOUND  # of the noise and the measurement: sound, or as printed
    detector: str = "classical"
    overlay: bool = False  # write overlay.avi
    limit: int | None = None  # largest number of pictures

    def parameters(self) -> CircleParameters:
        """The parameters of the tracker.

        Raises:
            InputError: the radii do not make a range, or there is no such form or detector.
        """
        if self.max_radius_px is not None and self.max_radius_px <= self.min_radius_px:
            raise InputError(
                f"--max-radius: expected more than --min-radius ({self.min_radius_px:g} px), got {self.max_radius_px:g}"
            )
        for option, value, known in (("form", self.form, FORMS), ("detector", self.detector, tuple(DETECTORS))):
            if value not in known:
                raise InputError(f"--{option}: expected one of {', '.join(known)}, got {value!r}")
        return CircleParameters(min_radius_px=self.min_radius_px, max_radius_px=self.max_radius_px)

    def tracker(self) -> Tracker:
        """A tracker before its first picture. Raises InputError as `parameters` does."""
        parameters = self.parameters()
        kind = CircleTracker if self.form == SOUND else PrintedTracker
        return kind(DETECTORS[self.detector](parameters), parameters, self.near_px)

    def as_mapping(self) -> dict[str, Any]:
        """All options and parameters, for summary.json."""
        return {"options": asdict(self), "tracker": asdict(self.parameters())}


# The frames of a whole recording, as arrays for the summary, the verdict and the report.


@dataclass(slots=True, kw_only=True)
class CircleSeries(FrameSeries[CircleFrame]):
    """All frames so far."""

    form: str

    @property
    def states(self) -> Array:
        """(n, 6); nan where nothing is known."""
        return np.array([f.state for f in self.frames]).reshape(-1, 6)

    @property
    def sigmas(self) -> Array:
        """(n, 6) standard deviations; nan where nothing is known."""
        return np.array([np.sqrt(np.diag(f.covariance)) for f in self.frames]).reshape(-1, 6)

    @property
    def fits(self) -> Array:
        """(n, 3): measured u, v, radius; nan without a fit."""
        nan = np.full(3, np.nan)
        return np.array([nan if f.measured is None else f.measured.centre_and_radius for f in self.frames]).reshape(
            -1, 3
        )

    def quality(self) -> Array:
        """(n, 3): occlusion coefficient, coverage and RMS of the fit (px); nan where there is none."""
        rows = [
            (f.occlusion, *((np.nan, np.nan) if f.measured is None else (f.measured.coverage, f.measured.rms_px)))
            for f in self.frames
        ]
        return np.array(rows, dtype=float).reshape(-1, 3)


# circle.csv: a row for every frame number from the first to the last, dropped ones too.


CIRCLE = (
    "frame", "t_s", "u_px", "v_px", "radius_px", "sigma_u_px", "sigma_v_px", "sigma_radius_px", "status", "cause",
    "predicted_u_px", "predicted_v_px", "predicted_radius_px", "rate_u_px_s", "rate_v_px_s", "rate_radius_px_s",
    "sigma_rate_u_px_s", "sigma_rate_v_px_s", "sigma_rate_radius_px_s", "cov_uv_px2", "occlusion", "coverage", "rms_px",
    "measured_u_px", "measured_v_px", "measured_radius_px", "major_px", "minor_px", "angle_deg",
)  # fmt: skip


def circle_row(number: int, rate_hz: float, frame: CircleFrame) -> list[object]:
    """The row of one frame. Fields without a value are empty."""
    sigma = np.sqrt(np.diag(frame.covariance))
    fit = frame.measured
    rates, rate_sigmas = rate_hz * frame.state[3:], rate_hz * sigma[3:]
    # As many digits as the measurement resolves: a tenth of a millipixel.
    cells = [*_texts(frame.state[:3]), *_texts(sigma[:3]), frame.status.value, frame.cause.value]
    cells += [*_texts(frame.predicted), *_texts(rates), *_texts(rate_sigmas)]
    cells += _texts([frame.covariance[0, 1]], 7) + _texts([frame.occlusion])
    if fit is None:
        cells += [""] * 8
    else:
        away = float(np.hypot(fit.rim.cos2_px, fit.rim.sin2_px))
        angle = 0.5 * np.degrees(np.arctan2(fit.rim.sin2_px, fit.rim.cos2_px))
        angle = 90.0 - (90.0 - angle) % 180.0 if away else 0.0  # into (-90, 90]
        radius = fit.rim.radius_px
        cells += _texts([fit.coverage, fit.rms_px, *fit.circle, radius + away, radius - away, angle])
    return [number, f"{number / rate_hz:.9g}", *cells]


def _texts(values: Sequence[float] | np.ndarray, decimals: int = 4) -> list[str]:
    return [f"{v:.{decimals}f}" if np.isfinite(v) else "" for v in values]


# The verdict on a tracked circle: pass, check or fail, with the reasons and what to do.


_LARGEST_STEP = 0.5  # of the radius: a reacquisition farther from the prediction is reported
_NONE_FOUND = "There is no target in view, or its rim is not a circle of the searched radii, or several are alike."
_REMEDIES = {
    Cause.NO_IMAGE.value: "Check the camera and the file: pictures are missing or damaged.",
    Cause.OCCLUDED.value: "Keep the target free, or use the predicted positions with their sigmas.",
    Cause.NOT_FOUND.value: "Look at the overlay (--video): is the rim sharp, and are the radii in the searched range"
    " (--min-radius, --max-radius)?",
    Cause.AMBIGUOUS.value: "State the place of the circle in the first picture (--near), or its range of radii.",
    Cause.OUT_OF_VIEW.value: "Keep the target inside the picture.",
}


def findings_of(series: CircleSeries) -> list[Finding]:
    """The findings, failures first."""
    found = [
        _measured(series),
        *_ambiguous(series),
        *_jumps(series),
        *_missing(series),
    ]
    return sorted(found, key=lambda f: -f.level)


def _measured(series: CircleSeries) -> Finding:
    share = measured_share(series, "circle", _REMEDIES)
    if share.none:
        return Finding(Level.FAIL, share.what, _NONE_FOUND, share.remedy, code="BP-T01")
    return unless_pass(share.level, share.what, WHY_MEASURED_MATTERS, share.remedy, code="BP-T02")


def _ambiguous(series: CircleSeries) -> list[Finding]:
    frames = [n for n, f in zip(series.numbers, series.frames, strict=True) if f.cause is Cause.AMBIGUOUS]
    if not frames:
        return []
    most = max(f.circles for f in series.frames if f.cause is Cause.AMBIGUOUS)
    return [
        Finding(
            Level.WARN,
            f"{len(frames)} frames show several circles that fit equally well (first: frame {frames[0]}; up to {most}"
            " circles)",
            "None of them is reported, since the choice would be a guess.",
            _REMEDIES[Cause.AMBIGUOUS.value],
            code="BP-T04",
        )
    ]


def _jumps(series: CircleSeries) -> list[Finding]:
    """Reacquisitions far from the last known place: it may be another circle."""
    far = far_reacquisitions(series, series.states[:, :3], _LARGEST_STEP)
    if not far:
        return []
    return [
        Finding(
            Level.WARN,
            f"{len(far)} reacquisitions lie more than half a radius from the last known place"
            f" (frame {some_frames(far)})",
            "The circle found there may be another one.",
            "Compare these frames in the overlay (--video).",
            code="BP-T05",
        )
    ]


def _missing(series: CircleSeries) -> list[Finding]:
    if not (what := missing_pictures(series)):
        return []
    why = "The circle is predicted there."
    return [Finding(Level.WARN, what, why, _REMEDIES[Cause.NO_IMAGE.value], code="BP-T03")]


# The page of a tracked circle: verdict, key figures, position, radius and their sigmas over time, occlusion, path.


_WORDS = Words(
    "circle", "circles", "several circles fit equally well; none is chosen", lambda cause: Cause(cause).meaning
)


def write_circle_page(series: CircleSeries, findings: Sequence[Finding], options: CircleOptions, folder: Path) -> Path:
    """Write report.html into a folder. Returns its path."""
    path = path_section(series.size_px, series.states[:, :2], series.has_status(PoseStatus.PREDICTED))
    sections = [_motion(series), _quality(series), path]
    form = "corrected equations, rim fit" if options.form == "sound" else "equations as printed, whole pixels"
    method = f"Zhou et al. (2014): {form}; detector {options.detector}"
    return write_target_page(series, findings, _WORDS, _key_figures(series), sections, method, folder)


def _key_figures(series: CircleSeries) -> list[tuple[str, str, str]]:
    figures: list[tuple[str, str, str]] = []
    measured = series.has_status(PoseStatus.MEASURED)
    if measured.any():
        sigma = np.median(series.sigmas[measured], axis=0)
        radius = series.states[measured, 2]
        quality = series.quality()[measured]
        figures += [
            ("Centre", f"± {format_number(float(np.hypot(*sigma[:2])), 2)} px", "median sigma, both axes together"),
            ("Radius", f"{format_number(float(np.median(radius)))} px", f"{radius.min():.1f} to {radius.max():.1f} px"),
            ("Occlusion", format_percent(float(np.nanmax(quality[:, 0]))), "largest of a measured frame"),
        ]
        if np.isfinite(quality[:, 2]).any():
            rms = float(np.nanmedian(quality[:, 2]))
            figures.append(("Rim", f"{format_number(rms, 2)} px", "residuals of its edge points, RMS, median"))
    return figures


def _motion(series: CircleSeries) -> Section:
    t, x, sigma = series.t_s, series.states, series.sigmas
    panels = []
    for i, (title, colour) in enumerate((("u of the centre", BLUE), ("v of the centre", BLUE), ("radius", BLUE))):
        panels.append(
            time_panel(
                t, title, "px", lines=(Line(x[:, i], colour, title),),
                bands=(Band.about(x[:, i], sigma[:, i], 3.0, SKY, "3 sigma", 0.5),),
                shades=status_shades(series), width=1100, height=150, time_name="s",
            )
        )  # fmt: skip
    words = (
        "State of the filter after each frame, with a band of 3 sigma. Shaded: frames without a measurement"
        " (predicted), and frames in which nothing is known (lost)."
    )
    return Section("Position and radius", words, [PageDrawing(p, wide=True) for p in panels])


def _quality(series: CircleSeries) -> Section:
    t, quality = series.t_s, series.quality()
    shades = status_shades(series)
    away = series.fits - np.array([f.predicted for f in series.frames])
    top = float(np.nanmax(quality[:, 2])) if np.isfinite(quality[:, 2]).any() else 1.0
    panels = [
        time_panel(
            t, "Occlusion coefficient (blue) and share of the rim with edge points (orange)", "", shades=shades,
            lines=(Line(quality[:, 0], BLUE, "occlusion"), Line(quality[:, 1], VERMILLION, "coverage")),
            y_range=(0.0, 1.05), width=1100, height=140, time_name="s",
        ),
        time_panel(
            t, "Residuals of the rim, RMS", "px", shades=shades, lines=(Line(quality[:, 2], BLUE, "RMS"),),
            y_range=(0.0, max(1.1 * top, 0.1)), width=1100, height=120, time_name="s",
        ),
        time_panel(
            t, "Measured minus predicted centre: u (blue), v (orange)", "px", shades=shades,
            lines=(Line(away[:, 0], BLUE, "u"), Line(away[:, 1], VERMILLION, "v")),
            width=1100, height=140, time_name="s",
        ),
    ]  # fmt: skip
    words = (
        "The occlusion coefficient is the hidden share of the target's area. From 0.5 on, the circle is only predicted;"
        " below, the covariance of the fit grows by 1 / (1 - coefficient)²."
    )
    return Section("Measurements", words, [PageDrawing(p, wide=True) for p in panels])


# Tracks a circle through a video or a folder of pictures; writes circle.csv, summary.json, report.html and a video.


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
