"""Which pictures have appeared in a folder that is being filled, at a cost that does not grow with the folder."""

from __future__ import annotations

import os
import re
import time
from dataclasses import dataclass, field
from pathlib import Path

from lab.runs.frames.frame_sources import number_of

_AHEAD = 3  # names that are tried beyond the latest
_BEHIND = 8  # ... and numbers below it, which another thread of the recorder may still write
_QUIET_S = 0.05  # so long without a picture by its expected name, before the folder is listed again
_COARSE_S = 0.1  # a folder's time of change may be so much too early
_SURELY_S = 1.0  # listed so often even if it seems unchanged: some network drives say so for seconds
_SHARE = 10.0  # a listing takes at most this part of the time
_LAST_DIGITS = re.compile(r"^(.*?)([0-9]+)([^0-9]*)$", flags=re.DOTALL)


@dataclass(slots=True)
class FolderPoll:
    """Finds each picture of a folder once.

    Recorders count: the name after img_000041.png is img_000042.png, and asking for one name costs the same in a folder
    of any size. The folder is listed only where the expected names do not come.
    """

    folder: Path
    names: dict[int, str] = field(default_factory=dict)  # all found so far, by number
    twins: list[tuple[str, str]] = field(default_factory=list)  # names of one number: the one in use, the other
    _known: set[str] = field(default_factory=set)
    _pattern: tuple[str, int, str] | None = None  # before the number, its digits, after it
    _latest: int = -1
    _found_s: float = -1e9  # when an expected name was there
    _listed_s: float = -1e9
    _next_listing_s: float = -1e9
    _changed_ns: int = -1  # the folder's time of change at the last listing

    def new(self) -> list[tuple[int, str]]:
        """Numbers and names of pictures that were not there at the last call, by number. Raises OSError."""
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
        folder = f"{self.folder}{os.sep}"  # joining paths costs as much as asking for them
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
            or now - self._listed_s > _SURELY_S
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
        self._next_listing_s = self._listed_s + _SHARE * (self._listed_s - begun)
        return out

    def _add(self, number: int, name: str, out: list[tuple[int, str]]) -> None:
        self._known.add(name)
        if number in self.names:
            self.twins.append((self.names[number], name))
            return
        self.names[number] = name
        out.append((number, name))
        if number > self._latest:
            self._latest = number
            match = _LAST_DIGITS.match(os.path.splitext(name)[0])
            assert match is not None  # number_of has found the digits
            self._pattern = (match[1], len(match[2]), match[3] + os.path.splitext(name)[1])
