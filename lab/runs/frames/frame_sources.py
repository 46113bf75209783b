"""Where one camera's pictures come from: a folder, a video, or a table of points found already."""

from __future__ import annotations

import os
import re
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np

from geometry.arrays import Ints
from lab.errors import InputError
from lab.files.run.detections_file import CameraPoints
from lab.pictures.opencv import quiet_cv2
from lab.pictures.picture_file import DROPPED, SUFFIXES, UNREADABLE, Grey, Missing, checked, read_picture
from tracking.detections import Detections

if TYPE_CHECKING:
    import cv2

Picture: TypeAlias = Grey | Detections | Missing
Asked: TypeAlias = Picture | Future[Grey | Missing] | Future[Grey | Missing | None]
_LAST_NUMBER = re.compile(r"([0-9]+)[^0-9]*$")


def arrived(asked: Asked) -> Picture | None:
    """The picture that was asked for, waited for; None: the pictures have ended."""
    return asked.result() if isinstance(asked, Future) else asked


class Grabbed(Protocol):
    """An OpenCV capture that has grabbed a picture."""

    def retrieve(self) -> Any: ...


def retrieved(capture: Grabbed, size_px: tuple[int, int] | None) -> Grey | Missing:
    """The picture that a capture has grabbed, as grey of this (width, height); it may use the buffer again."""
    good, picture = capture.retrieve()
    if not good or picture is None:
        return Missing(f"{UNREADABLE}: damaged")
    if picture.ndim == 3:
        cv2 = quiet_cv2()
        picture = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if picture.shape[2] == 3 else picture[..., 0]
    return checked(picture, size_px)


class Source(Protocol):
    """Gives one camera's pictures; asked for every frame number, rising."""

    def ask(self, frame: int, pool: ThreadPoolExecutor) -> Asked:
        """This frame's picture, now or later; a future of None: the pictures have ended."""

    def close(self) -> None:
        """Give back files and threads."""


@dataclass(frozen=True, slots=True)
class FolderListing:
    """The pictures of a folder by their number, and the files that are none."""

    folder: Path
    names: dict[int, str]  # rising numbers
    ignored: tuple[str, ...]

    @property
    def numbers(self) -> Ints:
        """(n,) rising."""
        return np.fromiter(self.names, dtype=np.int64, count=len(self.names))


def number_of(name: str) -> int | None:
    """The frame number in a picture's file name: its last group of digits, before the ending. None: no such picture."""
    stem, suffix = os.path.splitext(name)
    match = _LAST_NUMBER.search(stem)
    if name.startswith(".") or suffix.lower() not in SUFFIXES or match is None or len(match[1].lstrip("0")) > 15:
        return None
    return int(match[1])


def list_folder(folder: Path) -> FolderListing:
    """Find the pictures in a folder: the number is the last group of digits of the name, without its ending.

    Raises InputError for two pictures of one number, and for a folder without any.
    """
    names: dict[int, str] = {}
    ignored = []
    try:
        with os.scandir(folder) as entries:
            found = sorted(e.name for e in entries if e.is_file())
    except OSError as error:
        raise InputError(f"{folder}: cannot be read: {error.strerror}") from None
    for name in found:
        number = number_of(name)
        if number is None:
            ignored.append(name)
            continue
        if number in names:
            raise InputError(
                f"{folder}: expected one picture per frame, got {names[number]} and {name} for frame {number};"
                " take one away"
            )
        names[number] = name
    if not names:
        others = f" among {len(ignored)} files" if ignored else ""
        raise InputError(f"{folder}: expected pictures with a number ({', '.join(SUFFIXES)}), found none{others}")
    return FolderListing(folder, dict(sorted(names.items())), tuple(ignored))


@dataclass(frozen=True, slots=True)
class FolderSource:
    """Pictures by number."""

    listing: FolderListing
    size_px: tuple[int, int]

    def ask(self, frame: int, pool: ThreadPoolExecutor) -> Asked:
        name = self.listing.names.get(frame)
        if name is None:
            return Missing(DROPPED)
        return pool.submit(read_picture, self.listing.folder / name, self.size_px)

    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class TableSource:
    """Points found already.

    Within the file's range a frame without a row is a picture in which nothing was found; one of whose rows none can be
    used is a picture that cannot be read.
    """

    points: CameraPoints | None  # None: no row of this camera
    first: int
    last: int

    def ask(self, frame: int, pool: ThreadPoolExecutor) -> Asked:
        if not self.first <= frame <= self.last:
            return Missing(DROPPED)
        if self.points is None:
            return Detections.none()
        if self.points.says_nothing_of(frame):
            return Missing(f"{UNREADABLE}: no row of it can be used")
        return self.points.at(frame)

    def close(self) -> None: ...


class VideoSource:
    """A video, decoded one picture after the other in a thread of its own."""

    def __init__(self, path: Path, size_px: tuple[int, int] | None) -> None:
        """size_px: width and height of its pictures; None: any."""
        self._capture = open_video(path)
        self._size_px = size_px
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="video")
        self.pictures = 0  # read so far

    def ask(self, frame: int, pool: ThreadPoolExecutor) -> Asked:
        return self._thread.submit(self._next) if frame >= 0 else Missing(DROPPED)

    def _next(self) -> Grey | Missing | None:
        if not self._capture.grab():
            return None
        self.pictures += 1
        return retrieved(self._capture, self._size_px)

    def skip(self) -> bool:
        """Pass over one picture; False at the end."""
        return bool(self._capture.grab())

    def next_picture(self) -> Grey | Missing | None:
        """The next picture, now; None at the end. Not to be mixed with `ask`."""
        return self._next()

    def close(self) -> None:
        self._thread.shutdown(cancel_futures=True)
        self._capture.release()


def open_video(path: Path) -> cv2.VideoCapture:
    """An opened video. Raises InputError where OpenCV cannot read it."""
    cv2 = quiet_cv2()
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise InputError(
            f"{path}: expected a video that OpenCV can read; it cannot open this file (damaged, no video?)"
        )
    capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)  # grey videos stay as they are, with 16 bits too; others still come as BGR
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # pixels where the sensor has them
    return capture


def promised_pictures(path: Path) -> int | None:
    """How many pictures the video's header promises; it may be wrong. None where it says nothing."""
    capture = open_video(path)
    count = capture.get(quiet_cv2().CAP_PROP_FRAME_COUNT)
    capture.release()
    return int(count) if 0 < count < 2**40 else None
