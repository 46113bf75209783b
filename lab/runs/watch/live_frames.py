"""Frames as they arrive, with the same interface as recorded ones."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np

from lab.errors import BeamposeError, InputError
from lab.files.run.detections_file import LONGEST_GAP
from lab.files.run.run_file import FramesFolder, LiveDevice, Run
from lab.number_format import format_some
from lab.pictures.picture_file import DROPPED, GreyPicture, MissingPicture
from lab.runs.frames.frames import FrameSet, Recorded
from lab.runs.frames.moments import Moment, MomentPlanner, TimedPicture
from lab.runs.smoothing_pass import ClockEstimate
from lab.runs.watch.cameras import DeviceCamera, FolderCamera, FolderPoll, LiveCamera, in_thread, open_device
from lab.runs.watch.inbox import CameraQueue, Inbox, complete_times, is_complete, times_of

FIRST = 6  # pictures of each camera for the estimate of the noise
_ARRIVALS = 200  # frames whose arrivals are compared between cameras
_START_S = 0.5  # longest wait for them, or the time of eight frames if that is more
_LATEST = 1.5  # times as long as some pictures take at the run's rate: then the wait for more of them ends


@dataclass(frozen=True, slots=True)
class WatchOptions:
    """Waiting times, s."""

    idle_s: float = 10.0  # time without a new picture after which the recording has ended
    timeout_s: float = 0.25  # longest wait for a camera whose picture is missing or damaged


@dataclass(slots=True)
class LiveFrames:
    """The frames of a run that is being recorded. Use it as a context manager; iterate once, after `begin`.

    stop: ends the recording when set, as by Ctrl-C; frames that have arrived are still processed.
    """

    run: Run
    options: WatchOptions
    stop: threading.Event = field(default_factory=threading.Event)
    inbox: Inbox = field(init=False)
    arrived_s: dict[int, float | None] = field(default_factory=dict)  # time.time(), by frame; removed by the output
    # time.time() by camera, of the last frames
    arrivals: deque[dict[str, float]] = field(default_factory=lambda: deque(maxlen=_ARRIVALS))
    caught_up: bool = False  # whether the backlog of the start has been processed
    moments: list[Moment] | None = field(init=False)  # of cameras with clocks of their own
    _cameras: dict[str, LiveCamera] = field(init=False)
    _stack: ExitStack = field(default_factory=ExitStack)
    _reasons: dict[str, Counter[str]] = field(default_factory=dict)
    _contents: dict[tuple[str, int], Recorded] = field(default_factory=dict)  # of pictures whose moment is not made yet
    _failures: list[BaseException] = field(default_factory=list)
    _first: int = 0  # row

    def __post_init__(self) -> None:
        """Raises InputError if a camera cannot be watched."""
        interval_s = 1 / self.run.frame_rate_hz
        self.inbox = Inbox(tuple(self.run.cameras), interval_s, self.options.timeout_s)
        self._reasons = {name: Counter() for name in self.run.cameras}
        if self.run.times_path is not None:
            raise InputError(
                f"{self.run.path}: timestamps: expected none in a run that is watched, since they do not exist yet;"
                " remove them: t_s is then frame / frame_rate_hz"
            )
        estimate = ClockEstimate.of(self.run)
        if estimate is not None and estimate.wide.any():
            number = estimate.numbers[int(np.argmax(estimate.wide))]
            raise InputError(
                f"{self.run.path}: cameras.{number.camera}: expected a known clock in a run that is watched, since to"
                " estimate it takes several passes; process a recording with `beampose run`, and state the numbers"
                " that it finds"
            )
        self.moments = [] if self.run.clocks else None
        self._cameras = {name: self._camera(name) for name in self.run.cameras}

    def __enter__(self) -> LiveFrames:
        for camera in self._cameras.values():
            thread = in_thread(camera, self._failed)
            self._stack.callback(thread.join, 5.0)
        self._stack.callback(self.inbox.stopping.set)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def missing(self, camera: str) -> Counter[str]:
        """Reasons why frames had no picture of a camera, each with its count."""
        return self._reasons[camera]

    def lost(self, camera: str) -> int:
        """Pictures of a camera that were lost, came too late, or were left out since they came too fast."""
        queue, source = self.inbox.queues[camera], self._cameras[camera]
        return (
            queue.refused + queue.late + queue.untimed + (source.clock.lost if isinstance(source, DeviceCamera) else 0)
        )

    @property
    def expected_frames(self) -> int | None:
        """None: the length of a live recording is unknown."""
        return None

    @property
    def notes(self) -> list[str]:
        """Notes for the user of the results."""
        out = [note for camera in self._cameras.values() for note in camera.notes]
        for name, queue in self.inbox.queues.items():
            out += [f"{name}: {count} frames {reason}" for reason, count in self._reasons[name].items()]
            if queue.late:
                out.append(
                    f"{name}: {queue.late} pictures came after their frame had been closed and were not used; `beampose"
                    " run` on the finished folder uses them"
                )
            if queue.refused:
                out.append(f"{name}: {queue.refused} pictures were left out: they came faster than they are processed")
            if queue.untimed:
                out.append(
                    f"{name}: {queue.untimed} pictures were left out: no time came for them within"
                    f" {self.options.timeout_s:g} s"
                )
            if queue.strays:
                strays = format_some(queue.strays)
                out.append(f"{name}: pictures with numbers far beyond all others were left out: {strays}")
        return out

    def begin(self) -> Mapping[str, list[GreyPicture]]:
        """Wait for the first pictures of every camera; up to FIRST of each, in the order of their numbers.

        Empty if the recording ended without any. Raises InputError: the file names contain no frame numbers.
        """
        self.inbox.wanted.set()
        self._wait_for_pictures(FIRST, max(_START_S, 8 / self.run.frame_rate_hz, self.options.timeout_s))
        with self.inbox.changed:
            return self._first_pictures()

    def more(self, cameras: Collection[str], count: int) -> dict[str, list[GreyPicture]]:
        """Wait until each of some cameras has `count` pictures that were not searched, at most MOST_WAITING of them.

        They stay in the inbox. Fewer where a camera lags, or the recording ends: the others' pictures would be lost.
        """
        self._wait_for_pictures(count, max(_START_S, _LATEST * count / self.run.frame_rate_hz), cameras)
        with self.inbox.changed:
            return {name: self._usable(self.inbox.queues[name]) for name in cameras}

    def _wait_for_pictures(self, count: int, patience_s: float, cameras: Collection[str] | None = None) -> None:
        """Wait for this many pictures of each camera, at most so long after the first one."""
        wanted = [queue for name, queue in self.inbox.queues.items() if cameras is None or name in cameras]
        begun: float | None = None
        with self.inbox.changed:
            while True:
                self._raise_failure()
                if begun is None and any(queue.pictures for queue in wanted):
                    begun = time.perf_counter()
                waited = 0.0 if begun is None else time.perf_counter() - begun
                over = self.stop.is_set() or all(queue.ended for queue in wanted)
                if min(len(self._usable(queue)) for queue in wanted) >= count or waited > patience_s or over:
                    return
                self.inbox.changed.wait(0.05)

    def __iter__(self) -> Iterator[FrameSet]:
        row = self._first if self.inbox.next_row is None else self.inbox.next_row
        since = time.perf_counter()
        steps = [queue.times.step_s or 1 / self.run.frame_rate_hz for queue in self.inbox.queues.values()]
        planner = MomentPlanner(min(steps))
        try:
            while self._wait_for(row, since):
                with self.inbox.changed:
                    given, arrived = self.inbox.take(row)
                    self.arrived_s[row] = max(arrived.values(), default=None)
                    self.arrivals.append(arrived)
                    unread = sum(camera.unread for camera in self._cameras.values())
                    later = (queue.later_s(row) for queue in self.inbox.queues.values())
                    self.caught_up |= not unread and all(t_s is None for t_s in later)
                    is_row = row >= self._first and (self.moments is None or self.inbox.reaches(row))
                for name, pictures in given.items():
                    for _, content in pictures:
                        if isinstance(content, MissingPicture):
                            self._reasons[name][content.reason] += 1
                if self.moments is None:
                    yield FrameSet(row, {name: content for name, ((_, content),) in given.items()})
                else:
                    yield from self._at_moments(planner, row, given, is_row)
                row += 1
                since = time.perf_counter()
            yield from self._sets(planner.rest())
            complete_times(self.run)
        finally:
            self.inbox.stopping.set()

    def _at_moments(
        self,
        planner: MomentPlanner,
        row: int,
        given: Mapping[str, list[tuple[TimedPicture, Recorded]]],
        is_row: bool,
    ) -> Iterator[FrameSet]:
        """The moments up to a row, from the pictures nearest to it."""
        self._contents |= {(name, p.number): content for name, of in given.items() for p, content in of}
        pictures = {name: [p for p, _ in of] for name, of in given.items()}
        if is_row:
            yield from self._sets(planner.row(row, row / self.run.frame_rate_hz, pictures))
        else:
            planner.without_row(pictures)

    def _sets(self, moments: Iterator[Moment]) -> Iterator[FrameSet]:
        for moment in moments:
            assert self.moments is not None
            self.moments.append(moment)
            images: dict[str, Recorded] = {name: MissingPicture(DROPPED) for name in self.run.cameras}
            images |= {name: self._contents.pop((name, p.number)) for name, p in moment.pictures.items()}
            yield FrameSet(moment.frame, images, moment)

    def _wait_for(self, row: int, since: float) -> bool:
        """Wait until a row can be processed; False: the recording has ended before it."""
        queues = list(self.inbox.queues.values())
        with self.inbox.changed:
            while True:
                self._raise_failure()
                now = time.perf_counter()
                timeout = 0.0 if self.stop.is_set() else self.options.timeout_s
                over = self._is_over(now, queues)
                complete, now_timed_out = is_complete(row, queues, now, since, timeout, 1 / self.run.frame_rate_hz)
                if complete and (self.moments is None or over or self.inbox.reaches(row)):
                    for queue in now_timed_out:
                        queue.timed_out = True
                    return True
                if over and not self._anything_from(row):
                    return False
                self.inbox.changed.wait(0.005)

    def _is_over(self, now: float, queues: list[CameraQueue]) -> bool:
        seen = self.inbox.last_seen_s
        idle = seen is not None and now - seen > self.options.idle_s
        return self.stop.is_set() or idle or all(queue.ended for queue in queues)

    def _anything_from(self, row: int) -> bool:
        """Whether any camera has a complete picture of this row or a later one."""
        rows = (queue.times.row(n) for queue in self.inbox.queues.values() for n in queue.pictures)
        return any(of is not None and of >= row for of in rows)

    def _first_pictures(self) -> dict[str, list[GreyPicture]]:
        every = [(queue, n, row) for queue, n in self.inbox.numbers() if (row := queue.times.row(n)) is not None]
        numbers = sorted({row for _, _, row in every})
        if not numbers:
            return {}
        gaps = np.diff(numbers)
        if gaps.size and gaps.max() > LONGEST_GAP:
            raise InputError(
                f"{self.run.path}: cameras: expected frame numbers without gaps of many thousands, got {numbers[0]} and"
                f" {numbers[int(np.argmax(gaps)) + 1]} among the first; is a stray file among them, or do the names"
                " contain a time?"
            )
        shared = [n for queue, n, _ in every if not queue.times.own]
        own_s = [s for queue in self.inbox.queues.values() for s in queue.times.known.values()]
        self._first = min(shared) if shared else max(int(np.ceil(min(own_s) * self.run.frame_rate_hz - 1e-6)), 0)
        self.inbox.next_row = numbers[0]
        for queue in self.inbox.queues.values():
            queue.times.first = self._first
        return {name: self._usable(queue)[:FIRST] for name, queue in self.inbox.queues.items()}

    @staticmethod
    def _usable(queue: CameraQueue) -> list[GreyPicture]:
        waiting = [(n, w.content) for n, w in queue.pictures.items() if queue.times.row(n) is not None]
        contents = [content for _, content in sorted(waiting, key=lambda item: item[0])]
        return [content for content in contents if isinstance(content, np.ndarray)]

    def _failed(self, error: BaseException) -> None:
        with self.inbox.changed:
            self._failures.append(error)
            self.inbox.changed.notify_all()

    def _raise_failure(self) -> None:
        if self._failures:
            raise self._failures[0]

    def _camera(self, name: str) -> FolderCamera | DeviceCamera:
        source, size_px = self.run.cameras[name], self.run.rig.cameras[name].image_size_px
        self.inbox.queues[name].times, follower = times_of(self.run, name)
        if isinstance(source, LiveDevice):
            if follower is not None:
                raise InputError(
                    f"{self.run.path}: cameras.{name}.timestamps: expected none for a device, which writes no table;"
                    " watch the folder that `beampose record` fills"
                )
            try:
                return open_device(name, source.device, size_px, self.inbox, self.run.frame_rate_hz)
            except BeamposeError as error:
                raise InputError(f"{self.run.path}: {error}") from None
        if not isinstance(source, FramesFolder):
            raise InputError(
                f"{self.run.path}: cameras.{name}: expected a folder of pictures or a device to watch, got"
                f" {source.path}, which is read when it is complete: use `beampose run`"
            )
        return FolderCamera(name, FolderPoll(source.path), size_px, self.inbox, self.options.timeout_s, follower)
