"""Times of the frames: a constant rate, or a table of timestamps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geometry.arrays import Array, Ints
from lab.errors import InputError
from lab.files.text import columns
from lab.files.text.csv_table import Table
from lab.files.text.csv_text import read_table

UNIT_FACTOR = 50.0  # between the steps of the timestamps and of the frame rate, from which one of them is a mistake


@dataclass(frozen=True, slots=True)
class Times:
    """Time of each frame: seconds since frame 0, at mid-exposure."""

    frame_rate_hz: float
    frames: Ints | None = None  # (n,) increasing: the frames with a timestamp; None: a constant rate
    times_s: Array | None = None  # (n,) increasing

    def t_s(self, frames: int | Ints) -> Array:
        """Times (...), s, of frame numbers (...).

        The time of a frame without a timestamp (a dropped frame) is interpolated linearly between its neighbours;
        before the first and after the last timestamp the nominal frame rate is used.
        """
        numbers = np.asarray(frames, dtype=float)
        if self.frames is None or self.times_s is None:
            return numbers / self.frame_rate_hz
        inside = np.interp(numbers, self.frames, self.times_s)
        beyond = numbers - np.clip(numbers, self.frames[0], self.frames[-1])
        return inside + beyond / self.frame_rate_hz

    def without_time(self, frames: Ints) -> Ints:
        """The frame numbers, of (n,) given, without a timestamp; none where the rate is constant."""
        if self.frames is None:
            return np.zeros(0, dtype=np.int64)
        return np.setdiff1d(np.asarray(frames, dtype=np.int64), self.frames)


def load_times(path: Path, frame_rate_hz: float) -> Times:
    """The timestamps file of a run. Raises InputError in one line."""
    table = read_table(path, columns.TIMES)
    table.refuse_long_lines()
    if not len(table):
        raise InputError(f"{path}: expected a row per frame, got none")
    frames = table.whole("frame")
    times_s = table.finite("t_s", "seconds")
    for i in np.flatnonzero(np.diff(frames) <= 0)[:1] + 1:
        raise table.error(i, f"frame: expected increasing numbers, got {frames[i]} after {frames[i - 1]}")
    for i in np.flatnonzero(np.diff(times_s) <= 0)[:1] + 1:
        raise table.error(
            i,
            f"t_s: expected increasing times, got {times_s[i]:g} s of frame {frames[i]} after {times_s[i - 1]:g} s of"
            f" frame {frames[i - 1]}",
        )
    _check_unit(table, frames, times_s, frame_rate_hz)
    return Times(frame_rate_hz, frames, times_s)


def _check_unit(table: Table, frames: Ints, times_s: Array, frame_rate_hz: float) -> None:
    """Raises InputError where the usual step is far from that of the frame rate: milliseconds, or a wrong rate."""
    if len(frames) < 2:
        return
    step_s = float(np.median(np.diff(times_s) / np.diff(frames)))
    if not 1 / UNIT_FACTOR < step_s * frame_rate_hz < UNIT_FACTOR:
        raise table.error(
            1,
            f"t_s: expected steps of about {1 / frame_rate_hz:.3g} s (frame_rate_hz: {frame_rate_hz:g}), got"
            f" {step_s:.3g} s for each frame; give seconds, not milliseconds, or correct frame_rate_hz in run.yaml",
        )
