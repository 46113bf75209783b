"""`beampose track point`: the centre of one target, from pictures or a table of points (Duan 2020)."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from geometry.arrays import Array
from lab.errors import InputError
from lab.files.text.csv_text import number_fields
from lab.files.text.dataclass_fields import with_overrides
from lab.files.text.error_text import require_one_of
from lab.findings.finding import Finding, Level, finding
from lab.number_format import format_number, format_percent, format_some
from lab.pictures.source import PictureSource, open_inputs
from lab.progress import Progress
from lab.report.page import Section
from lab.report.plot.series import Line
from lab.report.plot.svg import VERMILLION, histogram
from lab.runs.frames.sensor_noise import CameraNoise, noise_pictures
from lab.targets.page import TimeAxis
from lab.targets.recording import every_frame, read_pictures, read_points
from lab.targets.target import Codes, Target, Track, TrackOptions, header_rate
from tracking.detections import UNMATCHED, Detections
from tracking.parameters import DetectParameters
from tracking.single_target.blobs import HUES, BlobParameters, find_blobs, find_coloured, has_colour, hue_of
from tracking.single_target.point_tracker import PointEstimate, PointParameters, track_point
from tracking.statuses import Cause, PoseStatus

COLOUR = "colour"
DETECTORS = ("spots", "darker", "brighter", COLOUR)
TABLE = "table"  # in place of a detector, for a CSV file
LARGEST_NIS = 1.6  # mean of the normalised innovation per number, 1 for a correct model
SIMILAR_SHARE = 0.05  # of the frames in which another target of at least this brightness ...
SIMILAR_FLUX = 0.5  # ... relative to the tracked one is in view
_UPPER = np.triu_indices(4)
COLUMNS = (
    "frame", "t_s", "u_px", "v_px", "sigma_u_px", "sigma_v_px", "status", "predicted_u_px", "predicted_v_px", "nis",
    "measured_u_px", "measured_v_px", "velocity_u_px_frame", "velocity_v_px_frame", "velocity_u_px_s",
    "velocity_v_px_s", *(f"c{i}{j}" for i in range(4) for j in range(i, 4)),
)  # fmt: skip
"""The entries c00 to c33 are the upper triangle of the covariance of u, v (px) and their rates (px/frame)."""


@dataclass(frozen=True, slots=True)
class PointSettings:
    """All parameters that --set can replace, as NAME=VALUE with dotted names."""

    track: PointParameters = field(default_factory=PointParameters)
    detect: DetectParameters = field(default_factory=DetectParameters)  # of the detector `spots`
    blobs: BlobParameters = field(default_factory=BlobParameters)  # of the detectors `darker`, `brighter`, `colour`


@dataclass(frozen=True, slots=True)
class PointOptions(TrackOptions):
    """Which target to track, and how."""

    detector: str = "spots"  # one of DETECTORS; not used for a table
    near_px: tuple[float, float] | None = None  # where the target is at the start
    camera: str | None = None  # of a table with several
    min_measured: float = 0.5  # the gate: least share of measured frames
    overrides: Mapping[str, Any] = field(default_factory=dict)  # of PointSettings
    colour: str | None = None  # of the detector `colour`: a name or #rrggbb

    def settings(self) -> PointSettings:
        """The parameters. Raises InputError: an override is not one of them, or the detector does not exist."""
        require_one_of("--detector", self.detector, DETECTORS)
        made = with_overrides(PointSettings(), self.overrides)
        track = made.track if self.near_px is None else replace(made.track, start_px=self.near_px)
        polarity: Any = self.detector if self.detector in ("darker", "brighter") else made.blobs.polarity
        return replace(made, track=track, blobs=replace(made.blobs, polarity=polarity))


def hue_named(name: str | None) -> float:
    """Hue, degrees, of a name or of #rrggbb. Raises InputError: there is no such colour, or it is a grey."""
    known = f"{', '.join(HUES)}, or #rrggbb such as #d02030"
    if name is None:
        raise InputError(f"--detector {COLOUR}: expected --colour with {known}, got none")
    if name in HUES:
        return HUES[name]
    digits = name.removeprefix("#")
    if not (name.startswith("#") and len(digits) == 6 and all(c in "0123456789abcdefABCDEF" for c in digits)):
        raise InputError(f"--colour: expected {known}, got {name!r}")
    red, green, blue = (float(int(digits[i : i + 2], 16)) for i in (0, 2, 4))
    hue = hue_of((blue, green, red))
    if hue is None:
        raise InputError(f"--colour: expected a colour, got the grey {name}; use --detector darker or brighter")
    return hue


