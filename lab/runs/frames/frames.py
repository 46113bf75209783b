"""The pictures of a run by frame number, all cameras together, read ahead in threads."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from geometry.arrays import Bools, Ints
from lab.errors import InputError
from lab.files.run.clocks import picture_numbers
from lab.files.run.detections_file import CameraPoints, DetectionsFile, is_too_sparse, read_detections, stray_frames
from lab.files.run.run_file import FramesFolder, LiveDevice, Run, VideoFile
from lab.files.text.error_text import suggest_name
from lab.pictures.picture_file import DROPPED, UNREADABLE, GreyPicture, MissingPicture
from lab.pictures.source import PictureFiles, PictureSource, Video, list_folder, pictures, video_at
from lab.runs.frames.moments import Moment
from tracking.detections import Detections

# What a camera recorded for a frame.
Recorded: TypeAlias = GreyPicture | Detections | MissingPicture

BEYOND_PX = 32.0  # a fit may put the centre of a spot at the edge outside the picture, but never farther than this
NAMED = 5  # frames that a note names for each kind of problem


@dataclass(frozen=True, slots=True)
class FrameSet:
    """The pictures of all cameras for one frame number."""

    frame: int
    images: Mapping[str, Recorded]  # by camera: grey (h, w) u8 or u16, detected points, or Missing
    moment: Moment | None = None  # of a run whose cameras have clocks of their own


@dataclass(slots=True)
class _MissingFrames:
    """The frames that one camera lacks for one reason."""

    count: int = 0
    first: list[int] = field(default_factory=list)  # the first NAMED of them


class FrameReader:
    """Iterates over all frame numbers from the first to the last of any camera. It can be iterated repeatedly.

    Pictures are read and decoded ahead in threads (lab/pictures/source.py).
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._sources: dict[str, PictureSource] = {}
        self._tables: dict[str, DetectionsFile] = {}
        self._notes: list[str] = []
        self._missing: dict[tuple[str, str], _MissingFrames] = {}  # by camera and reason
        self._ended: dict[str, str] = {}
        opened: dict[Path, DetectionsFile] = {}
        for name, source in run.cameras.items():
            if isinstance(source, FramesFolder | VideoFile):
                self._sources[name] = recorded_pictures(name, source)
            elif isinstance(source, LiveDevice):
                raise InputError(
                    f"{run.path}: cameras.{name}.device: expected recorded frames or detections, got a live camera; use"
                    " `beampose watch`"
                )
            else:
                if source.path not in opened:
                    opened[source.path] = read_detections(source.path)
                    self._note_table(source.path, opened[source.path])
                self._note_camera(name, source.path, opened[source.path])
        self.first, self.last = self._span()
        self._check_density()
        self._check_times()

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, in the rig's order."""
        return tuple(self._run.cameras)

    @property
    def sources(self) -> Mapping[str, PictureSource]:
        """The pictures of the cameras that have some."""
        return self._sources

    @property
    def _folders(self) -> list[PictureFiles]:
        return [s for s in self._sources.values() if isinstance(s, PictureFiles)]

    @property
    def _videos(self) -> dict[str, Video]:
        return {name: s for name, s in self._sources.items() if isinstance(s, Video)}

    @property
    def expected_frames(self) -> int | None:
        """Number of frame numbers, for videos by their headers; None where unknown."""
        counts = [video.count for video in self._videos.values()]
        if None in counts:
            return None
        ends = [n - 1 for n in counts if n is not None] + ([] if self.last is None else [self.last])
        return max(ends) - self.first + 1

    @property
    def moments(self) -> Sequence[Moment] | None:
        """None: one for each frame."""
        return None

    @property
    def notes(self) -> list[str]:
        """Notes for the user of the results; complete once the iteration has ended."""
        out = list(self._notes) + list(self._ended.values())
        for camera in self._run.cameras:
            for (of, reason), missing in self._missing.items():
                if of == camera:
                    some = ", ".join(map(str, missing.first)) + (", ..." if missing.count > NAMED else "")
                    out.append(f"{camera}: {missing.count} frame{'s' if missing.count > 1 else ''} {reason} ({some})")
        return out

    def __iter__(self) -> Iterator[FrameSet]:
        self._missing, self._ended = {}, {}
        videos = self._videos
        with ExitStack() as stack:
            streams = {name: stack.enter_context(closing(self._stream(name))) for name in self._run.cameras}
            for frame in count(self.first):
                if not videos and self.last is not None and frame > self.last:
                    return
                got = {name: next(stream, None) for name, stream in streams.items()}
                ended = [name for name in videos if got[name] is None]
                self._note_ends(ended, frame)
                if len(ended) == len(videos) and (self.last is None or frame > self.last):
                    return
                images = {name: MissingPicture(DROPPED) if one is None else one[1] for name, one in got.items()}
                self._count(frame, images)
                yield FrameSet(frame, images)

    def _stream(self, name: str) -> Generator[tuple[int, Any], None, None]:
        """One camera's pictures or points from the first frame on; they end with a video."""
        last = None if self._videos else self.last
        numbers = count(self.first) if last is None else range(self.first, last + 1)
        if name in self._sources:
            size_px = self._run.rig.cameras[name].image_size_px
            return pictures(self._sources[name], size_px, wanted=numbers)
        table = self._tables[name]
        return ((frame, points_at(table, name, frame, table.first, table.last)) for frame in numbers)

    def _span(self) -> tuple[int, int | None]:
        """First and last frame number; the last as far as it is known without reading videos to their end."""
        firsts = [int(v.numbers[0]) for v in self._folders] + [t.first for t in self._tables.values()]
        lasts = [int(v.numbers[-1]) for v in self._folders] + [t.last for t in self._tables.values()]
        if self._videos:
            firsts.append(0)
        return min(firsts), max(lasts) if lasts else None

    def _check_density(self) -> None:
        if self.last is None:
            return
        pictures = sum(v.count for v in self._folders)
        pictures += sum(len(c.frames) for t in self._tables.values() for c in t.cameras.values())
        if is_too_sparse(self.last - self.first + 1, pictures):
            stray = "file" if self._folders else "row"
            holders = "names" if self._folders else "frame numbers"
            raise InputError(
                f"{self._run.path}: cameras: expected frame numbers without gaps of many thousands, got {pictures}"
                f" pictures between frame {self.first} and frame {self.last}; is a stray {stray} among them, or do the"
                f" {holders} contain a time?"
            )
        self._check_strays()

    def _check_strays(self) -> None:
        """Raises InputError for a few pictures with numbers far from all others. (Tables omit such rows.)"""
        everything: list[Ints] = [v.numbers for v in self._folders]
        everything += [c.frames for t in self._tables.values() for c in t.cameras.values()]
        numbers = np.unique(np.concatenate(everything)) if everything else np.empty(0, np.int64)
        strays = stray_frames(numbers)
        for folder in self._folders:
            for number in numbers[strays].tolist():
                if number in folder.files:
                    others = numbers[~strays]
                    raise InputError(
                        f"{folder.files[number]}: expected frame numbers without a long gap, got"
                        f" {number}, where the others are {others[0]} to {others[-1]}; is it a stray file? Remove it"
                    )

    def _check_times(self) -> None:
        with_picture: list[Ints] = [v.numbers for v in self._folders]
        with_picture += [c.frames for t in self._tables.values() for c in t.cameras.values()]
        if not with_picture:
            return
        untimed = self._run.times.without_time(np.unique(np.concatenate(with_picture)))
        if untimed.size:
            raise InputError(
                f"{self._run.path}: timestamps: expected a time for every frame with a picture, got none for"
                f" {untimed.size} of them (the first is frame {untimed[0]})"
            )

    def _note_table(self, path: Path, table: DetectionsFile) -> None:
        self._notes.extend(table.notes)
        unknown = self._unknown(table)
        if unknown:
            self._notes.append(f"{path}: rows of cameras that the rig does not have are not used: {', '.join(unknown)}")

    def _unknown(self, table: DetectionsFile) -> list[str]:
        """Cameras of a table that the rig does not have."""
        known = (*self._run.rig.cameras, *self._run.left_out)
        return [c for c in (*table.cameras, *table.unusable) if c not in known]

    def _note_camera(self, name: str, path: Path, table: DetectionsFile) -> None:
        points = table.cameras.get(name)
        if points is not None:
            points = self._in_picture(name, path, points)
            self._tables[name] = replace(table, cameras={**table.cameras, name: points})
            return
        if name in table.unusable:
            raise InputError(
                f"{path}: camera {name!r}: expected rows that can be used, got none: {table.unusable[name]}; put"
                f" them right, or leave {name!r} out of `cameras` in {self._run.path}"
            )
        unknown = self._unknown(table)
        if unknown:
            raise InputError(
                f"{path}: camera: expected rows of {name!r}, got none, but rows of {', '.join(map(repr, unknown))},"
                f" which the rig does not have{suggest_name(unknown[0], self._run.rig.cameras)}"
            )
        self._tables[name] = table
        self._notes.append(f"{path}: no rows of camera {name!r}; all its pictures count as empty")

    def _in_picture(self, name: str, path: Path, points: CameraPoints) -> CameraPoints:
        """A camera's points without those far outside its picture. Raises InputError if most of them are."""
        size = np.array(self._run.rig.cameras[name].image_size_px)
        uv = points.points.uv_px
        outside: Bools = np.any((uv < -0.5 - BEYOND_PX) | (uv > size - 0.5 + BEYOND_PX), axis=-1)
        count = np.diff(points.starts)
        fullest = int(np.argmax(count))
        if count[fullest] > self._run.tracker.detect.max_detections:
            self._notes.append(
                f"{path}: camera {name!r}: up to {count[fullest]} points in one picture (frame"
                f" {points.frames[fullest]}); among so many, spots are hard to identify, and processing takes longer"
            )
        if not outside.any():
            return points
        row = int(np.flatnonzero(outside)[0])
        frame = int(points.frames[np.searchsorted(points.starts, row, side="right") - 1])
        text = (
            f"{outside.sum()} of {len(uv)} points more than {BEYOND_PX:g} px outside its picture of"
            f" {size[0]}x{size[1]} px (the first in frame {frame}, at {uv[row, 0]:.7g}, {uv[row, 1]:.7g})"
        )
        if outside.mean() > 0.5:
            raise InputError(
                f"{path}: camera {name!r}: expected points in the picture, got {text}; are u and v exchanged, or the"
                " pictures turned by 90 deg, transposed, exchanged with those of another camera, or of another size?"
            )
        self._notes.append(f"{path}: camera {name!r}: left out: {text}")
        return points.without(outside)

    def _note_ends(self, ended: Sequence[str], frame: int) -> None:
        for name in ended:
            video = self._videos[name]
            if name not in self._ended and video.count is not None and frame < video.count:
                self._ended[name] = f"{video.path}: ended after {frame} pictures; its header states {video.count}"

    def _count(self, frame: int, images: Mapping[str, Recorded]) -> None:
        for camera, picture in images.items():
            if isinstance(picture, MissingPicture):
                missing = self._missing.setdefault((camera, picture.reason), _MissingFrames())
                missing.count += 1
                if len(missing.first) < NAMED:
                    missing.first.append(frame)


