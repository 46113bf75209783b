"""A target in one camera: its frames through a recording, and what each kind of target adds to the common results."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from geometry.arrays import Array, Bools
from lab.findings.finding import Finding
from lab.pictures.picture_file import GreyPicture
from lab.pictures.source import PictureSource, Video, open_inputs
from lab.progress import Progress
from lab.report.page import Section
from lab.targets.recording import DEFAULT_RATE_HZ, Recording, every_frame, read_pictures
from tracking.statuses import Cause, PoseStatus

LEAST_MEASURED = 0.5  # share of the frames; with less, the tracker may have followed something else in the others
_SMALLEST_SIDE_PX = 32


class TargetFrame(Protocol):
    """One frame of a tracker."""

    @property
    def status(self) -> PoseStatus:
        """Measured, predicted or lost."""

    @property
    def cause(self) -> Cause:
        """Why it is not measured."""

    @property
    def event(self) -> str:
        """What happened to the track (acquired, reacquired, lost, ambiguous); the empty word without an event."""

    @property
    def found(self) -> int:
        """Targets that the detector found in this frame."""

    @property
    def place(self) -> Array:
        """u, v and size (3,), px; nan where unknown."""

    @property
    def sigmas(self) -> Array:
        """Standard deviations (3,) of `place`."""


F = TypeVar("F", bound=TargetFrame)


@dataclass(frozen=True, slots=True)
class Track(Generic[F]):
    """One target in the n frames of a recording."""

    recording: Recording
    frames: Sequence[F]
    tracking_s: float  # process time of the tracker

    @property
    def places(self) -> Array:
        """u, v and size (n, 3), px; nan where unknown."""
        return np.array([f.place for f in self.frames])

    @property
    def sigmas(self) -> Array:
        """Standard deviations (n, 3) of `places`."""
        return np.array([f.sigmas for f in self.frames])

    @property
    def measured(self) -> Bools:
        """Which frames (n,) are measured."""
        return self.has_status(PoseStatus.MEASURED)

    def has_status(self, status: PoseStatus) -> Bools:
        """Which frames (n,) have a status."""
        return np.array([f.status is status for f in self.frames], dtype=bool)

    def statuses(self) -> dict[str, int]:
        """Number of frames by status, all statuses."""
        return {status.value: int(self.has_status(status).sum()) for status in PoseStatus}

    def causes(self) -> dict[Cause, int]:
        """Number of frames without a measurement by cause, the most frequent first."""
        return dict(Counter(f.cause for f in self.frames if f.cause.value).most_common())

    def events(self) -> list[tuple[int, F]]:
        """The frames with an event, and their numbers."""
        numbered = zip(self.recording.numbers.tolist(), self.frames, strict=True)
        return [(number, f) for number, f in numbered if f.event]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackOptions:
    """What can be chosen for every kind of target."""

    rate_hz: float | None = None  # frames per second; None: of the video or the table
    overlay: bool = False  # also write a video with the track
    limit: int | None = None  # largest number of pictures


class Codes(NamedTuple):
    """The codes of the findings that all kinds of targets share; empty where a kind cannot have one."""

    none: str  # never found
    few: str  # few measured frames; its variants are the causes
    missing: str  # frames without a picture
    ambiguous: str
    far: str  # found again far from the last place


class Target(ABC, Generic[F]):
    """One kind of target: how it is found, its table, and what only its results have."""

    schema: ClassVar[str]  # of summary.json
    table: ClassVar[str]  # name of its file
    columns: ClassVar[tuple[str, ...]]
    subject: ClassVar[str]  # such as circle
    size_name: ClassVar[str] = ""  # of the third number of a place; empty: a point has none
    size_radii: ClassVar[float] = 1.0  # that number, in radii of the outline
    several: ClassVar[str] = ""  # what an ambiguous frame shows
    codes: ClassVar[Codes]
    far_sizes: ClassVar[float] = np.inf  # a reacquisition farther from the last known place is reported ...
    far_words: ClassVar[str] = ""  # ... in these words
    usual_missing: ClassVar[float] = 0.0  # share of frames without a picture that is not reported
    least_measured: float = LEAST_MEASURED  # the gate
    options: TrackOptions

    @abstractmethod
    def read(self, path: Path, progress: Progress | None) -> Track[F]:
        """The track through a recording. Raises InputError."""

    @abstractmethod
    def row(self, track: Track[F], k: int) -> list[object]:
        """The row of frame k (from 0) in its table; fields without a value are empty."""

    def more_tables(self, track: Track[F]) -> Mapping[str, tuple[Sequence[str], Iterable[list[object]]]]:
        """Further tables: columns and rows by the name of the file."""
        return {}

    def findings(self, track: Track[F]) -> list[Finding]:
        """The findings that only this kind of target has."""
        return []

    @abstractmethod
    def figures(self, track: Track[F]) -> dict[str, Any]:
        """What it adds to summary.json; mappings are added to those of the same name."""

    @abstractmethod
    def parameters(self) -> dict[str, Any]:
        """All options and parameters, for summary.json."""

    @abstractmethod
    def method(self) -> str:
        """How it was found, for the page."""

    @abstractmethod
    def key_figures(self, track: Track[F]) -> list[tuple[str, str, str]]:
        """Key figures of the page of a track with measured frames."""

    @abstractmethod
    def sections(self, track: Track[F]) -> list[Section]:
        """Sections of the page."""


def track_pictures(
    path: Path, step: Callable[[GreyPicture | None], F], options: TrackOptions, progress: Progress | None
) -> Track[F]:
    """The track of a tracker through the pictures of a folder or a video.

    step: the next frame, from its picture or from None where there is no usable one. Raises InputError: no picture
    could be read, or they are too small.
    """
    inputs = open_inputs([path])
    rate = options.rate_hz or header_rate(inputs)
    recording, frames, tracking_s = read_pictures(
        inputs, path, every_frame(inputs, options.limit), step, rate or DEFAULT_RATE_HZ, limit=options.limit,
        smallest_px=_SMALLEST_SIDE_PX, progress=progress,
    )  # fmt: skip
    if rate is None:
        note = f"the frame rate is not stated: {DEFAULT_RATE_HZ:g} Hz assumed (--rate)"
        recording = replace(recording, notes=(*recording.notes, note))
    return Track(recording, frames, tracking_s)


def header_rate(source: PictureSource) -> float | None:
    """The frame rate in a video's header, Hz; None where there is none."""
    return source.rate_hz if isinstance(source, Video) else None


def texts(values: Iterable[float], decimals: int = 4) -> list[str]:
    """Fields of a table; empty for nan. Four decimals of a pixel are as many as a measurement resolves."""
    return [f"{v:.{decimals}f}" if np.isfinite(v) else "" for v in values]
