"""Every frame of a recording of one camera, and what its pictures are: shared by the trackers of one target."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Protocol, Self, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.findings import Finding, Level, verdict
from geometry.arrays import Array, Bools
from lab.detect.inputs import PictureFiles, Video
from lab.errors import QUALITY_GATE_FAILED, InputError, RunError
from lab.files.run.fingerprints import fingerprints_of
from lab.files.text.json_text import has_schema
from lab.pictures.opencv import load_cv2
from lab.pictures.picture_file import DROPPED, GreyPicture, MissingPicture
from lab.runs.frames.frame_sources import open_video
from lab.versions import versions
from tracking.statuses import PoseStatus

DEFAULT_RATE_HZ = 25.0  # of a folder of pictures, whose rate is not known
MOST_EVENTS = 500  # listed in summary.json; of the others the number is reported
_MOST_GAP = 10_000  # frame numbers without a picture between two pictures
_SMALLEST_SIDE_PX = 32
_COMPLETE_SHARE = 0.98  # of the pictures that a video's header states


class TargetFrame(Protocol):
    """One frame of a tracker."""

    @property
    def status(self) -> PoseStatus:
        """Measured, predicted or lost."""

    @property
    def cause(self) -> StrEnum:
        """Why it is not measured; the empty word where it is."""

    @property
    def event(self) -> str:
        """What happened to the track; the empty word without an event."""

    @property
    def found(self) -> int:
        """Targets that the detector found in this frame."""


F = TypeVar("F", bound=TargetFrame)


@dataclass(slots=True, kw_only=True)
class FrameSeries(Generic[F]):
    """The frames of a recording so far. The trackers' own series add what they measure."""

    name: str
    source: str
    rate_hz: float
    notes: list[str] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    frames: list[F] = field(default_factory=list)
    missing: Counter[str] = field(default_factory=Counter)  # reasons of frames without a picture
    pictures: int = 0  # usable ones
    size_px: tuple[int, int] | None = None  # width, height of the first picture

    @property
    def t_s(self) -> Array:
        """Times (n,)."""
        return np.array(self.numbers, dtype=float) / self.rate_hz

    def add(self, number: int, frame: F) -> None:
        """Add the next frame."""
        self.numbers.append(number)
        self.frames.append(frame)

    def has_status(self, status: PoseStatus) -> Bools:
        """Which frames (n,) have a status."""
        return np.array([f.status is status for f in self.frames], dtype=bool)

    def statuses(self) -> dict[str, int]:
        """Number of frames by status, all statuses."""
        return {status.value: int(self.has_status(status).sum()) for status in PoseStatus}

    def causes(self) -> dict[str, int]:
        """Number of frames without a measurement by cause, the most frequent first."""
        return dict(Counter(f.cause.value for f in self.frames if f.cause.value).most_common())

    def events(self, targets: str) -> list[dict[str, object]]:
        """Frame, kind and number of targets of every event. targets: the name of the number."""
        return [
            {"frame": number, "kind": f.event, targets: f.found}
            for number, f in zip(self.numbers, self.frames, strict=True)
            if f.event
        ]

    def usable(self, picture: GreyPicture | MissingPicture) -> GreyPicture | None:
        """Count a picture, and return it if it is one of this recording: of the size of the first."""
        checked = of_one_size(picture, self.size_px)
        if isinstance(checked, MissingPicture):
            self.missing[checked.reason] += 1
            return None
        self.pictures += 1
        self.size_px = (checked.shape[1], checked.shape[0])
        return checked

    def require_pictures(self, given: Path, stated: int | None, limit: int | None) -> None:
        """Check that pictures were read; a note where a video ends early.

        stated: number of pictures by the header; limit: of the pictures that are read.

        Raises:
            InputError: no picture could be read, or they are too small.
        """
        if not self.pictures:
            reason = self.missing.most_common(1)[0][0] if self.missing else "the file ends before its first picture"
            raise InputError(f"{given}: expected pictures, got none that can be read: {reason}")
        if self.size_px is not None and min(self.size_px) < _SMALLEST_SIDE_PX:
            raise InputError(
                f"{given}: expected pictures of {_SMALLEST_SIDE_PX} x {_SMALLEST_SIDE_PX} px or more, got"
                f" {self.size_px[0]} x {self.size_px[1]}"
            )
        ended = given.is_file() and self.numbers[0] == 0 and limit is None
        if ended and stated is not None and len(self.numbers) < _COMPLETE_SHARE * stated:
            self.notes.append(
                f"the video ends after {len(self.numbers)} of the {stated} pictures that its header states"
            )


def of_one_size(picture: GreyPicture | MissingPicture, size_px: tuple[int, int] | None) -> GreyPicture | MissingPicture:
    """The picture, or missing where its (width, height) is not that of the first: pixels would not be comparable."""
    if isinstance(picture, MissingPicture) or size_px in (None, (picture.shape[1], picture.shape[0])):
        return picture
    assert size_px is not None
    return MissingPicture(
        f"another size: {picture.shape[1]}x{picture.shape[0]} px, the first picture has {size_px[0]}x{size_px[1]}"
    )


