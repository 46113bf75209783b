"""Queues of the pictures of all cameras, when they were taken, and the rule when a row of the tables is complete.

Without clocks of single cameras a row is a frame number, and its pictures are those of this number. Each camera fills
its queue in its own thread; one reader takes row after row.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TypeAlias

import numpy as np

from lab.files.run.clocks import CameraClock, load_times, stamp_sigmas
from lab.files.run.run_file import Run
from lab.pictures.picture_file import DROPPED, GreyPicture, MissingPicture
from lab.runs.frames.frames import Recorded
from lab.runs.frames.moments import TimedPicture, row_of
from tracking.detections import Detections

_EARLY = 0.1  # of the usual time between two pictures: the next one may come earlier by this
_STAMPS = 2 * 64  # the newest times of a camera, which show the error of each: of all pictures that may be waiting


@dataclass(slots=True)
class PictureTimes:
    """The pictures of a camera: picture n is that of row n + `ahead`, or belongs to the row nearest to its own time.

    The newest of its own times are those of `clock`, with their sigmas: what a recording shows as it is made.
    """

    rate_hz: float = 1.0  # of the rows
    clock: CameraClock = CameraClock()  # noqa: RUF009  (frozen)
    first: int = 0  # number before which there is no picture
    newest: int = -1  # number of the newest picture
    known: dict[int, float] = field(default_factory=dict)  # instants of the camera's own times, until they are taken
    latest: tuple[int, float] | None = None  # number and instant of the last of these
    step_s: float = 0.0  # usual time between two of them

    @property
    def own(self) -> bool:
        """Whether the camera has times of its own."""
        return self.clock.times is not None

    @property
    def ahead(self) -> int:
        """How many rows after its own a picture belongs to, where the camera has no times of its own."""
        return row_of(self.clock.offset_s, self.rate_hz) if self.clock.offset_s else 0

    def row(self, number: int) -> int | None:
        """The row to which a picture belongs; None: its time is not known yet."""
        if not self.own:
            return number + self.ahead
        return row_of(self.known[number], self.rate_hz) if number in self.known else None

    def due(self, row: int) -> list[int]:
        """Numbers of the pictures known to belong to a row that is not closed yet."""
        if not self.own:
            return [row - self.ahead] if row - self.ahead >= self.first else []
        return [n for n, t_s in self.known.items() if row_of(t_s, self.rate_hz) <= row]

    def may_come(self, row: int) -> bool:
        """Whether a picture whose time is not known yet may belong to a row."""
        if not self.own:
            return False
        return self.latest is None or row_of(self.latest[1] + (1 - _EARLY) * self.step_s, self.rate_hz) <= row

    def reaches(self, row: int) -> bool:
        """Whether the tables have this row, as far as this camera shows."""
        if not self.own:
            return self.newest >= row
        return self.latest is not None and self.latest[1] * self.rate_hz >= row - 1e-6

    def add(self, times: list[tuple[int, float]]) -> None:
        """Add times, s, of further pictures in their order."""
        for number, t_s in times:
            instant_s = t_s + self.clock.offset_s
            if self.latest is not None:
                step_s = (instant_s - self.latest[1]) / (number - self.latest[0])
                self.step_s = min(self.step_s, step_s) if self.step_s else step_s
            self.known[number], self.latest = instant_s, (number, instant_s)
        stamps = self.clock.times
        if times and stamps is not None:
            numbers, times_s = np.array(times).T
            if stamps.frames is not None and stamps.times_s is not None:
                numbers, times_s = np.r_[stamps.frames, numbers], np.r_[stamps.times_s, times_s]
            stamps.frames, stamps.times_s = numbers[-_STAMPS:].astype(np.int64), times_s[-_STAMPS:]
            stamps.sigma_s = stamp_sigmas(stamps)

    def take(self, row: int) -> list[TimedPicture]:
        """The pictures of a row, by time; the row is closed."""
        if self.own:
            return [TimedPicture(n, self.known.pop(n)) for n in self.due(row)]
        return [TimedPicture(n, n / self.rate_hz + self.clock.offset_s) for n in self.due(row)]


@dataclass(slots=True)
class TimesFollower:
    """Reads a table of times that is being written."""

    path: Path
    rate_hz: float  # of the run
    _read: int = 0  # bytes
    _rows: list[tuple[int, float]] = field(default_factory=list)  # at most the last two

    def new(self) -> list[tuple[int, float]]:
        """Numbers and times, s, that are new since the last call. Raises InputError: the table has a mistake."""
        try:
            if os.stat(self.path).st_size <= self._read:
                return []
            with self.path.open("rb") as file:
                file.seek(self._read)
                text = file.read()
        except OSError:  # not begun yet
            return []
        whole = text[: text.rfind(b"\n") + 1]
        lines = whole.decode("utf-8", "replace").splitlines()[1 if self._read == 0 else 0 :]  # without the heads
        self._read += len(whole)
        try:
            out = [(int(number), float(t_s)) for number, t_s in (line.split(",")[:2] for line in lines)]
        except ValueError:
            out = []
            load_times(self.path, self.rate_hz)  # states the mistake
        rows = [*self._rows, *out]
        rising = all(b[0] > a[0] and b[1] > a[1] for a, b in pairwise(rows))
        if not rising or len(self._rows) < 2 <= len(rows):  # the units are checked once
            load_times(self.path, self.rate_hz)
        self._rows = rows[-2:]
        return out


def times_of(run: Run, camera: str) -> tuple[PictureTimes, TimesFollower | None]:
    """The times of a camera of a run that is watched, and the reader of its table, where it has one."""
    clock = run.clocks.get(camera, CameraClock())
    follower = None if clock.times_path is None else TimesFollower(clock.times_path, run.frame_rate_hz)
    return PictureTimes(run.frame_rate_hz, clock), follower


def complete_times(run: Run) -> None:
    """Read the tables of times of a recording that has ended into the clocks of the run. Raises InputError."""
    for clock in run.clocks.values():
        if clock.times is not None and clock.times_path is not None:
            whole = load_times(clock.times_path, run.frame_rate_hz)
            clock.times.frames, clock.times.times_s = whole.frames, whole.times_s
            clock.times.sigma_s = stamp_sigmas(whole)


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
