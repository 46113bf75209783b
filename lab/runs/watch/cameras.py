"""Cameras that are read while they record, each in its own thread: a folder that is being filled, or a device."""

from __future__ import annotations

import os
import re
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from numpy.typing import NDArray

from lab.errors import InputError
from lab.pictures.live_source import LiveSource, open_live
from lab.pictures.picture_file import UNREADABLE, MissingPicture, read_picture
from lab.pictures.source import number_of
from lab.runs.watch.inbox import Inbox, TimesFollower

# Frame numbers for the pictures of a device without any: counted, and checked against the clock.

_RESTART = 30_000  # missing pictures by a camera's own count from which the count has started again (16 bits overflow)
_CONFIRMING = 12  # consecutive late pictures that confirm a loss: a burst after a pause is late only at its start


@dataclass(slots=True)
class FrameClock:
    """Counts pictures, and detects lost ones: the last dozen are then all late by a frame interval or more.

    The number times the frame interval stays the time since the first picture. The numbers of the dozen pictures after
    a gap are too small by the gap, since it cannot be detected earlier. Ours.
    """

    rate_hz: float
    lost: int = 0  # numbers without a picture
    _next: int = 0
    _start_s: float = 0.0
    _late: deque[float] = field(default_factory=lambda: deque(maxlen=_CONFIRMING))
    _counted: int | None = None  # the camera's own count of the last picture

    def count(self) -> int:
        """The number of the next picture of a source that loses none."""
        self._next += 1
        return self._next - 1

    def number(self, now_s: float, counted: int | None = None) -> int:
        """The number of a picture that arrived at this time, s, of any steady clock. counted: by the camera itself."""
        if counted is not None:
            missing = 0 if self._counted is None else counted - self._counted - 1
            self._counted = counted
            return self.skipping(missing if 0 < missing < _RESTART else 0)
        if self._next == 0:
            self._start_s = now_s
        self._late.append((now_s - self._start_s) * self.rate_hz - self._next)
        if min(self._late) < 0:  # the first picture was itself late: the clock starts earlier
            self._start_s += min(self._late) / self.rate_hz
            self._late.clear()
        elif len(self._late) == _CONFIRMING and min(self._late) >= 1:
            lost = int(min(self._late))
            self._late.clear()
            return self.skipping(lost)
        return self.count()

    def skipping(self, missing: int) -> int:
        """The number of a picture before which so many were lost."""
        self.lost += missing
        self._next += missing
        return self.count()


# Finds new pictures in a folder that is being filled, at a cost that does not grow with the folder.


_AHEAD = 3  # number of names that are tried beyond the latest picture
_BEHIND = 8  # number of missing names before it that are tried: another thread of the recorder may still write them
_QUIET_S = 0.05  # time without a picture by its expected name after which the folder is listed
_COARSE_S = 0.1  # a folder's modification time may be too early by this
_LISTING_S = 1.0  # longest time between listings: some network drives report changes seconds late
_PAUSE = 10.0  # pause after a listing, in durations of that listing
_LAST_DIGITS = re.compile(r"^(.*?)([0-9]+)([^0-9]*)$", flags=re.DOTALL)


@dataclass(slots=True)
class FolderPoll:
    """Finds each picture of a folder once.

    Recorders count: the name after img_000041.png is img_000042.png, and a test for one name costs the same in a folder
    of any size. The folder is listed only when the expected names do not appear.
    """

    folder: Path
    names: dict[int, str] = field(default_factory=dict)  # all found so far, by number
    duplicates: list[tuple[str, str]] = field(default_factory=list)  # names with one number: the used one, the other
    _known: set[str] = field(default_factory=set)
    _pattern: tuple[str, int, str] | None = None  # text before the number, count of its digits, text after it
    _latest: int = -1
    _found_s: float = -1e9  # when an expected name was last found
    _listed_s: float = -1e9
    _next_listing_s: float = -1e9
    _changed_ns: int = -1  # the folder's modification time at the last listing

    def new(self) -> list[tuple[int, str]]:
        """Numbers and names of the pictures that are new since the last call, by number.

        Raises OSError: the folder cannot be read.
        """
        now = time.perf_counter()
        found = self._expected()
        if found:
            self._found_s = now
        elif now - self._found_s > _QUIET_S and now >= self._next_listing_s and self._may_have_changed(now):
            found = self._list()
        return sorted(found)

    def _expected(self) -> list[tuple[int, str]]:
        if self._pattern is None:
            return []
        head, digits, tail = self._pattern
        folder = f"{self.folder}{os.sep}"  # Path objects would cost as much as the tests
        behind = [n for n in range(max(self._latest - _BEHIND, 0), self._latest) if n not in self.names]
        out: list[tuple[int, str]] = []
        tried = [*behind, *range(self._latest + 1, self._latest + 1 + _AHEAD)]
        while tried:
            number = tried.pop(0)
            name = f"{head}{number:0{digits}d}{tail}"
            if name in self._known or not os.path.isfile(f"{folder}{name}"):
                continue
            self._add(number, name, out)
            if not tried:
                tried = list(range(number + 1, number + 1 + _AHEAD))
        return out

    def _may_have_changed(self, now: float) -> bool:
        changed_ns = os.stat(self.folder).st_mtime_ns
        return (
            changed_ns != self._changed_ns
            or time.time() - changed_ns / 1e9 < _COARSE_S
            or now - self._listed_s > _LISTING_S
        )

    def _list(self) -> list[tuple[int, str]]:
        begun = time.perf_counter()
        self._changed_ns = os.stat(self.folder).st_mtime_ns
        out: list[tuple[int, str]] = []
        with os.scandir(self.folder) as entries:
            names = sorted(e.name for e in entries if e.name not in self._known and e.is_file())
        for name in names:
            number = number_of(name)
            if number is None:
                self._known.add(name)
            else:
                self._add(number, name, out)
        self._listed_s = time.perf_counter()
        self._next_listing_s = self._listed_s + _PAUSE * (self._listed_s - begun)
        return out

    def _add(self, number: int, name: str, out: list[tuple[int, str]]) -> None:
        self._known.add(name)
        if number in self.names:
            self.duplicates.append((self.names[number], name))
            return
        self.names[number] = name
        out.append((number, name))
        if number > self._latest:
            self._latest = number
            match = _LAST_DIGITS.match(os.path.splitext(name)[0])
            assert match is not None  # number_of has found digits
            self._pattern = (match[1], len(match[2]), match[3] + os.path.splitext(name)[1])


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
