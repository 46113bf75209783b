"""Cameras that are read while they record, each in its own thread: a folder that is being filled, or a device."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from numpy.typing import NDArray

from lab.errors import InputError
from lab.pictures.live_source import LiveSource, open_live
from lab.pictures.picture_file import UNREADABLE, MissingPicture, read_picture
from lab.runs.watch.frame_clock import FolderPoll, FrameClock
from lab.runs.watch.inbox import Inbox, TimesFollower

POLL_S = 0.002  # between two polls of a folder ...
_POLL_IDLE_S = 0.01  # ... and after _IDLE_S without a new picture
_IDLE_S = 2.0
_READS_PER_POLL = 4  # pictures that are read between two polls
_FAILURES = 5  # consecutive failures after which a device counts as disconnected


class LiveCamera(Protocol):
    """Puts pictures into an inbox until the camera ends or the inbox stops."""

    name: str
    inbox: Inbox

    def run(self) -> None:
        """Put pictures into the inbox; runs in its own thread."""

    @property
    def unread(self) -> int:
        """Pictures that have come and were not read yet."""

    @property
    def notes(self) -> list[str]:
        """Notes for the user of the results; complete once `run` has ended."""


@dataclass(slots=True)
class _Pending:
    """A file that exists, but has not been read completely."""

    path: Path
    incomplete_s: float | None  # latest time.time() when it was missing or incomplete; None: older than the watch
    tried: tuple[int, int] | None = None  # its size and modification time at the last attempt to read it
    tried_s: float = 0.0  # time.perf_counter() of that attempt


@dataclass(slots=True)
class FolderCamera:
    """A folder that a recorder writes pictures into.

    A file that cannot be decoded is read again when it has changed, and counts as damaged when it has not changed for
    `patience_s`. (A recorder that reserves a file's full length before it writes the pixels must write under another
    name, or in another folder, and rename: such a file cannot be recognised as incomplete.)
    """

    name: str
    poll: FolderPoll
    size_px: tuple[int, int]
    inbox: Inbox
    patience_s: float
    times: TimesFollower | None = None  # of a camera with times of its own
    _pending: dict[int, _Pending] = field(default_factory=dict)
    _polled_s: float | None = None  # time.time() of the last poll; None: none yet
    _busy_s: float = field(default_factory=time.perf_counter)  # when a picture was last read
    _old: int = 0  # pictures that existed at the first poll
    _failure: str = ""

    def run(self) -> None:
        """Poll, read and wait until the inbox stops."""
        while not self.inbox.stopping.is_set():
            self.inbox.catch_up(self.name)
            if not self.poll_once():
                idle = time.perf_counter() - self._busy_s > _IDLE_S
                self.inbox.stopping.wait(_POLL_IDLE_S if idle else POLL_S)

    def poll_once(self) -> bool:
        """Find new pictures and read some of them. Returns whether there were any."""
        now_s = time.time()
        if self.times is not None and (times := self.times.new()):
            self.inbox.add_times(self.name, times)
        try:
            for number, name in self.poll.new():
                self._pending[number] = _Pending(self.poll.folder / name, self._polled_s)
                self._old += self._polled_s is None
            self._failure = ""
        except OSError as error:  # a drive that is temporarily unavailable
            self._failure = f"{self.poll.folder}: cannot be read: {error.strerror}"
        self._polled_s = now_s
        done = 0
        for number in sorted(self._pending):
            if done >= _READS_PER_POLL or not self.inbox.has_room(self.name):
                break
            done += self._read(number, self._pending[number])
        if done:
            self._busy_s = time.perf_counter()
        return done > 0

    @property
    def unread(self) -> int:
        return len(self._pending)

    @property
    def notes(self) -> list[str]:
        """Notes on pictures older than the watch, pictures with equal numbers, and an unreadable folder."""
        out = [f"{self.name}: {self._old} pictures existed before the watch began"] if self._old else []
        out += [
            f"{self.poll.folder}: two pictures of one frame: {a} was used, {b} not" for a, b in self.poll.duplicates[:5]
        ]
        return out + ([self._failure] if self._failure else [])

    def _read(self, number: int, file: _Pending) -> bool:
        """Try to read a picture. Returns whether it was read or is damaged."""
        begun_s = time.time()
        try:
            state = os.stat(file.path)
        except OSError as error:
            self._put(number, MissingPicture(f"{UNREADABLE}: {error.strerror}"), None)
            return True
        stamp = (state.st_size, state.st_mtime_ns)
        waited_s = time.perf_counter() - file.tried_s
        if stamp == file.tried and waited_s < self.patience_s:
            return False
        content = read_picture(file.path, self.size_px)
        if isinstance(content, MissingPicture) and content.reason.startswith(UNREADABLE) and stamp != file.tried:
            file.tried, file.tried_s = stamp, time.perf_counter()
            file.incomplete_s = None if file.incomplete_s is None else begun_s
            self.inbox.announce(self.name, number, content.reason)
            return False
        arrived_s = None
        if file.incomplete_s is not None:
            # The modification time is the most precise one; it is clipped since a copy may keep that of its original.
            arrived_s = min(max(state.st_mtime_ns / 1e9, file.incomplete_s), time.time())
        self._put(number, content, arrived_s)
        return True

    def _put(self, number: int, content: NDArray | MissingPicture, arrived_s: float | None) -> None:
        del self._pending[number]
        self.inbox.put(self.name, number, content, arrived_s)


@dataclass(slots=True)
class DeviceCamera:
    """A camera that is read directly. Its pictures count from 0, with gaps where its count or a clock shows a loss."""

    name: str
    source: LiveSource
    size_px: tuple[int, int]
    inbox: Inbox
    clock: FrameClock

    def run(self) -> None:
        """Put pictures into the inbox until the device ends or the inbox stops."""
        failures = 0
        try:
            while not (self.inbox.wanted.wait(0.05) or self.inbox.stopping.is_set()):
                pass
            while not self.inbox.stopping.is_set():
                self.inbox.catch_up(self.name)
                if not self.source.endless and not self.inbox.has_room(self.name):
                    self.inbox.stopping.wait(POLL_S)
                    continue
                if not self.source.grab():
                    failures += 1
                    if not self.source.endless or failures >= _FAILURES:
                        return
                    self.inbox.stopping.wait(0.02)
                    continue
                failures = 0
                arrived_s = time.time()
                number = (
                    self.clock.number(time.perf_counter(), self.source.number())
                    if self.source.endless
                    else self.clock.count()
                )
                if not self.inbox.has_room(self.name):
                    self.inbox.count_refused(self.name)
                    continue
                self.inbox.put(self.name, number, self.source.picture(self.size_px), arrived_s)
        finally:
            self.source.release()

    @property
    def unread(self) -> int:
        return 0  # a device loses them

    @property
    def notes(self) -> list[str]:
        """A note on lost pictures."""
        lost = self.clock.lost
        return [f"{self.name}: {lost} pictures lost by the device, according to the clock"] if lost else []


def open_device(name: str, device: int | str, size_px: tuple[int, int], inbox: Inbox, rate_hz: float) -> DeviceCamera:
    """Open a device, and request grey pictures of this (width, height) at this rate.

    Raises InputError: the device cannot be opened.
    """
    try:
        source = open_live(device, size_px, rate_hz)
    except InputError as error:
        raise InputError(f"cameras.{name}.device: {error}") from None
    return DeviceCamera(name, source, size_px, inbox, FrameClock(rate_hz))


def in_thread(camera: LiveCamera, failed: Callable[[BaseException], None]) -> threading.Thread:
    """Start a thread that runs a camera. failed: called with an exception that is raised in it."""

    def work() -> None:
        try:
            camera.run()
            camera.inbox.finish(camera.name)
        except BaseException as error:
            failed(error)

    thread = threading.Thread(target=work, name=f"watch-{camera.name}", daemon=True)
    thread.start()
    return thread
