"""`beampose track circle`: the rim of a drogue, a ring or a disc (Zhou 2014)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from geometry.arrays import Array
from lab.errors import InputError
from lab.files.text.error_text import require_one_of
from lab.findings.finding import Finding, Level, finding
from lab.number_format import format_number, format_percent
from lab.progress import Progress
from lab.report.page import Section
from lab.report.plot.series import Line
from lab.report.plot.svg import BLUE, VERMILLION
from lab.runs.processed import quantiles
from lab.targets.page import TimeAxis
from lab.targets.target import Codes, Target, Track, TrackOptions, texts, track_pictures
from tracking.drogue_circle.detectors import CircleDetector, CircleParameters, Edge, classical_detector
from tracking.drogue_circle.printed import PrintedTracker
from tracking.drogue_circle.tracker import CircleFrame, CircleTracker
from tracking.learned_detector.detector import learned_detector

Tracker: TypeAlias = CircleTracker | PrintedTracker

# Name for --detector: its maker. Another detector needs its line here; the rim fit after it is the same for all.
DETECTORS: Mapping[str, Callable[[CircleParameters], CircleDetector]] = {
    "classical": classical_detector,
    "learned": lambda p: learned_detector(p.min_radius_px, p.max_radius_px),
}
SOUND, PRINTED = "sound", "printed"
FORMS = (SOUND, PRINTED)
EDGES = tuple(e.value for e in Edge)


@dataclass(frozen=True, slots=True)
class CircleOptions(TrackOptions):
    """Which circle to track, and how."""

    near_px: tuple[float, float] | None = None  # centre of the first circle, within 20 px
    min_radius_px: float = CircleParameters().min_radius_px
    max_radius_px: float | None = None  # None: half of the picture's smaller side
    form: str = SOUND  # of the noise and the measurement: sound, or as printed
    detector: str = "classical"
    edge: str = Edge.SUPPORTED.value  # of a target with several about one centre

    def parameters(self) -> CircleParameters:
        """The parameters of the tracker.

        Raises InputError: the radii do not make a range, or there is no such form or detector.
        """
        if self.max_radius_px is not None and self.max_radius_px <= self.min_radius_px:
            raise InputError(
                f"--max-radius: expected more than --min-radius ({self.min_radius_px:g} px), got {self.max_radius_px:g}"
            )
        require_one_of("--form", self.form, FORMS)
        require_one_of("--detector", self.detector, DETECTORS)
        require_one_of("--edge", self.edge, EDGES)
        return CircleParameters(self.min_radius_px, self.max_radius_px, Edge(self.edge))

    def tracker(self) -> Tracker:
        """A tracker before its first picture. Raises InputError as `parameters` does."""
        parameters = self.parameters()
        kind = CircleTracker if self.form == SOUND else PrintedTracker
        return kind(DETECTORS[self.detector](parameters), parameters, self.near_px)


# circle.csv: a row for every frame number from the first to the last, dropped ones too.


CIRCLE = (
    "frame", "t_s", "u_px", "v_px", "radius_px", "sigma_u_px", "sigma_v_px", "sigma_radius_px", "status", "cause",
    "predicted_u_px", "predicted_v_px", "predicted_radius_px", "rate_u_px_s", "rate_v_px_s", "rate_radius_px_s",
    "sigma_rate_u_px_s", "sigma_rate_v_px_s", "sigma_rate_radius_px_s", "cov_uv_px2", "occlusion", "coverage", "rms_px",
    "measured_u_px", "measured_v_px", "measured_radius_px", "major_px", "minor_px", "angle_deg",
)  # fmt: skip


class CircleTarget(Target[CircleFrame]):
    """A circle, by votes of gradients or the learned detector and a fit of its rim."""

    schema, table, columns = "beampose/circle/1", "circle.csv", CIRCLE
    subject, size_name, several = "circle", "radius", "several circles that fit equally well"
    codes = Codes(none="BP-T01", few="BP-T02", missing="BP-T03", ambiguous="BP-T04", far="BP-T05")
    far_sizes, far_words = 0.5, "half a radius"
    options: CircleOptions

    def __init__(self, options: CircleOptions = CircleOptions()) -> None:
        self.options = options
        self.tracker = options.tracker()

    def read(self, path: Path, progress: Progress | None) -> Track[CircleFrame]:
        return track_pictures(path, self.tracker.step, self.options, progress)

    def row(self, track: Track[CircleFrame], k: int) -> list[object]:
        number, rate_hz, frame = int(track.recording.numbers[k]), track.recording.rate_hz, track.frames[k]
        assert rate_hz is not None  # assumed where it is not stated
        sigma = np.sqrt(np.diag(frame.covariance))
        fit = frame.measured
        rates, rate_sigmas = rate_hz * frame.state[3:], rate_hz * sigma[3:]
        cells = [*texts(frame.state[:3]), *texts(sigma[:3]), frame.status.value, frame.cause.value]
        cells += [*texts(frame.predicted), *texts(rates), *texts(rate_sigmas)]
        cells += texts([frame.covariance[0, 1]], 7) + texts([frame.occlusion])
        if fit is None:
            cells += [""] * 8
        else:
            away = float(np.hypot(fit.rim.cos2_px, fit.rim.sin2_px))
            angle = 0.5 * np.degrees(np.arctan2(fit.rim.sin2_px, fit.rim.cos2_px))
            angle = 90.0 - (90.0 - angle) % 180.0 if away else 0.0  # into (-90, 90]
            radius = fit.rim.radius_px
            cells += texts([fit.coverage, fit.rms_px, *fit.centre_and_radius, radius + away, radius - away, angle])
        return [number, f"{number / rate_hz:.9g}", *cells]

    def findings(self, track: Track[CircleFrame]) -> list[Finding]:
        """Several edges about one centre, without a choice by the user."""
        starts = [f for f in track.frames if len(f.edges_px) > 1 and f.measured is not None]
        if self.options.edge != Edge.SUPPORTED or not starts:
            return []
        first = starts[0]
        radii = ", ".join(f"{r:.1f}" for r in first.edges_px)
        what = (
            f"the circle has {len(first.edges_px)} edges about one centre (radii {radii} px); the one of"
            f" {first.place[2]:.1f} px is tracked"
        )
        return [finding("BP-T06", Level.WARN, what)]

    def figures(self, track: Track[CircleFrame]) -> dict[str, Any]:
        fitted, quality = np.isfinite(_fits(track)[:, 0]), _quality(track)
        block = {
            "radius_px": quantiles(track.places[:, 2]),
            "sigma_centre_px": quantiles(np.hypot(*track.sigmas[:, :2].T)[fitted]),
            "occlusion": quantiles(quality[:, 0]),
            "coverage": quantiles(quality[:, 1]),
            "rms_px": quantiles(quality[:, 2]),
            "edges_px": next((list(f.edges_px) for f in track.frames if f.edges_px), []),
        }
        return {"circle": block}

    def parameters(self) -> dict[str, Any]:
        return {"options": asdict(self.options), "tracker": asdict(self.options.parameters())}

    def method(self) -> str:
        form = "corrected equations, rim fit" if self.options.form == SOUND else "equations as printed, whole pixels"
        return f"Zhou et al. (2014): {form}; detector {self.options.detector}"

    def key_figures(self, track: Track[CircleFrame]) -> list[tuple[str, str, str]]:
        quality = _quality(track)[track.measured]
        largest = format_percent(float(np.nanmax(quality[:, 0])))
        out = [("Occlusion", largest, "largest of a measured frame")]
        if np.isfinite(quality[:, 2]).any():
            rms = float(np.nanmedian(quality[:, 2]))
            out.append(("Rim", f"{format_number(rms, 2)} px", "residuals of its edge points, RMS, median"))
        return out

    def sections(self, track: Track[CircleFrame]) -> list[Section]:
        axis, quality = TimeAxis.of(track), _quality(track)
        away = _fits(track) - np.array([f.predicted for f in track.frames])
        top = float(np.nanmax(quality[:, 2])) if np.isfinite(quality[:, 2]).any() else 1.0
        panels = [
            axis.panel(
                "Occlusion coefficient (blue) and share of the rim with edge points (orange)", "",
                Line(quality[:, 0], BLUE, "occlusion"), Line(quality[:, 1], VERMILLION, "coverage"),
                y_range=(0.0, 1.05),
            ),
            axis.panel(
                "Residuals of the rim, RMS", "px", Line(quality[:, 2], BLUE, "RMS"),
                y_range=(0.0, max(1.1 * top, 0.1)),
            ),
            axis.panel(
                "Measured minus predicted centre: u (blue), v (orange)", "px", Line(away[:, 0], BLUE, "u"),
                Line(away[:, 1], VERMILLION, "v"),
            ),
        ]  # fmt: skip
        words = (
            "The occlusion coefficient is the hidden share of the target's area. From 0.5 on, the circle is only"
            " predicted; below, the covariance of the fit grows by 1 / (1 - coefficient)²."
        )
        return [Section("Measurements", words, panels)]


def _fits(track: Track[CircleFrame]) -> Array:
    """(n, 3): measured u, v, radius; nan without a fit."""
    fits = [f.measured for f in track.frames]
    return np.array([np.full(3, np.nan) if fit is None else fit.centre_and_radius for fit in fits])


def _quality(track: Track[CircleFrame]) -> Array:
    """(n, 3): occlusion coefficient, coverage and RMS of the fit (px); nan where there is none."""
    fits = [(np.nan, np.nan) if f.measured is None else (f.measured.coverage, f.measured.rms_px) for f in track.frames]
    return np.array([(f.occlusion, *fit) for f, fit in zip(track.frames, fits, strict=True)], dtype=float)
