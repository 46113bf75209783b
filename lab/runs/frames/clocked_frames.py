"""The pictures of a run whose cameras have clocks of their own, in the order in which they are processed."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Generator, Iterable, Iterator
from contextlib import ExitStack, closing
from copy import copy
from pathlib import Path
from typing import IO, Any

import numpy as np

from geometry.arrays import Ints
from lab.errors import InputError
from lab.files.run.clocks import CameraClock
from lab.files.run.run_file import Run
from lab.pictures.picture_file import DROPPED, MissingPicture
from lab.pictures.source import PictureFiles, Video, pictures
from lab.runs.frames.frames import FrameReader, FrameSet, points_at
from lab.runs.frames.moments import Moment, plan_moments

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

    def __init__(self, run: Run) -> None:
        super().__init__(run)
        self._found: FoundPoints | None = None
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
        self._moments = tuple(plan_moments(rows, rows_s, own))

    @property
    def moments(self) -> tuple[Moment, ...]:
        """By time."""
        return self._moments

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
        if name in self._sources and self._found is not None:
            return self._found.of(name)
        if name in self._sources:
            return pictures(self._sources[name], self._run.rig.cameras[name].image_size_px, wanted=numbers)
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
        clock, source = self._clock(name), self._sources.get(name)
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
        folders = [s for n, s in self._sources.items() if isinstance(s, PictureFiles) and n in shared]
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
