"""Cameras that are read while they record, each in a thread of its own: a folder that is being filled, or a device."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lab.errors import InputError
from lab.pictures.opencv import quiet_cv2
from lab.pictures.picture_file import UNREADABLE, Missing, read_picture
from lab.runs.frames.frame_sources import retrieved
from lab.watch.folder_poll import FolderPoll
from lab.watch.frame_clock import FrameClock
from lab.watch.inbox import Inbox

POLL_S = 0.002  # between two looks into a folder ...
_POLL_IDLE_S = 0.01  # ... and where nothing has come for a while
_IDLE_S = 2.0
_AT_ONCE = 4  # pictures that are read between two looks
_FAILURES = 5  # of a device in a row: it has gone


class LiveCamera(Protocol):
    """Gives pictures to an inbox until it ends, or the inbox stops."""

    name: str
    inbox: Inbox

    def run(self) -> None:
        """Give pictures; for a thread of its own."""

    @property
    def notes(self) -> list[str]:
        """What a reader of the results should know; complete once `run` has ended."""


@dataclass(slots=True)
class _Pending:
    """A file that is there, but not yet read to its end."""

    path: Path
    not_there_s: float | None  # time.time() when it was not there or not complete; None: older than the watch
    tried: tuple[int, int] | None = None  # its size and time of change when it was read last
    tried_s: float = 0.0  # time.perf_counter() of that


@dataclass(slots=True)
class FolderCamera:
    """A folder that a recorder writes pictures into.

    A file that cannot be decoded is read again when it has changed, and taken for damaged when it has not changed for
    `patience_s`. (A recorder that reserves a file's full length before it writes the pixels must write under another
    name, or in another folder, and rename: nothing shows that such a file is not complete.)
    """

    name: str
    poll: FolderPoll
    size_px: tuple[int, int]
    inbox: Inbox
    patience_s: float
    _pending: dict[int, _Pending] = field(default_factory=dict)
    _looked_s: float | None = None  # time.time() of the last look; None: not yet
    _busy_s: float = field(default_factory=time.perf_counter)  # when something was last to be done
    _old: int = 0  # pictures that were there at the first look
    _failure: str = ""

    def run(self) -> None:
        """Look, read, wait, until the inbox stops."""
        while not self.inbox.stopping.is_set():
            self.inbox.catch_up(self.name)
            if not self.look():
                idle = time.perf_counter() - self._busy_s > _IDLE_S
                self.inbox.stopping.wait(_POLL_IDLE_S if idle else POLL_S)

    def look(self) -> bool:
        """Find new pictures and read some; whether there was anything to do."""
        now_s = time.time()
        try:
            for number, name in self.poll.new():
                self._pending[number] = _Pending(self.poll.folder / name, self._looked_s)
                self._old += self._looked_s is None
            self._failure = ""
        except OSError as error:  # a drive that is away for a moment
            self._failure = f"{self.poll.folder}: cannot be read: {error.strerror}"
        self._looked_s = now_s
        done = 0
        for number in sorted(self._pending):
            if done >= _AT_ONCE or not self.inbox.has_room(self.name):
                break
            done += self._read(number, self._pending[number])
        if done:
            self._busy_s = time.perf_counter()
        return done > 0

    @property
    def notes(self) -> list[str]:
        """Pictures that were there already, those of one number, and a folder that went away."""
        out = [f"{self.name}: {self._old} pictures were there before the watch began"] if self._old else []
        out += [f"{self.poll.folder}: two pictures of one frame: {a} was used, {b} not" for a, b in self.poll.twins[:5]]
        return out + ([self._failure] if self._failure else [])

    def _read(self, number: int, file: _Pending) -> bool:
        """Try to read a picture; whether it is dealt with."""
        begun_s = time.time()
        try:
            state = os.stat(file.path)
        except OSError as error:
            self._give(number, Missing(f"{UNREADABLE}: {error.strerror}"), None)
            return True
        stamp = (state.st_size, state.st_mtime_ns)
        waited_s = time.perf_counter() - file.tried_s
        if stamp == file.tried and waited_s < self.patience_s:
            return False
        content = read_picture(file.path, self.size_px)
        if isinstance(content, Missing) and content.reason.startswith(UNREADABLE) and stamp != file.tried:
            file.tried, file.tried_s = stamp, time.perf_counter()
            file.not_there_s = None if file.not_there_s is None else begun_s
            self.inbox.announce(self.name, number, content.reason)
            return False
        arrived_s = None
        if file.not_there_s is not None:
            # The file's own time is the best, within what was seen: a copy may keep the time of its original.
            arrived_s = min(max(state.st_mtime_ns / 1e9, file.not_there_s), time.time())
        self._give(number, content, arrived_s)
        return True

    def _give(self, number: int, content: NDArray | Missing, arrived_s: float | None) -> None:
        del self._pending[number]
        self.inbox.give(self.name, number, content, arrived_s)


class Capture(Protocol):
    """What is used of cv2.VideoCapture."""

    def grab(self) -> bool:
        """Wait for the next picture; False where none comes."""

    def retrieve(self) -> tuple[bool, NDArray | None]:
        """Decode the picture that was grabbed."""

    def release(self) -> None:
        """Close the device."""


@dataclass(slots=True)
class DeviceCamera:
    """A camera that OpenCV reads. Its pictures are counted from 0, with gaps where the clock shows that some are lost.

    endless: a device, which cannot wait; False: a file or a stream with an end, of which no picture is left out.
    """

    name: str
    capture: Capture
    size_px: tuple[int, int]
    inbox: Inbox
    clock: FrameClock
    endless: bool = True

    def run(self) -> None:
        """Give pictures until the device ends or the inbox stops."""
        failures = 0
        try:
            while not (self.inbox.wanted.wait(0.05) or self.inbox.stopping.is_set()):
                pass
            while not self.inbox.stopping.is_set():
                self.inbox.catch_up(self.name)
                if not self.endless and not self.inbox.has_room(self.name):
                    self.inbox.stopping.wait(POLL_S)
                    continue
                if not self.capture.grab():
                    failures += 1
                    if not self.endless or failures >= _FAILURES:
                        return
                    self.inbox.stopping.wait(0.02)
                    continue
                failures = 0
                arrived_s = time.time()
                number = self.clock.number(time.perf_counter()) if self.endless else self.clock.count()
                if not self.inbox.has_room(self.name):
                    self.inbox.refuse(self.name)
                    continue
                self.inbox.give(self.name, number, self._decoded(), arrived_s)
        finally:
            self.capture.release()

    @property
    def notes(self) -> list[str]:
        """How many numbers were left out."""
        lost = self.clock.left_out
        return [f"{self.name}: {lost} pictures lost by the device, as its clock shows"] if lost else []

    def _decoded(self) -> NDArray | Missing:
        picture = retrieved(self.capture, self.size_px)
        # The device may use its buffer again.
        return picture if isinstance(picture, Missing) else np.array(picture)


def open_device(name: str, device: int | str, size_px: tuple[int, int], inbox: Inbox, rate_hz: float) -> DeviceCamera:
    """A device, asked for grey pictures of this (width, height) at this rate. Raises InputError where none opens."""
    cv2 = quiet_cv2()
    capture = cv2.VideoCapture(device)
    if not capture.isOpened():
        raise InputError(
            f"cameras.{name}.device: expected a camera that OpenCV can open, got {device!r}, which it cannot (not"
            " there, in use, or without the right to read it?)"
        )
    endless = not capture.get(cv2.CAP_PROP_FRAME_COUNT) > 0
    if endless:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, size_px[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size_px[1])
        capture.set(cv2.CAP_PROP_FPS, rate_hz)
    capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    return DeviceCamera(name, capture, size_px, inbox, FrameClock(rate_hz), endless)


def in_thread(camera: LiveCamera, failed: Callable[[BaseException], None]) -> threading.Thread:
    """A thread that runs a camera; failed: called with what went wrong within it."""

    def work() -> None:
        try:
            camera.run()
            camera.inbox.finish(camera.name)
        except BaseException as error:
            failed(error)

    thread = threading.Thread(target=work, name=f"watch-{camera.name}", daemon=True)
    thread.start()
    return thread
