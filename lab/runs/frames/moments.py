"""When a recording is processed: the instants of its rows, and further ones for pictures between them.

Every picture belongs to the row whose instant is nearest to its own. A picture for which there is no row (before the
first, after the last, or where the camera has a picture nearer to the row) belongs to a further moment, which has no
row in the tables. Within a moment the trackers use every picture at its own instant.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from geometry.arrays import Array, Ints

TOGETHER = 0.25  # of the shortest time between two pictures of a camera: pictures between rows that share a moment
_TIE = 1e-6  # of a step: a picture half way between two rows belongs to the earlier one, whatever the rounding


@dataclass(frozen=True, slots=True)
class TimedPicture:
    """One picture of a camera."""

    number: int
    t_s: float  # on the run's clock, at mid-exposure of its middle row


@dataclass(frozen=True, slots=True)
class Moment:
    """An instant that is processed, with the pictures that belong to it."""

    frame: int  # the row's number; of a further moment that of the row before it
    is_row: bool
    t_s: float
    pictures: Mapping[str, TimedPicture] = field(default_factory=dict)  # by camera


@dataclass(slots=True)
class MomentPlanner:
    """Makes the moments row after row, by time, from the pictures nearest to each row."""

    step_s: float  # of the usual times between two pictures of each camera the shortest
    _others: list[tuple[float, str, int]] = field(default_factory=list)  # instant, camera, number: without a row
    _last: int | None = None  # the last row

    def row(self, row: int, t_s: float, pictures: Mapping[str, Sequence[TimedPicture]]) -> Iterator[Moment]:
        """The moments between the last row and this one, and the row's own. pictures: by camera, by time."""
        of_row = {name: min(given, key=lambda p: abs(p.t_s - t_s)) for name, given in pictures.items() if given}
        self.without_row({name: [p for p in given if p is not of_row[name]] for name, given in pictures.items()})
        later = [one for one in self._others if one[0] >= t_s]
        self._others = [one for one in self._others if one[0] < t_s]
        yield from self._between_rows(row)
        yield Moment(row, True, t_s, of_row)
        self._others, self._last = later, row

    def without_row(self, pictures: Mapping[str, Sequence[TimedPicture]]) -> None:
        """Add pictures for which there is no row."""
        self._others += [(p.t_s, name, p.number) for name, given in pictures.items() for p in given]

    def rest(self) -> Iterator[Moment]:
        """The moments after the last row."""
        yield from self._between_rows(0)
        self._others = []

    def _between_rows(self, following: int) -> Iterator[Moment]:
        """Moments for the pictures without a row; those close together share one."""
        frame = following if self._last is None else self._last
        moment: Moment | None = None
        for t_s, name, number in sorted(self._others):
            picture = {name: TimedPicture(number, t_s)}
            if moment is not None and t_s - moment.t_s <= TOGETHER * self.step_s and name not in moment.pictures:
                moment = replace(moment, pictures={**moment.pictures, **picture})
                continue
            if moment is not None:
                yield moment
            moment = Moment(frame, False, t_s, picture)
        if moment is not None:
            yield moment


def plan_moments(rows: Ints, rows_s: Array, cameras: Mapping[str, tuple[Ints, Array]]) -> Iterator[Moment]:
    """The moments of a recording, by time.

    rows (r,): frame numbers of the tables; rows_s (r,): their instants, increasing. cameras: numbers (m,) of each
    camera's pictures and their instants (m,), increasing.
    """
    steps = np.diff(rows_s)
    first, last = (0.5 * steps[0], 0.5 * steps[-1]) if len(steps) else (np.inf, np.inf)
    limits = [rows_s[:1] - first * (1 - _TIE), rows_s[:-1] + (0.5 + _TIE) * steps, rows_s[-1:] + last * (1 + _TIE)]
    at = np.concatenate(limits)
    timed, ends = {}, {}
    for name, (numbers, instants) in cameras.items():
        timed[name] = [TimedPicture(n, t_s) for n, t_s in zip(numbers.tolist(), instants.tolist(), strict=True)]
        ends[name] = [np.searchsorted(instants, at[0]), *np.searchsorted(instants, at[1:], side="right"), len(instants)]
    usual = (float(np.median(np.diff(t))) for _, t in cameras.values() if len(t) > 1)
    planner = MomentPlanner(min(usual, default=0.0))
    planner.without_row({name: given[: ends[name][0]] for name, given in timed.items()})
    for j, (row, t_s) in enumerate(zip(rows.tolist(), rows_s.tolist(), strict=True)):
        yield from planner.row(row, t_s, {name: given[slice(*ends[name][j : j + 2])] for name, given in timed.items()})
    planner.without_row({name: given[ends[name][-2] :] for name, given in timed.items()})
    yield from planner.rest()


def row_of(t_s: float, rate_hz: float) -> int:
    """The row of a constant rate that is nearest to an instant."""
    return int(np.ceil(t_s * rate_hz - 0.5 - _TIE))
