"""The pictures of a run by frame number, all cameras together, read ahead in threads.

Where cameras have clocks of their own: in the order in which they are processed.
"""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np

from geometry.arrays import Bools, Ints
from lab.errors import InputError
from lab.files.run.clocks import CameraClock, picture_numbers
from lab.files.run.detections_file import CameraPoints, DetectionsFile, is_too_sparse, read_detections, stray_frames
from lab.files.run.run_file import FramesFolder, LiveDevice, Run, VideoFile
from lab.files.text.error_text import suggest_name
from lab.number_format import format_count
from lab.pictures.delivery import without_repeats
from lab.pictures.picture_file import DROPPED, UNREADABLE, GreyPicture, MissingPicture
from lab.pictures.source import PictureFiles, PictureSource, Video, list_folder, pictures, video_at
from lab.runs.frames.moments import Moment, plan_moments
from tracking.detections import Detections
from tracking.resting_points import at_places, resting_places

_SAMPLED, _FEWEST = 15, 5  # frames of a table, from which points at rest are known; in shorter recordings none are
_RESTING = 0.55  # share of these frames in which a lamp is found: it may flicker

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

    moments: Sequence[Moment] | None = None  # None: one for each frame

    def __init__(self, run: Run) -> None:
        self._run = run
        self.cameras = tuple(run.cameras)  # names, in the rig's order
        self.sources: dict[str, PictureSource] = {}  # the pictures of the cameras that have some
        self._tables: dict[str, DetectionsFile] = {}
        self._notes: list[str] = []
        self._missing: dict[tuple[str, str], _MissingFrames] = {}  # by camera and reason
        self._ended: dict[str, str] = {}
        opened: dict[Path, DetectionsFile] = {}
        for name, source in run.cameras.items():
            if isinstance(source, FramesFolder | VideoFile):
                self.sources[name] = recorded_pictures(name, source)
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
        self._mark_resting()
        self.first, self.last = self._span()
        self._check_density()
        self._check_times()

    @property
    def _folders(self) -> list[PictureFiles]:
        return [s for s in self.sources.values() if isinstance(s, PictureFiles)]

    @property
    def _videos(self) -> dict[str, Video]:
        return {name: s for name, s in self.sources.items() if isinstance(s, Video)}

    @property
    def expected_frames(self) -> int | None:
        """Number of frame numbers, for videos by their headers; None where unknown."""
        counts = [video.count for video in self._videos.values()]
        if None in counts:
            return None
        ends = [n - 1 for n in counts if n is not None] + ([] if self.last is None else [self.last])
        return max(ends) - self.first + 1

    @property
    def notes(self) -> list[str]:
        """Notes for the user of the results; complete once the iteration has ended."""
        out = list(self._notes) + list(self._ended.values())
        for camera in self._run.cameras:
            for (of, reason), missing in self._missing.items():
                if of == camera:
                    some = ", ".join(map(str, missing.first)) + (", ..." if missing.count > NAMED else "")
                    out.append(f"{camera}: {format_count(missing.count, 'frame')} {reason} ({some})")
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
        if name in self.sources:
            size_px = self._run.rig.cameras[name].image_size_px
            return without_repeats(pictures(self.sources[name], size_px, wanted=numbers))
        table = self._tables[name]
        return ((frame, points_at(table, name, frame, table.first, table.last)) for frame in numbers)

    def _span(self) -> tuple[int, int | None]:
        """First and last frame number; the last as far as it is known without reading videos to their end."""
        firsts = [int(v.numbers[0]) for v in self._folders] + [t.first for t in self._tables.values()]
        lasts = [int(v.numbers[-1]) for v in self._folders] + [t.last for t in self._tables.values()]
        if self._videos:
            firsts.append(0)
        return min(firsts), max(lasts) if lasts else None

    @property
    def _numbers_known(self) -> list[Ints]:
        """The frame numbers of folders, and of cameras in tables."""
        in_tables = [c.frames for t in self._tables.values() for c in t.cameras.values()]
        return [v.numbers for v in self._folders] + in_tables

    def _check_density(self) -> None:
        if self.last is None:
            return
        pictures = sum(map(len, self._numbers_known))
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
        numbers = np.unique(np.concatenate([*self._numbers_known, np.empty(0, np.int64)]))
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
        with_picture = np.concatenate([*self._numbers_known, np.empty(0, np.int64)])
        untimed = self._run.times.without_time(np.unique(with_picture))
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

    def _mark_resting(self) -> None:
        """Mark the points of tables that are at rest in the whole recording while others move."""
        known = {name: table.cameras[name] for name, table in self._tables.items() if name in table.cameras}
        some = {name: own.spread(_SAMPLED) for name, own in known.items()}
        if any(len(frames) < _FEWEST for frames in some.values()):
            return
        places = resting_places(some, self._run.tracker.labels.min_spots, _RESTING)
        for name, own in known.items():
            if len(places[name]):
                at_rest = at_places(own.points.uv_px, places[name]).astype(float)
                points = replace(own, points=replace(own.points, at_rest=at_rest))
                table = self._tables[name]
                self._tables[name] = replace(table, cameras={**table.cameras, name: points})

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


