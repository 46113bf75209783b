"""When the pictures of a watched camera were taken, and to which rows of the tables they belong."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from lab.files.run.clocks import CameraClock, load_times
from lab.files.run.run_file import Run
from lab.runs.frames.moments import TimedPicture, row_of

_EARLY = 0.1  # of the usual time between two pictures: the next one may come earlier by this


@dataclass(slots=True)
class PictureTimes:
    """The pictures of a camera: picture n is that of row n + `ahead`, or belongs to the row nearest to its own time."""

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