def frame_rate(inputs: PictureFiles | Video, given_hz: float | None) -> tuple[float, list[str]]:
    """Frames per second, and a note where they are assumed. given_hz: what the user states."""
    if given_hz is not None:
        return given_hz, []
    if isinstance(inputs, Video):
        capture = open_video(inputs.path)
        rate = float(capture.get(load_cv2().CAP_PROP_FPS))
        capture.release()
        if np.isfinite(rate) and 0.01 <= rate <= 1e6:
            return rate, []
    return DEFAULT_RATE_HZ, [f"the frame rate is not stated: {DEFAULT_RATE_HZ:g} Hz assumed (--rate)"]


def every_frame(inputs: PictureFiles | Video) -> Iterator[tuple[int, GreyPicture | MissingPicture]]:
    """All frame numbers from the first to the last with their pictures; a gap in the numbers is dropped frames.

    Raises:
        InputError: the numbers in the names of the pictures are not those of frames.
    """
    last: int | None = None
    for number, picture in inputs.pictures(1):
        if last is not None:
            if number - last > _MOST_GAP:
                raise InputError(
                    f"{inputs.camera}: expected pictures numbered by frame, got {last} and then {number}; rename them"
                )
            for dropped in range(last + 1, number):
                yield dropped, MissingPicture(DROPPED)
        yield number, picture
        last = number


# overlay.avi: the pictures with the circle, its centre and the status drawn into them.


FILE_NAME = "overlay.avi"
_SHIFT = 4  # bits of sub-pixel positions in OpenCV's drawing functions
_COLOURS = {PoseStatus.MEASURED: (60, 220, 60), PoseStatus.PREDICTED: (30, 160, 255), PoseStatus.LOST: (60, 60, 230)}
_LEAST_RATE_HZ, _MOST_RATE_HZ = 1.0, 60.0  # of the video: players do not show others well


def drawn(
    picture: GreyPicture | None, size_px: tuple[int, int], label: str, status: PoseStatus, circle: Array
) -> NDArray[np.uint8]:
    """One picture (h, w, 3), BGR, of size_px (width, height); black where there is none.

    circle: u, v, radius, px; nan where nothing is known. label: words in the corner.
    """
    width, height = size_px
    grey = np.zeros((height, width), np.uint8)
    if picture is not None:
        eight = picture if picture.dtype == np.uint8 else (picture >> 8).astype(np.uint8)
        h, w = min(height, eight.shape[0]), min(width, eight.shape[1])
        grey[:h, :w] = eight[:h, :w]
    image = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    colour = _COLOURS[status]
    line = max(1, round(min(size_px) / 500))
    if np.isfinite(circle).all() and np.abs(circle).max() < 1e5:
        u, v, radius = circle
        at = (round(float(u) * 2**_SHIFT), round(float(v) * 2**_SHIFT))
        size = max(round(float(radius) * 2**_SHIFT), 1)
        cv2.circle(image, at, size, colour, line, cv2.LINE_AA, _SHIFT)
        cv2.drawMarker(image, (round(float(u)), round(float(v))), colour, cv2.MARKER_CROSS, 9 * line, line)
    scale = 0.45 * line
    cv2.putText(image, label, (6, 8 + round(14 * scale / 0.45)), cv2.FONT_HERSHEY_SIMPLEX, scale, colour, line)
    return np.asarray(image, np.uint8)


def label_of(number: int, status: PoseStatus, cause: str) -> str:
    """Frame number, status and cause as words."""
    return f"{number}  {status.value}" + (f" ({cause})" if cause else "")