# The pictures of a run whose cameras have clocks of their own, in the order in which they are processed.


SAME_RATE = 1.2  # ratio of the rate by a camera's times to that of a video's header, from which they contradict
WRITTEN_BY_DEFAULT = (25.0, 30.0)  # Hz: rates that programs write where nobody states one


class FoundPoints:
    """The points found in the pictures of a recording, in unnamed temporary files, one for each camera."""

    def __init__(self, folder: Path, cameras: Iterable[str]) -> None:
        """folder: of the files."""
        self._files: dict[str, IO[bytes]] = {}
        for name in cameras:
            self._files[name] = tempfile.TemporaryFile(dir=folder, prefix=".points-")  # noqa: SIM115, until it is closed
        self._counts = dict.fromkeys(self._files, 0)

    def add(self, camera: str, number: int, points: Any) -> None:
        """Add the points of the camera's next picture, or that it is missing."""
        if camera in self._files:
            pickle.dump((number, points), self._files[camera], 4)
            self._counts[camera] += 1

    def of(self, camera: str) -> Generator[tuple[int, Any], None, None]:
        """The pictures of a camera, in their order."""
        self._files[camera].seek(0)
        for _ in range(self._counts[camera]):
            yield pickle.load(self._files[camera])  # written above, in a file that no other process can open

    def close(self) -> None:
        """Delete the files."""
        for file in self._files.values():
            file.close()


