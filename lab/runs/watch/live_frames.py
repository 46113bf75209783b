"""Frames as they arrive, with the same interface as recorded ones."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np

from lab.errors import BeamposeError, InputError
from lab.files.run.detections_file import LONGEST_GAP
from lab.files.run.run_file import FramesFolder, LiveDevice, Run
from lab.pictures.picture_file import GreyPicture, MissingPicture
from lab.runs.frames.frames import FrameSet
from lab.runs.watch.cameras import DeviceCamera, FolderCamera, LiveCamera, in_thread, open_device
from lab.runs.watch.frame_clock import FolderPoll
from lab.runs.watch.inbox import CameraQueue, Inbox, is_complete

FIRST = 6  # pictures of each camera for the estimate of the noise
_ARRIVALS = 200  # frames whose arrivals are compared between cameras
_START_S = 0.5  # longest wait for them, or the time of eight frames if that is more


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
    _cameras: dict[str, LiveCamera] = field(init=False)
    _stack: ExitStack = field(default_factory=ExitStack)
    _reasons: dict[str, Counter[str]] = field(default_factory=dict)
    _failures: list[BaseException] = field(default_factory=list)
    _first: int = 0

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
        if self.run.clocks:
            raise InputError(
                f"{self.run.path}: cameras.{next(iter(self.run.clocks))}: expected no clocks of single cameras in a run"
                " that is watched; take out time_offset_s, row_time_s (also of rig.yaml) and timestamps, or process the"
                " recording with `beampose run` when it is complete"
            )
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
        return queue.refused + queue.late + (source.clock.lost if isinstance(source, DeviceCamera) else 0)

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
            if queue.strays:
                out.append(f"{name}: pictures with numbers far beyond all others were left out: {_some(queue.strays)}")
        return out

    def begin(self) -> Mapping[str, list[GreyPicture]]:
        """Wait for the first pictures of every camera; up to FIRST of each, in the order of their numbers.

        Empty if the recording ended without any.

        Raises:
            InputError: the file names contain no frame numbers.
        """
        self.inbox.wanted.set()
        begun: float | None = None
        patience = max(_START_S, 8 / self.run.frame_rate_hz, self.options.timeout_s)
        with self.inbox.changed:
            while True:
                self._raise_failure()
                counts = [self._usable(queue) for queue in self.inbox.queues.values()]
                if begun is None and any(queue.pictures for queue in self.inbox.queues.values()):
                    begun = time.perf_counter()
                waited = 0.0 if begun is None else time.perf_counter() - begun
                over = self.stop.is_set() or all(queue.ended for queue in self.inbox.queues.values())
                if min(len(c) for c in counts) >= FIRST or waited > patience or over:
                    break
                self.inbox.changed.wait(0.05)
            return self._first_pictures()

    def __iter__(self) -> Iterator[FrameSet]:
        frame = self._first
        since = time.perf_counter()
        try:
            while self._wait_for(frame, since):
                with self.inbox.changed:
                    images, arrived = self.inbox.take(frame)
                    self.arrived_s[frame] = max(arrived.values(), default=None)
                    self.arrivals.append(arrived)
                    self.caught_up |= not self.inbox.has_later(frame)
                for name, content in images.items():
                    if isinstance(content, MissingPicture):
                        self._reasons[name][content.reason] += 1
                yield FrameSet(frame, images)
                frame += 1
                since = time.perf_counter()
        finally:
            self.inbox.stopping.set()

    def _wait_for(self, frame: int, since: float) -> bool:
        """Wait until a frame can be processed; False: the recording has ended before it."""
        queues = list(self.inbox.queues.values())
        with self.inbox.changed:
            while True:
                self._raise_failure()
                now = time.perf_counter()
                timeout = 0.0 if self.stop.is_set() else self.options.timeout_s
                complete, now_timed_out = is_complete(frame, queues, now, since, timeout, 1 / self.run.frame_rate_hz)
                if complete:
                    for queue in now_timed_out:
                        queue.timed_out = True
                    return True
                if not self._anything_from(frame, queues) and self._is_over(now, queues):
                    return False
                self.inbox.changed.wait(0.005)

    def _is_over(self, now: float, queues: list[CameraQueue]) -> bool:
        seen = self.inbox.last_seen_s
        idle = seen is not None and now - seen > self.options.idle_s
        return self.stop.is_set() or idle or all(queue.ended for queue in queues)

    @staticmethod
    def _anything_from(frame: int, queues: list[CameraQueue]) -> bool:
        """Whether any camera has a complete picture of this frame or a later one."""
        return any(number >= frame for queue in queues for number in queue.pictures)

    def _first_pictures(self) -> dict[str, list[GreyPicture]]:
        numbers = sorted({n for queue in self.inbox.queues.values() for n in (*queue.pictures, *queue.incomplete)})
        if not numbers:
            return {}
        gaps = np.diff(numbers)
        if gaps.size and gaps.max() > LONGEST_GAP:
            raise InputError(
                f"{self.run.path}: cameras: expected frame numbers without gaps of many thousands, got {numbers[0]} and"
                f" {numbers[int(np.argmax(gaps)) + 1]} among the first; is a stray file among them, or do the names"
                " contain a time?"
            )
        self._first = self.inbox.next_frame = numbers[0]
        return {name: self._usable(queue)[:FIRST] for name, queue in self.inbox.queues.items()}

    @staticmethod
    def _usable(queue: CameraQueue) -> list[GreyPicture]:
        contents = [waiting.content for _, waiting in sorted(queue.pictures.items(), key=lambda item: item[0])]
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
        if isinstance(source, LiveDevice):
            try:
                return open_device(name, source.device, size_px, self.inbox, self.run.frame_rate_hz)
            except BeamposeError as error:
                raise InputError(f"{self.run.path}: {error}") from None
        if not isinstance(source, FramesFolder):
            raise InputError(
                f"{self.run.path}: cameras.{name}: expected a folder of pictures or a device to watch, got"
                f" {source.path}, which is read when it is complete: use `beampose run`"
            )
        return FolderCamera(name, FolderPoll(source.path), size_px, self.inbox, self.options.timeout_s)


def _some(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers[:5])) + (", ..." if len(numbers) > 5 else "")