class OverlayVideo:
    """Writes the video (Motion JPEG), a picture per frame."""

    def __init__(self, folder: Path, rate_hz: float) -> None:
        self._path = folder / FILE_NAME
        self._rate_hz = float(np.clip(rate_hz, _LEAST_RATE_HZ, _MOST_RATE_HZ))
        self._writer: cv2.VideoWriter | None = None
        self._size_px = (0, 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.release()

    def add(self, picture: GreyPicture | None, label: str, status: PoseStatus, circle: Array) -> None:
        """Add a frame; the first picture decides the size. Raises RunError where OpenCV cannot write the video."""
        if self._writer is None:
            if picture is None:
                return
            self._size_px = (picture.shape[1], picture.shape[0])
            code = cv2.VideoWriter.fourcc(*"MJPG")
            self._writer = cv2.VideoWriter(str(self._path), code, self._rate_hz, self._size_px)
            if not self._writer.isOpened():
                raise RunError(f"{FILE_NAME}: OpenCV cannot write a Motion JPEG video here; leave out --video")
        self._writer.write(drawn(picture, self._size_px, label, status, circle))


# Verdict words, outcome of a call and summary.json of a tracked target.


WORDS = {Level.PASS: "pass", Level.WARN: "check", Level.FAIL: "fail"}
Progress = Callable[[int, int | None], None]  # frames done, total number where known


@dataclass(frozen=True, slots=True)
class TargetOutcome:
    """The outcome of one call."""

    name: str
    out: Path
    frames: int
    measured: int
    findings: tuple[Finding, ...]  # failures first

    @property
    def exit_status(self) -> int:
        """0, or 4 where a quality gate failed."""
        return exit_status(verdict(self.findings))

    def line(self) -> str:
        """One line for the command line; where a gate failed, with the remedy."""
        level = verdict(self.findings)
        reasons = "; ".join(f.what for f in self.findings if f.level is level)
        if level is Level.WARN:
            reasons = f"{self.measured} of {self.frames} frames measured; {reasons}"
        remedy = f". {self.findings[0].remedy}" if level is Level.FAIL else ""
        return f"{self.name}: {WORDS[level].upper()}: {reasons}{remedy} -> {self.out}"


@dataclass(frozen=True, slots=True)
class Content:
    """What a command adds to the summary."""

    schema: str
    block: str  # name of its own figures
    figures: dict[str, Any]
    parameters: dict[str, Any]
    targets: str  # name of the number of targets of an event


def exit_status(level: Level) -> int:
    """0, or 4 where a quality gate failed."""
    return QUALITY_GATE_FAILED if level is Level.FAIL else 0


def results_of(schema: str) -> Callable[[Path], bool]:
    """Whether a folder holds the results of an earlier call, by the schema of its summary."""

    def are_results(folder: Path) -> bool:
        return has_schema(folder, schema)

    return are_results


def quantiles(values: Array) -> dict[str, float] | None:
    """5 %, median and 95 % of the finite values; None without one."""
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    return dict(zip(("p5", "median", "p95"), np.percentile(values, [5, 50, 95]).tolist(), strict=True))


def summary_of(
    series: FrameSeries[F],
    findings: Sequence[Finding],
    given: Path,
    content: Content,
    timings_s: tuple[float, float],
) -> dict[str, Any]:
    """The content of summary.json. timings_s: process time of the tracker, wall time of the call."""
    events = series.events(content.targets)
    level = verdict(findings)
    tracking_s, wall_s = timings_s
    return {
        "schema": content.schema,
        "name": series.name,
        "source": str(given.resolve()),
        "verdict": {
            "status": WORDS[level],
            "reasons": [f.what for f in findings],
            "exit_status": exit_status(level),
            "evidence": [
                {"level": WORDS[f.level], "what": f.what, "why": f.why, "remedy": f.remedy, "code": f.code}
                for f in findings
            ],
        },
        "counts": {
            "frames": len(series.frames),
            "pictures": series.pictures,
            "status": series.statuses(),
            "not_measured": series.causes(),
            "no_image_reasons": dict(series.missing),
            "events": len(events),
        },
        "rates": {
            "measured_share": series.statuses()["measured"] / len(series.frames),
            "frame_rate_hz": series.rate_hz,
            "processed_frames_per_s": len(series.frames) / wall_s if wall_s > 0 else None,
        },
        content.block: content.figures,
        "timings": {"tracking_process_s": tracking_s, "wall_s": wall_s},
        "versions": versions(),
        "parameters": content.parameters,
        "inputs": fingerprints_of((), (given,)),
        "notes": series.notes,
        "events": events[:MOST_EVENTS],
    }


# The loop over the pictures of a recording, for any tracker of one target.


def follow(
    series: FrameSeries[F],
    inputs: PictureFiles | Video,
    given: Path,
    step: Callable[[GreyPicture | None], F],
    circle: Callable[[F], Array],
    overlay_folder: Path | None,
    limit: int | None,
    progress: Progress | None,
) -> float:
    """Give every picture to a tracker, and its frames to the series. Returns the process time of the tracker, s.

    step: the tracker; circle: u, v, radius (3,), px, of a frame. overlay_folder: gets overlay.avi; None: no video.
    limit: largest number of frames.

    Raises:
        InputError: no picture could be read, or they are too small.
        RunError: OpenCV cannot write the video.
    """
    tracking_s = 0.0
    video = contextlib.nullcontext() if overlay_folder is None else OverlayVideo(overlay_folder, series.rate_hz)
    with video as overlay:
        total = inputs.count(1)
        for number, picture in islice(every_frame(inputs), limit):
            usable = series.usable(picture)
            begun = time.process_time()
            frame = step(usable)
            tracking_s += time.process_time() - begun
            series.add(number, frame)
            if overlay is not None:
                label = label_of(number, frame.status, frame.cause.value)
                overlay.add(usable, label, frame.status, circle(frame))
            if progress is not None:
                progress(len(series.frames), total)
    series.require_pictures(given, total, limit)
    return tracking_s
