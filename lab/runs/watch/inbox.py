"""Queues of the pictures of all cameras, and the rule when a row of the tables is complete.

Without clocks of single cameras a row is a frame number, and its pictures are those of this number. Each camera fills
its queue in its own thread; one reader takes row after row.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from lab.pictures.picture_file import DROPPED, GreyPicture, MissingPicture
from lab.runs.frames.frames import Recorded
from lab.runs.frames.moments import TimedPicture
from lab.runs.watch.picture_times import PictureTimes
from tracking.detections import Detections

MOST_WAITING = 64  # pictures per camera in memory; those of a folder beyond stay on disk
LONGEST_GAP = 10_000  # frame numbers: a picture this far ahead of the reader is a stray file

Finder: TypeAlias = Callable[[GreyPicture], Detections]


@dataclass(slots=True)
class Waiting:
    """A picture that has arrived."""

    content: Recorded
    arrived_s: float | None  # time.time() at which it was complete; None: before the watch began
    seen_s: float  # time.perf_counter() at which its camera put it here


@dataclass(slots=True)
class CameraQueue:
    """The queue of one camera."""

    pictures: dict[int, Waiting] = field(default_factory=dict)
    incomplete: dict[int, tuple[float, str]] = field(default_factory=dict)  # since when (perf_counter), and why
    timed_out: bool = False  # a frame has timed out for this camera, and nothing has come since
    ended: bool = False  # no more pictures will come
    late: int = 0  # pictures that came after their frame was closed
    refused: int = 0  # pictures dropped because the queue was full
    strays: list[int] = field(default_factory=list)
    given: int = 0  # pictures in total
    grey: bool = False  # whether pictures without detections are waiting
    times: PictureTimes = field(default_factory=PictureTimes)
    untimed: int = 0  # pictures that were dropped since their time did not come

    def later_s(self, row: int) -> float | None:
        """Time (perf_counter) since which there has been a picture of a later row; None without any."""
        seen = [(n, w.seen_s) for n, w in self.pictures.items()]
        seen += [(n, since) for n, (since, _) in self.incomplete.items()]
        return min((s for n, s in seen if (of := self.times.row(n)) is not None and of > row), default=None)


def is_complete(
    row: int, queues: Sequence[CameraQueue], now_s: float, since_s: float, timeout_s: float, interval_s: float
) -> tuple[bool, list[CameraQueue]]:
    """Whether a row can be processed now, and the cameras that have timed out for it.

    The wait for a camera ends when it has delivered the row's pictures, or has had a later one for a frame interval
    (this one is dropped), or when the timeout has passed since another camera delivered one (and since `since_s`, when
    the previous row was taken). After a timeout the camera is not waited for until it delivers something.
    """
    waited_for = []
    first = []
    for queue in queues:
        due = queue.times.due(row)
        here = [queue.pictures[n] for n in due if n in queue.pictures]
        if any(isinstance(waiting.content, np.ndarray) for waiting in here):
            return False, []  # its points are being detected
        first += [waiting.seen_s for waiting in here]
        whole = len(here) == len(due) and not queue.times.may_come(row)
        if here and whole:
            continue
        later = queue.later_s(row)
        if later is not None:
            first.append(later)
        if whole:
            continue
        passed = later is not None and now_s - later >= interval_s
        if any(n in queue.incomplete for n in due) or not (queue.ended or queue.timed_out or passed):
            waited_for.append(queue)
    if not first:
        return False, []
    if waited_for and now_s - max(min(first), since_s) < timeout_s:
        return False, []
    return True, waited_for


class Inbox:
    """The queues of all cameras behind one lock. Times are time.perf_counter() unless stated otherwise."""

    def __init__(self, cameras: Sequence[str], interval_s: float, timeout_s: float) -> None:
        self.queues = {name: CameraQueue() for name in cameras}
        self.changed = threading.Condition()
        self.stopping = threading.Event()  # set to stop the cameras
        self.wanted = threading.Event()  # set to start devices; folders are polled from the start
        self.next_row: int | None = None  # the first that is not closed yet; None: not begun
        self.last_seen_s: float | None = None  # when the latest picture of any camera came
        self._finders: Mapping[str, Finder] | None = None
        self._interval_s, self._timeout_s = interval_s, timeout_s

    def has_room(self, camera: str) -> bool:
        """Whether a camera may add another picture. Only its own thread adds pictures, so the answer stays valid."""
        return len(self.queues[camera].pictures) < MOST_WAITING

    def set_finders(self, finders: Mapping[str, Finder]) -> None:
        """Detect the points of each camera's pictures from now on, in the camera's own thread."""
        with self.changed:
            self._finders = finders
            self.changed.notify_all()

    def catch_up(self, camera: str) -> None:
        """Detect the points of pictures that came before there was a finder. Called in the camera's own thread."""
        queue = self.queues[camera]
        if not (queue.grey and self._finders):
            return
        with self.changed:
            grey = sorted(n for n, w in queue.pictures.items() if isinstance(w.content, np.ndarray))
        for number in grey:
            waiting = queue.pictures[number]  # still here: no frame is taken before its points are detected
            assert isinstance(waiting.content, np.ndarray)
            found = self._finders[camera](waiting.content)
            with self.changed:
                waiting.content = found
                self.changed.notify_all()
        queue.grey = False

    def finish(self, camera: str) -> None:
        """End a camera's thread: wait for the finders, and catch up."""
        with self.changed:
            self.queues[camera].ended = True
            self.changed.notify_all()
            while self._finders is None and not self.stopping.is_set():
                self.changed.wait(0.05)
        self.catch_up(camera)

    def put(self, camera: str, number: int, content: Recorded, arrived_s: float | None) -> None:
        """Add a camera's picture, or the reason why there is none."""
        self.catch_up(camera)
        if isinstance(content, np.ndarray):
            if self._finders is None:
                self.queues[camera].grey = True
            else:
                content = self._finders[camera](content)
        with self.changed:
            queue = self.queues[camera]
            queue.incomplete.pop(number, None)
            if self._accepts(queue, number):
                queue.pictures[number] = Waiting(content, arrived_s, time.perf_counter())
                queue.given += 1
            self.changed.notify_all()

    def announce(self, camera: str, number: int, why: str) -> None:
        """Announce a camera's picture that is not complete yet."""
        with self.changed:
            queue = self.queues[camera]
            if self._accepts(queue, number, count=False):
                since = queue.incomplete[number][0] if number in queue.incomplete else time.perf_counter()
                queue.incomplete[number] = (since, why)
            self.changed.notify_all()

    def count_refused(self, camera: str) -> None:
        """Count a camera's picture that is dropped because its queue is full."""
        with self.changed:
            self.queues[camera].refused += 1

    def add_times(self, camera: str, times: list[tuple[int, float]]) -> None:
        """Add times of a camera's pictures, numbers and s."""
        with self.changed:
            queue = self.queues[camera]
            queue.times.add(times)
            for number, _ in times:
                row = queue.times.row(number)
                if row is not None and self.next_row is not None and row < self.next_row:  # it comes too late
                    queue.late += queue.pictures.pop(number, None) is not None
                    queue.times.known.pop(number)
            self.changed.notify_all()

    def take(self, row: int) -> tuple[dict[str, list[tuple[TimedPicture, Recorded]]], dict[str, float]]:
        """Take the pictures of a row by camera, in the order of their instants, and close the row.

        Also returns when (time.time()) they arrived; without those that are older than the watch.
        """
        out: dict[str, list[tuple[TimedPicture, Recorded]]] = {name: [] for name in self.queues}
        arrived: dict[str, float] = {}
        newest = max((queue.times.newest for queue in self.queues.values() if not queue.times.own), default=0)
        for name, queue in self.queues.items():
            for picture in queue.times.take(row):
                if not queue.times.own and picture.number > newest:
                    continue  # after the end of the recording
                waiting = queue.pictures.pop(picture.number, None)
                since_and_why = queue.incomplete.pop(picture.number, None)
                if waiting is None:
                    reason = DROPPED if since_and_why is None else since_and_why[1]
                    out[name].append((picture, MissingPicture(reason)))
                    continue
                out[name].append((picture, waiting.content))
                if waiting.arrived_s is not None:
                    arrived[name] = max(arrived.get(name, 0.0), waiting.arrived_s)
            oldest_s = time.perf_counter() - self._timeout_s
            for number in [n for n, w in queue.pictures.items() if queue.times.row(n) is None and w.seen_s < oldest_s]:
                del queue.pictures[number]
                queue.untimed += 1
        self.next_row = row + 1
        return out, arrived

    def has_later(self, row: int) -> bool:
        """Whether any camera has a picture of a later row."""
        return any(queue.later_s(row) is not None for queue in self.queues.values())

    def reaches(self, row: int) -> bool:
        """Whether the tables have a row, by the pictures so far: the cameras without times of their own decide."""
        times = [queue.times for queue in self.queues.values()]
        return any(t.reaches(row) for t in [t for t in times if not t.own] or times)

    def numbers(self) -> Iterator[tuple[CameraQueue, int]]:
        """All pictures that have come, also incomplete ones."""
        return ((queue, n) for queue in self.queues.values() for n in (*queue.pictures, *queue.incomplete))

    def _accepts(self, queue: CameraQueue, number: int, count: bool = True) -> bool:
        """Register the arrival of a picture; False if its row is closed, or so far ahead that it is a stray file."""
        self.last_seen_s = time.perf_counter()
        queue.timed_out = False
        row = queue.times.row(number)
        if self.next_row is not None and row is not None:
            if row < self.next_row:
                queue.late += count
                # A camera that lags by more than the timeout would delay every row by it.
                queue.timed_out = (self.next_row - row) * self._interval_s > self._timeout_s
                return False
            if row > self.next_row + LONGEST_GAP:
                queue.strays += [number] * count
                return False
        queue.times.newest = max(queue.times.newest, number)
        return True
