"""The frames of a stereo run: colour pictures or detected points of both cameras, by frame number."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from lab.binocular.stereo_run import Source, StereoRun
from lab.errors import InputError
from lab.files.run.detections_file import CameraPoints, is_too_sparse, read_detections
from lab.files.run.run_file import DetectionsTable, FramesFolder
from lab.pictures.colour import ColourPicture, colour_of, read_colour
from lab.pictures.picture_file import DROPPED, UNREADABLE, MissingPicture
from lab.runs.frames.frame_sources import list_folder, open_video
from tracking.binocular.marker_model import MarkerImages

Content = ColourPicture | MarkerImages | MissingPicture


@dataclass(frozen=True, slots=True)
class StereoFrame:
    """One frame number of both cameras, the left one first."""

    frame: int
    content: tuple[Content, Content]


class _Reader(Protocol):
    """One camera's pictures; every frame number is requested once, in increasing order."""

    @property
    def first(self) -> int:
        """The first frame number."""

    @property
    def last(self) -> int | None:
        """The last frame number; None: known at the end of the video."""

    def at(self, frame: int) -> Content | None:
        """The content of a frame; None: the video has ended."""

    def skip(self, frame: int) -> None:
        """Passes over a frame whose content is not needed."""


class _Folder:
    def __init__(self, folder: Path, size_px: tuple[int, int]) -> None:
        self._listing, self._size = list_folder(folder), size_px
        numbers = self._listing.numbers
        self.first, self.last = int(numbers[0]), int(numbers[-1])
        if is_too_sparse(self.last - self.first + 1, len(numbers)):
            raise InputError(
                f"{folder}: expected frame numbers that follow each other, got {len(numbers)} pictures from"
                f" {self.first} to {self.last}; remove stray pictures"
            )

    def at(self, frame: int) -> Content | None:
        name = self._listing.names.get(frame)
        return MissingPicture(DROPPED) if name is None else read_colour(self._listing.folder / name, self._size)

    def skip(self, frame: int) -> None: ...


class _Video:
    def __init__(self, path: Path, size_px: tuple[int, int]) -> None:
        self._capture, self._size = open_video(path, colour=True), size_px
        self.first, self.last = 0, None

    def at(self, frame: int) -> Content | None:
        if frame < 0:
            return MissingPicture(DROPPED)
        if not self._capture.grab():
            self._capture.release()
            return None
        good, picture = self._capture.retrieve()
        return colour_of(picture, self._size) if good and picture is not None else MissingPicture(UNREADABLE)

    def skip(self, frame: int) -> None:
        if frame >= 0:
            self._capture.grab()


class _Table:
    def __init__(self, path: Path, camera: str) -> None:
        table = read_detections(path)
        if camera not in table.cameras:
            raise InputError(f"{path}: camera: expected rows of {camera!r}, got none")
        self._points: CameraPoints = table.cameras[camera]
        self.first, self.last = table.first, table.last

    def at(self, frame: int) -> Content | None:
        found = self._points.at(frame)
        n = len(found.uv_px)
        return MarkerImages(found.uv_px, found.cov_px2, np.full(n, np.nan), np.zeros(n, dtype=np.int64))

    def skip(self, frame: int) -> None: ...


def _reader(source: Source, camera: str, size_px: tuple[int, int]) -> _Reader:
    if isinstance(source, FramesFolder):
        return _Folder(source.path, size_px)
    if isinstance(source, DetectionsTable):
        return _Table(source.path, camera)
    return _Video(source.path, size_px)


def _readers(run: StereoRun) -> list[_Reader]:
    return [
        _reader(source, name, camera.image_size_px)
        for (name, source), camera in zip(run.cameras.items(), run.pair.cameras, strict=True)
    ]


def stereo_frames(run: StereoRun) -> Iterator[StereoFrame]:
    """All frames, from the first to the last of any camera.

    Raises:
        InputError: a folder is empty, or a video or table cannot be read.
    """
    readers = _readers(run)
    frame = min(r.first for r in readers)
    known = [r.last for r in readers if r.last is not None]
    last = max(known) if known else -1
    ended: set[int] = set()  # videos, by their index
    while True:
        got = [MissingPicture(DROPPED) if i in ended else r.at(frame) for i, r in enumerate(readers)]
        ended |= {i for i, content in enumerate(got) if content is None}
        running = any(r.last is None and i not in ended for i, r in enumerate(readers))
        if frame > last and not running:
            return
        left, right = (MissingPicture(DROPPED) if content is None else content for content in got)
        yield StereoFrame(frame, (left, right))
        frame += 1


def frames_at(run: StereoRun, wanted: Collection[int]) -> dict[int, StereoFrame]:
    """Some frames by number. A video is read from its start. Raises InputError as `stereo_frames`."""
    if not wanted:
        return {}
    readers = _readers(run)
    out = {}
    for frame in range(min(r.first for r in readers), max(wanted) + 1):
        if frame in wanted:
            left, right = (MissingPicture(DROPPED) if c is None else c for c in (r.at(frame) for r in readers))
            out[frame] = StereoFrame(frame, (left, right))
        else:
            for r in readers:
                r.skip(frame)
    return out
