"""When each frame was taken."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geometry.arrays import Array, Ints
from lab.errors import InputError
from lab.files.text import columns
from lab.files.text.csv_text import numbers_in, read_table, whole_numbers


@dataclass(frozen=True, slots=True)
class Times:
    """Seconds since frame 0, at mid-exposure."""

    frame_rate_hz: float
    frames: Ints | None = None  # (n,) increasing: those with a time of their own; None: a constant rate
    times_s: Array | None = None  # (n,) increasing

    def t_s(self, frames: int | Ints) -> Array:
        """Times (...), s, of frame numbers (...).

        A frame without a timestamp of its own (a dropped one) lies evenly between its neighbours; before the first and
        after the last timestamp the nominal frame rate holds.
        """
        asked = np.asarray(frames, dtype=float)
        if self.frames is None or self.times_s is None:
            return asked / self.frame_rate_hz
        inside = np.interp(asked, self.frames, self.times_s)
        beyond = asked - np.clip(asked, self.frames[0], self.frames[-1])
        return inside + beyond / self.frame_rate_hz

    def without_time(self, frames: Ints) -> Ints:
        """Those of the frame numbers (n,) that have no timestamp of their own; none where the rate is constant."""
        if self.frames is None:
            return np.zeros(0, dtype=np.int64)
        return np.setdiff1d(np.asarray(frames, dtype=np.int64), self.frames)


def load_times(path: Path, frame_rate_hz: float) -> Times:
    """The timestamps file of a run. Raises InputError in one line."""
    table = read_table(path, columns.TIMES)
    if table.empty:
        raise InputError(f"{path}: expected a row per frame, got none")
    frames = whole_numbers(table, "frame", path)
    times_s = numbers_in(table, "t_s", path, "seconds")
    bad = np.flatnonzero(np.diff(frames) <= 0)
    if bad.size:
        raise InputError(
            f"{path}: line {bad[0] + 3}: frame: expected increasing numbers, got {frames[bad[0] + 1]}"
            f" after {frames[bad[0]]}"
        )
    bad = np.flatnonzero(np.diff(times_s) <= 0)
    if bad.size:
        raise InputError(
            f"{path}: line {bad[0] + 3}: t_s: expected increasing times, got {times_s[bad[0] + 1]:g} s of frame"
            f" {frames[bad[0] + 1]} after {times_s[bad[0]]:g} s of frame {frames[bad[0]]}"
        )
    return Times(frame_rate_hz, frames, times_s)