class ClockedFrames(FrameReader):
    """As FrameReader; each FrameSet is that of one of `moments`."""

    moments: tuple[Moment, ...]  # by time

    def __init__(self, run: Run) -> None:
        super().__init__(run)
        self._found: FoundPoints | None = None
        for clock in run.clocks.values():
            if clock.times is not None and (scatter := clock.times.scatter) is not None:
                self._notes.append(f"{clock.times_path}: {scatter}; the poses have that as an error")
        self._numbers = {name: self._numbers_of(name) for name in run.cameras}
        self._plan()

    def again(self, run: Run, found: FoundPoints) -> ClockedFrames:
        """The same recording with other clocks, and with the points that were found in its pictures before."""
        out = copy(self)
        out._run, out._found = run, found
        out._plan()
        return out

    def _plan(self) -> None:
        """Plan the moments for the clocks of the run."""
        run = self._run
        own = {name: (n, self._clock(name).instants_s(run.times, n)) for name, n in self._numbers.items()}
        rows = self._rows({name: t_s for name, (_, t_s) in own.items()})
        rows_s = run.times.t_s(rows)
        for name, (_, t_s) in own.items():
            if t_s[-1] < rows_s[0] or t_s[0] > rows_s[-1]:
                raise InputError(
                    f"{run.path}: cameras.{name}: expected pictures within the run, {rows_s[0]:.6g} to"
                    f" {rows_s[-1]:.6g} s, got times from {t_s[0]:.6g} to {t_s[-1]:.6g} s; are time_offset_s and the"
                    " timestamps in seconds on the run's clock?"
                )
        self.moments = tuple(plan_moments(rows, rows_s, own))

    @property
    def expected_frames(self) -> int | None:
        """Number of moments."""
        return len(self.moments)

    def __iter__(self) -> Iterator[FrameSet]:
        self._missing = {}
        with ExitStack() as stack:
            streams = {name: stack.enter_context(closing(self._stream(name))) for name in self._run.cameras}
            for moment in self.moments:
                images = {name: _picture(moment, name, streams[name]) for name in self._run.cameras}
                self._count(moment.frame, {name: images[name] for name in moment.pictures})
                yield FrameSet(moment.frame, images, moment)

    def _clock(self, name: str) -> CameraClock:
        return self._run.clocks.get(name, CameraClock())

    def _own_times(self, name: str) -> Ints | None:
        """The numbers with a time in the camera's own timestamps; None: it has none."""
        times = self._clock(name).times
        return None if times is None else times.frames

    def _stream(self, name: str) -> Generator[tuple[int, Any], None, None]:
        numbers = self._numbers[name].tolist()
        if name in self.sources and self._found is not None:
            return self._found.of(name)
        if name in self.sources:
            size_px = self._run.rig.cameras[name].image_size_px
            return without_repeats(pictures(self.sources[name], size_px, wanted=numbers))
        table = self._tables[name]
        own = self._own_times(name)
        first, last = (table.first, table.last) if own is None else (int(own[0]), int(own[-1]))
        return ((number, points_at(table, name, number, first, last)) for number in numbers)

    def _numbers_of(self, name: str) -> Ints:
        """Numbers (m,) of a camera's pictures: those of its timestamps, else those of the run's frames."""
        own = self._own_times(name)
        if own is not None:
            self._check_own_times(name, own)
            return own
        assert self.last is not None
        return np.arange(self.first, self.last + 1)

    def _check_own_times(self, name: str, own: Ints) -> None:
        """Raises InputError where a camera's own times do not fit its pictures."""
        clock, source = self._clock(name), self.sources.get(name)
        where = f"{clock.times_path}: frame"
        table = self._tables.get(name)
        if isinstance(source, Video):
            held = np.arange(_count_pictures(source))
            if len(held) != own[-1] + 1:
                raise InputError(
                    f"{where}: expected a time for each of the {len(held)} pictures of {source.path}, 0 to"
                    f" {len(held) - 1}, got numbers up to {own[-1]}"
                )
            rate_hz = 1 / float(np.median(np.diff(clock.instants_s(self._run.times, own)) / np.diff(own)))
            stated = source.rate_hz
            known = stated is not None and stated not in WRITTEN_BY_DEFAULT
            if stated is not None and known and not 1 / SAME_RATE < rate_hz / stated < SAME_RATE:
                raise InputError(
                    f"{clock.times_path}: t_s: expected about the {stated:.6g} pictures per second of the header of"
                    f" {source.path}, got {rate_hz:.6g}; correct the times, or the header"
                )
        elif isinstance(source, PictureFiles):
            held = source.numbers
        else:
            points = None if table is None else table.cameras.get(name)
            held = own if points is None else points.frames
        untimed = np.setdiff1d(held, own)
        if untimed.size:
            raise InputError(
                f"{where}: expected a time for every picture of camera {name!r}, got none for {untimed.size} of them"
                f" (the first is picture {untimed[0]})"
            )

    def _rows(self, instants: dict[str, Any]) -> Ints:
        """Frame numbers of the tables: those of the cameras without times of their own, else what the times span."""
        run = self._run
        shared = [name for name in run.cameras if self._own_times(name) is None]
        if shared:
            return np.asarray(self._numbers[shared[0]])
        if run.times.frames is not None:
            return np.arange(run.times.frames[0], run.times.frames[-1] + 1)
        begin, end = min(t[0] for t in instants.values()), max(t[-1] for t in instants.values())
        first, last = np.ceil(begin * run.frame_rate_hz - 1e-6), np.floor(end * run.frame_rate_hz + 1e-6)
        return np.arange(int(max(first, 0)), int(max(last, 0)) + 1)

    # What the reader without clocks checks of all cameras together holds for those that share the run's numbers.

    def _span(self) -> tuple[int, int | None]:
        shared = [name for name in self._run.cameras if self._own_times(name) is None]
        folders = [s for n, s in self.sources.items() if isinstance(s, PictureFiles) and n in shared]
        points = [
            self._tables[n].cameras[n].frames for n in shared if n in self._tables and n in self._tables[n].cameras
        ]
        videos = [np.arange(_count_pictures(v)) for n, v in self._videos.items() if n in shared]
        numbers = [f.numbers for f in folders] + points + videos
        return min((int(n[0]) for n in numbers), default=0), max((int(n[-1]) for n in numbers), default=0)

    def _check_density(self) -> None:
        if all(self._own_times(name) is None for name in self._run.cameras):
            super()._check_density()

    def _check_times(self) -> None:
        if all(self._own_times(name) is None for name in self._run.cameras):
            super()._check_times()


def _picture(moment: Moment, name: str, stream: Iterator[tuple[int, Any]]) -> Any:
    """The camera's next picture, if it belongs to a moment."""
    if name not in moment.pictures:
        return MissingPicture(DROPPED)
    found = next(stream, None)
    return MissingPicture(DROPPED) if found is None else found[1]


def _count_pictures(video: Video) -> int:
    """Number of pictures of a video; read to its end where the header does not state it."""
    if video.count is not None:
        return video.count
    return sum(1 for _ in pictures(video))


def open_frames(run: Run) -> FrameReader:
    """The reader of a run's pictures. Single damaged pictures are no error: they are Missing.

    Raises InputError: a folder is empty or has two pictures of one number, a video or table cannot be read, or a frame
    has no timestamp.
    """
    return ClockedFrames(run) if run.clocks else FrameReader(run)