@dataclass(frozen=True, slots=True)
class PointFrame:
    """The target in one frame, with the detections of its picture."""

    estimate: PointEstimate
    detections: Detections | None  # None: no usable picture
    event: str = ""

    @property
    def status(self) -> PoseStatus:
        """Measured, predicted or lost."""
        return self.estimate.status

    @property
    def cause(self) -> Cause:
        """Why it is not measured."""
        if self.status is PoseStatus.MEASURED:
            return Cause.NONE
        if self.estimate.several:
            return Cause.AMBIGUOUS
        return Cause.NO_IMAGE if self.detections is None else Cause.NOT_FOUND

    @property
    def found(self) -> int:
        """Number of detections."""
        return 0 if self.detections is None else len(self.detections)

    @property
    def place(self) -> Array:
        """u and v, px, and nan: a point has no size."""
        return np.array([*self.estimate.x[:2], np.nan])

    @property
    def sigmas(self) -> Array:
        """Standard deviations (3,) of `place`."""
        return np.array([*np.sqrt(np.diagonal(self.estimate.P)[:2]), np.nan])

    @property
    def measured_px(self) -> Array:
        """u and v of the detection, px; nan where none is used."""
        if self.detections is None or self.estimate.row == UNMATCHED:
            return np.full(2, np.nan)
        return self.detections.uv_px[self.estimate.row]


class PointTarget(Target[PointFrame]):
    """A point of light, or the centre of a larger target."""

    schema, table, columns = "beampose/track-point/1", "track.csv", COLUMNS
    subject, several = "target", "several objects, and none moves while the others do not"
    codes = Codes(none="BP-N01", few="BP-N02", missing="BP-N06", ambiguous="BP-N05", far="")
    usual_missing = 0.05
    options: PointOptions

    def __init__(self, options: PointOptions = PointOptions()) -> None:
        self.options, self.settings = options, options.settings()
        self.least_measured = options.min_measured
        self.detector = options.detector

    def read(self, path: Path, progress: Progress | None) -> Track[PointFrame]:
        """The track through pictures, a video or a table with frame,u_px,v_px. Raises InputError."""
        options = self.options
        if path.suffix.lower() == ".csv":
            if options.overlay:
                raise InputError(f"{path}: expected pictures or a video for --video, got a table")
            self.detector = TABLE
            (recording, found), detection_s = read_points(path, options.rate_hz, options.camera), 0.0
        else:
            if options.camera is not None:
                raise InputError(f"--camera: expected a table with a column camera, got {path}; leave the option out")
            inputs = open_inputs([path])
            search = self._search(inputs)
            frames = every_frame(inputs, options.limit, colour=isinstance(search, _ColourSearch))
            recording, found, detection_s = read_pictures(
                inputs, path, frames,
                lambda picture: None if picture is None else search(picture), options.rate_hz or header_rate(inputs),
                limit=options.limit, progress=progress,
            )  # fmt: skip
            if isinstance(search, _ColourSearch) and not search.shown:
                raise InputError(
                    f"{inputs.camera}: expected colour pictures, got grey ones; use --detector darker or brighter"
                )
            if recording.rate_hz is not None:
                t_s = (recording.numbers - recording.numbers[0]) / recording.rate_hz
                recording = replace(recording, t_s=t_s)
        begun = time.process_time()
        track = track_point(recording.steps, found, self.settings.track)
        tracking_s = detection_s + time.process_time() - begun
        together = zip(track, found, _events(track), strict=True)
        return Track(recording, [PointFrame(*each) for each in together], tracking_s)

    def _search(self, inputs: PictureSource) -> Callable[[Any], Detections]:
        if self.detector == COLOUR:
            return _ColourSearch(hue_named(self.options.colour), self.settings.blobs)
        if self.options.colour is not None:
            raise InputError(f"--colour: belongs to --detector {COLOUR}, got --detector {self.detector}")
        if self.detector != "spots":
            return partial(find_blobs, parameters=self.settings.blobs)
        noise = CameraNoise(inputs.camera)
        noise.estimate_from(noise_pictures(inputs))
        return partial(noise.detect, parameters=self.settings.detect)

    def row(self, track: Track[PointFrame], k: int) -> list[object]:
        recording, frame = track.recording, track.frames[k]
        e = frame.estimate
        t_s = np.nan if recording.t_s is None else recording.t_s[k]
        rate = np.nan if recording.rate_hz is None else recording.rate_hz
        before = [*frame.place[:2], *frame.sigmas[:2]]
        after = [*e.predicted_px, e.nis, *frame.measured_px, *e.x[2:], *(e.x[2:] * rate), *e.P[_UPPER]]
        number = int(recording.numbers[k])
        return [number, *number_fields([t_s]), *number_fields(before), e.status.value, *number_fields(after)]

    def findings(self, track: Track[PointFrame]) -> list[Finding]:
        """A lost target, innovations that are too large, and similar targets."""
        out = []
        lost = [number for number, f in track.events() if f.event == "lost"]
        if lost:
            out.append(finding("BP-N03", Level.WARN, f"lost at frame {format_some(lost)}"))
        if (nis := _nis_mean(track)) > LARGEST_NIS:
            out.append(
                finding("BP-N04", Level.WARN, f"the innovations are {np.sqrt(nis):.1f} times as large as their sigmas")
            )
        similar = _similar(track)
        if similar > SIMILAR_SHARE and self.settings.track.start_px is None:
            what = f"another target of similar brightness is in view in {format_percent(similar)} of the frames"
            out.append(finding("BP-N05", Level.WARN, what))
        return out

    def figures(self, track: Track[PointFrame]) -> dict[str, Any]:
        detections = sum(f.found for f in track.frames) / max(track.recording.pictures, 1)
        return {
            "detector": self.detector,
            "counts": {"longest_interval_predicted": _longest_miss(track), "detections_per_picture": detections},
            "rates": {"nis_per_number": _nis_mean(track)},
        }

    def parameters(self) -> dict[str, Any]:
        used = {TABLE: (), "spots": ("detect",)}.get(self.detector, ("blobs",))
        return {
            **{name: asdict(getattr(self.settings, name)) for name in ("track", *used)},
            **({} if self.options.colour is None else {"colour": self.options.colour}),
            "min_measured": self.options.min_measured,
            "limit": self.options.limit,
        }

    def method(self) -> str:
        how = "points of a table" if self.detector == TABLE else f"detector {self.detector}"
        return f"Duan et al. (2020): Kalman filter with a gate; {how}"

    def key_figures(self, track: Track[PointFrame]) -> list[tuple[str, str, str]]:
        nis = format_number(float(np.sqrt(_nis_mean(track))))
        return [
            ("Longest interval predicted", f"{_longest_miss(track)}", "frames"),
            ("Innovations", nis, "RMS in sigmas; 1 for a correct model"),
        ]

    def sections(self, track: Track[PointFrame]) -> list[Section]:
        axis, rate = TimeAxis.of(track), track.recording.rate_hz
        velocity = (rate or 1.0) * np.array([f.estimate.x[2:] for f in track.frames])
        unit = "px/frame" if rate is None else "px/s"
        panels = [
            axis.panel(name, unit, Line(velocity[:, i], VERMILLION, name))
            for i, name in enumerate(("rate of u", "rate of v"))
        ]
        out = [Section("Velocity", (), panels)]
        nis = _nis(track)
        if len(nis := nis[np.isfinite(nis)]):
            drawing = histogram(
                nis, (0.0, max(12.0, float(np.percentile(nis, 99)))), "Normalised innovation squared", "nis",
                footnote=f"mean {np.mean(nis):.2f}; 2 for a correct model",
            )  # fmt: skip
            words = (
                "Squared distance of each detection from the prediction, in sigmas. A mean far above 2 shows a motion"
                " or a scatter that the filter does not assume."
            )
            out.append(Section("Innovations", words, [drawing]))
        return out


