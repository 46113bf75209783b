"""Queues of the pictures of all cameras, and the rule when a frame is complete.

Each camera fills its queue in its own thread; one reader takes frame after frame.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from lab.pictures.picture_file import DROPPED, GreyPicture, MissingPicture
from tracking.detections import Detections

MOST_WAITING = 64  # pictures per camera in memory; those of a folder beyond stay on disk
LONGEST_GAP = 10_000  # frame numbers: a picture this far ahead of the reader is a stray file

Content: TypeAlias = GreyPicture | Detections | MissingPicture
Finder: TypeAlias = Callable[[GreyPicture], Detections]


@dataclass(slots=True)
class Waiting:
    """A picture that has arrived."""

    content: Content
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

    def later_s(self, frame: int) -> float | None:
        """Time (perf_counter) since which there has been a picture of a later frame; None without any."""
        times = [w.seen_s for n, w in self.pictures.items() if n > frame]
        times += [since for n, (since, _) in self.incomplete.items() if n > frame]
        return min(times, default=None)


def is_complete(
    frame: int, queues: Sequence[CameraQueue], now_s: float, since_s: float, timeout_s: float, interval_s: float
) -> tuple[bool, list[CameraQueue]]:
    """Whether a frame can be processed now, and the cameras that have timed out for it.

    The wait for a camera ends when it has delivered the frame's picture, or has had a later one for a frame interval
    (this one is dropped), or when the timeout has passed since another camera delivered the frame (and since `since_s`,
    when the previous frame was taken). After a timeout the camera is not waited for until it delivers something.
    """
    waited_for = []
    first = []
    for queue in queues:
        if frame in queue.pictures:
            if isinstance(queue.pictures[frame].content, np.ndarray):
                return False, []  # its points are being detected
            first.append(queue.pictures[frame].seen_s)
            continue
        later = queue.later_s(frame)
        if later is not None:
            first.append(later)
        passed = later is not None and now_s - later >= interval_s
        if frame in queue.incomplete or not (queue.ended or queue.timed_out or passed):
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
        self.next_frame: int | None = None  # the first that is not closed yet; None: not begun
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

    def put(self, camera: str, number: int, content: Content, arrived_s: float | None) -> None:
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

    def take(self, frame: int) -> tuple[dict[str, Content], dict[str, float]]:
        """Take a frame's pictures by camera, and close the frame.

        Also returns when (time.time()) they arrived; without those that are older than the watch.
        """
        out: dict[str, Content] = {}
        arrived: dict[str, float] = {}
        for name, queue in self.queues.items():
            waiting = queue.pictures.pop(frame, None)
            since_and_why = queue.incomplete.pop(frame, None)
            if waiting is not None:
                out[name] = waiting.content
                if waiting.arrived_s is not None:
                    arrived[name] = waiting.arrived_s
            else:
                out[name] = MissingPicture(DROPPED if since_and_why is None else since_and_why[1])
        self.next_frame = frame + 1
        return out, arrived

    def has_later(self, frame: int) -> bool:
        """Whether any camera has a picture of a later frame."""
        return any(queue.later_s(frame) is not None for queue in self.queues.values())

    def _accepts(self, queue: CameraQueue, number: int, count: bool = True) -> bool:
        """Register the arrival of a picture; False if its frame is closed, or so far ahead that it is a stray file."""
        self.last_seen_s = time.perf_counter()
        queue.timed_out = False
        if self.next_frame is None:
            return True
        if number < self.next_frame:
            queue.late += count
            # A camera that lags by more than the timeout would delay every frame by it.
            queue.timed_out = (self.next_frame - number) * self._interval_s > self._timeout_s
            return False
        if number > self.next_frame + LONGEST_GAP:
            queue.strays += [number] * count
            return False
        return True
