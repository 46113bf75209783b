"""Frame numbers of devices without any, and new files of folders that are being written."""

from __future__ import annotations

import os
import re
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

from lab.pictures.source import number_of

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
