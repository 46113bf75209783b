"""When a recording is processed: the instants of its rows, and further ones for pictures between them.

Every picture belongs to the row whose instant is nearest to its own. A picture for which there is no row (before the
first, after the last, or where the camera has a picture nearer to the row) belongs to a further moment, which has no
row in the tables. Within a moment the trackers use every picture at its own instant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

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


def plan_moments(rows: Ints, rows_s: Array, cameras: Mapping[str, tuple[Ints, Array]]) -> list[Moment]:
    """The moments of a recording, by time.

    rows (r,): frame numbers of the tables; rows_s (r,): their instants, increasing. cameras: numbers (m,) of each
    camera's pictures and their instants (m,), increasing.
    """
    of_row: list[dict[str, TimedPicture]] = [{} for _ in rows]
    others: list[tuple[float, str, int]] = []
    for name, (numbers, instants) in cameras.items():
        row = _nearest_row(rows_s, instants)
        for j in np.unique(row[row >= 0]).tolist():
            here = np.flatnonzero(row == j)
            best = int(here[np.argmin(np.abs(instants[here] - rows_s[j]))])
            of_row[j][name] = TimedPicture(int(numbers[best]), float(instants[best]))
            row[here] = -1
            row[best] = j
        others += [(float(instants[i]), name, int(numbers[i])) for i in np.flatnonzero(row < 0)]
    moments = [
        Moment(int(number), True, float(t_s), pictures)
        for number, t_s, pictures in zip(rows, rows_s, of_row, strict=True)
    ]
    moments += _between_rows(sorted(others), rows, rows_s, _shortest_step(cameras))
    return sorted(moments, key=lambda m: m.t_s)


def _nearest_row(rows_s: Array, instants: Array) -> Ints:
    """(m,): index of the row nearest to each instant (m,); -1 where it is farther than half a step from all rows."""
    steps = np.diff(rows_s)
    middle = rows_s[:-1] + (0.5 + _TIE) * steps
    out = np.searchsorted(middle, instants)
    first, last = (0.5 * steps[0], 0.5 * steps[-1]) if len(steps) else (np.inf, np.inf)
    beyond = (instants < rows_s[0] - first * (1 - _TIE)) | (instants > rows_s[-1] + last * (1 + _TIE))
    return np.where(beyond, -1, out)


def _shortest_step(cameras: Mapping[str, tuple[Ints, Array]]) -> float:
    """Of the usual times between two pictures of each camera, s, the shortest."""
    return min((float(np.median(np.diff(t))) for _, t in cameras.values() if len(t) > 1), default=0.0)


def _between_rows(others: Sequence[tuple[float, str, int]], rows: Ints, rows_s: Array, step_s: float) -> list[Moment]:
    """Moments for pictures (instant, camera, number) without a row; those close together share one."""
    out: list[Moment] = []
    interval = -1
    for t_s, name, number in others:
        before = int(np.searchsorted(rows_s, t_s, side="right"))
        joins = bool(out) and before == interval and t_s - out[-1].t_s <= TOGETHER * step_s
        if joins and name not in out[-1].pictures:
            pictures = {**out[-1].pictures, name: TimedPicture(number, t_s)}
            out[-1] = Moment(out[-1].frame, False, out[-1].t_s, pictures)
            continue
        interval = before
        out.append(Moment(int(rows[max(before - 1, 0)]), False, t_s, {name: TimedPicture(number, t_s)}))
    return out
