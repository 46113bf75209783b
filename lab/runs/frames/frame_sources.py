"""Sources of one camera's pictures: a folder, a video, or a table of detected points."""

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
from lab.files.text.regular_file import require_regular_file
from lab.pictures.opencv import load_cv2, opened
from lab.pictures.picture_file import (
    DROPPED,
    PICTURE_SUFFIXES,
    UNREADABLE,
    GreyPicture,
    MissingPicture,
    read_picture,
    require_format,
)
from tracking.detections import Detections

if TYPE_CHECKING:
    import cv2

Picture: TypeAlias = GreyPicture | Detections | MissingPicture
Requested: TypeAlias = Picture | Future[GreyPicture | MissingPicture] | Future[GreyPicture | MissingPicture | None]
_LAST_NUMBER = re.compile(r"([0-9]+)[^0-9]*$")


def result_of(requested: Requested) -> Picture | None:
    """Wait for a requested picture; None: the pictures have ended."""
    return requested.result() if isinstance(requested, Future) else requested


class Grabbed(Protocol):
    """An OpenCV capture that has grabbed a picture."""

    def retrieve(self) -> Any: ...


def retrieved(capture: Grabbed, size_px: tuple[int, int] | None) -> GreyPicture | MissingPicture:
    """The picture that a capture has grabbed, as grey values of this (width, height).

    The array may be the capture's own buffer, which the next picture overwrites.
    """
    good, picture = capture.retrieve()
    if not good or picture is None:
        return MissingPicture(f"{UNREADABLE}: damaged")
    if picture.ndim == 3:
        cv2 = load_cv2()
        to_grey = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}.get(picture.shape[2])
        picture = picture[..., 0] if to_grey is None else cv2.cvtColor(picture, to_grey)
    return require_format(picture, size_px)


class Source(Protocol):
    """One camera's pictures. Every frame number is requested once, in increasing order."""

    def request(self, frame: int, pool: ThreadPoolExecutor) -> Requested:
        """This frame's picture, or a future of it; a future of None: the pictures have ended."""

    def close(self) -> None:
        """Close files and threads."""


@dataclass(frozen=True, slots=True)
class FolderListing:
    """The pictures of a folder by frame number, and the files that are not pictures."""

    folder: Path
    names: dict[int, str]  # by increasing frame number
    ignored: tuple[str, ...]

    @property
    def numbers(self) -> Ints:
        """Frame numbers (n,), increasing."""
        return np.fromiter(self.names, dtype=np.int64, count=len(self.names))


def number_of(name: str) -> int | None:
    """The frame number in a picture's file name: the last group of digits before the suffix. None: not a picture."""
    stem, suffix = os.path.splitext(name)
    match = _LAST_NUMBER.search(stem)
    if (
        name.startswith(".")
        or suffix.lower() not in PICTURE_SUFFIXES
        or match is None
        or len(match[1].lstrip("0")) > 15
    ):
        return None
    return int(match[1])


def list_folder(folder: Path) -> FolderListing:
    """Find the pictures in a folder, with the frame number from their names (see `number_of`).

    Raises:
        InputError: two pictures have the same number, or the folder has none or cannot be read.
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
                " remove one"
            )
        names[number] = name
    if not names:
        others = f" among {len(ignored)} files" if ignored else ""
        raise InputError(
            f"{folder}: expected pictures with a number ({', '.join(PICTURE_SUFFIXES)}), found none{others}"
        )
    return FolderListing(folder, dict(sorted(names.items())), tuple(ignored))


@dataclass(frozen=True, slots=True)
class FolderSource:
    """Picture files by frame number."""

    listing: FolderListing
    size_px: tuple[int, int]

    def request(self, frame: int, pool: ThreadPoolExecutor) -> Requested:
        name = self.listing.names.get(frame)
        if name is None:
            return MissingPicture(DROPPED)
        return pool.submit(read_picture, self.listing.folder / name, self.size_px)

    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class TableSource:
    """Points that another program, or an earlier run, has detected.

    Within the file's range, a frame without rows is a picture without points; a frame whose rows are all invalid is a
    picture that cannot be read.
    """

    points: CameraPoints | None  # None: no row of this camera
    first: int
    last: int

    def request(self, frame: int, pool: ThreadPoolExecutor) -> Requested:
        if not self.first <= frame <= self.last:
            return MissingPicture(DROPPED)
        if self.points is None:
            return Detections.none()
        if self.points.has_only_unusable_rows(frame):
            return MissingPicture(f"{UNREADABLE}: no row of it can be used")
        return self.points.at(frame)

    def close(self) -> None: ...


class VideoSource:
    """A video, decoded picture by picture in its own thread."""

    def __init__(self, path: Path, size_px: tuple[int, int] | None) -> None:
        """size_px: width and height of its pictures; None: any size."""
        self._capture = open_video(path)
        self._size_px = size_px
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="video")
        self.pictures = 0  # number read so far

    def request(self, frame: int, pool: ThreadPoolExecutor) -> Requested:
        return self._thread.submit(self._next) if frame >= 0 else MissingPicture(DROPPED)

    def _next(self) -> GreyPicture | MissingPicture | None:
        if not self._capture.grab():
            return None
        self.pictures += 1
        return retrieved(self._capture, self._size_px)

    def skip(self) -> bool:
        """Skip one picture; False at the end."""
        return bool(self._capture.grab())

    def next_picture(self) -> GreyPicture | MissingPicture | None:
        """The next picture; None at the end. Must not be mixed with `request`."""
        return self._next()

    def close(self) -> None:
        self._thread.shutdown(cancel_futures=True)
        self._capture.release()


def open_video(path: Path, colour: bool = False) -> cv2.VideoCapture:
    """Open a video. colour: its pictures come as BGR; else grey videos stay as they are, and most others come as grey.

    Raises:
        InputError: OpenCV cannot read it.
    """
    require_regular_file(path)
    cv2 = load_cv2()
    capture = opened(str(path))
    if not capture.isOpened():
        raise InputError(
            f"{path}: expected a video that OpenCV can read; it cannot open this file (damaged, no video?)"
        )
    if not colour:
        # Keeps grey videos, of 8 or 16 bits, unchanged; of YUV videos only the luma comes, of RGB videos all channels.
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    return capture


def header_picture_count(path: Path) -> int | None:
    """Number of pictures by the video's header, which may be wrong; None where it states none."""
    count = _stated(path, load_cv2().CAP_PROP_FRAME_COUNT)
    return int(count) if 0 < count < 2**40 else None


def header_rate_hz(path: Path) -> float | None:
    """Pictures per second by the video's header, which may be wrong; None where it states none."""
    rate = _stated(path, load_cv2().CAP_PROP_FPS)
    return rate if 0 < rate < 2**40 else None


def _stated(path: Path, what: int) -> float:
    capture = open_video(path)
    number = capture.get(what)
    capture.release()
    return float(number)
