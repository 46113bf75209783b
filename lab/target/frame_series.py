"""Every frame of a recording of one camera, and what its pictures are: shared by the trackers of one target."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import numpy as np

from geometry.arrays import Array, Bools
from lab.detect.inputs import PictureFiles, Video
from lab.errors import InputError
from lab.pictures.opencv import load_cv2
from lab.pictures.picture_file import DROPPED, GreyPicture, MissingPicture
from lab.runs.frames.frame_sources import open_video
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