class _ColourSearch:
    """Searches pictures for a hue, and notes whether any of them has colour: in grey ones the target cannot be seen."""

    def __init__(self, hue_deg: float, blobs: BlobParameters) -> None:
        self.shown = False
        self._hue_deg, self._blobs = hue_deg, blobs

    def __call__(self, picture: Any) -> Detections:
        self.shown = self.shown or has_colour(picture)
        return find_coloured(picture, self._hue_deg, self._blobs)


def _events(track: Sequence[PointEstimate]) -> list[str]:
    """What happened to the track in each frame."""
    known, ever, out = False, False, []
    for e in track:
        now = e.status is not PoseStatus.LOST
        kind = "" if now == known else "lost" if known else "reacquired" if ever else "acquired"
        known, ever = now, ever or now
        out.append(kind)
    return out


def _nis(track: Track[PointFrame]) -> Array:
    """Normalised innovations squared of the measured frames; nan where a track starts."""
    return np.array([f.estimate.nis for f in track.frames if f.status is PoseStatus.MEASURED])


def _nis_mean(track: Track[PointFrame]) -> float:
    """Their mean per number; nan without."""
    nis = _nis(track)
    return float(np.nanmean(nis)) / 2 if np.isfinite(nis).any() else float("nan")


def _longest_miss(track: Track[PointFrame]) -> int:
    """Frames predicted in a row."""
    runs = groupby(f.status for f in track.frames)
    return max((len(list(run)) for status, run in runs if status is PoseStatus.PREDICTED), default=0)


def _similar(track: Track[PointFrame]) -> float:
    """The share of the measured frames with another detection of similar brightness."""
    others = measured = 0
    for f in track.frames:
        if f.detections is None or f.status is not PoseStatus.MEASURED:
            continue
        measured += 1
        fluxes, row = f.detections.flux, f.estimate.row
        bright = np.delete(fluxes, row) >= SIMILAR_FLUX * fluxes[row]
        others += bool(bright.any()) if np.isfinite(fluxes[row]) else f.found > 1
    return others / max(measured, 1)