def recorded_pictures(camera: str, source: FramesFolder | VideoFile) -> PictureSource:
    """The pictures that run.yaml names for a camera. Raises InputError."""
    return video_at(source.path, camera) if isinstance(source, VideoFile) else list_folder(source.path, camera)


def pictures_of_rows(run: Run, camera: str, rows: Sequence[int]) -> Generator[Recorded, None, None]:
    """One camera's picture of each of these rising rows of the tables, a few read ahead; a video from its start."""
    source = run.cameras[camera]
    if not isinstance(source, FramesFolder | VideoFile):
        kind = "a live camera" if isinstance(source, LiveDevice) else "detected points"
        yield from [MissingPicture(f"no pictures: {kind}")] * len(rows)
        return
    opened, size_px = recorded_pictures(camera, source), run.rig.cameras[camera].image_size_px
    numbers = picture_numbers(run.clocks.get(camera), run.times, np.array(rows, dtype=np.int64))
    with closing(pictures(opened, size_px, wanted=np.unique(numbers[numbers >= 0]).tolist())) as stream:
        at = -1
        picture: Recorded = MissingPicture(DROPPED)
        for number in numbers.tolist():
            while at < number:
                at, picture = next(stream, (number, MissingPicture(DROPPED)))
            yield picture if number == at >= 0 else MissingPicture(DROPPED)


def pictures_at(run: Run, camera: str, rows: Iterable[int]) -> dict[int, Recorded]:
    """Some pictures of one camera, by the number of the row in the tables."""
    rising = sorted(set(rows))
    return dict(zip(rising, pictures_of_rows(run, camera, rising), strict=True))


def points_at(table: DetectionsFile, camera: str, frame: int, first: int, last: int) -> Detections | MissingPicture:
    """Points that another program, or an earlier run, has detected in a frame.

    From the first to the last frame, a frame without rows is a picture without points; a frame whose rows are all
    invalid is a picture that cannot be read.
    """
    if not first <= frame <= last:
        return MissingPicture(DROPPED)
    points = table.cameras.get(camera)  # None: no row of this camera
    if points is None:
        return Detections.none()
    if points.has_only_unusable_rows(frame):
        return MissingPicture(f"{UNREADABLE}: no row of it can be used")
    return points.at(frame)
