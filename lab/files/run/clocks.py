"""Times of the frames: a constant rate or timestamps; clocks of single cameras, and rolling shutters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geometry.arrays import NORMAL_MEDIAN, Array, Ints
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import ROW_TIME, TIME_OFFSET, RigCovariance
from lab.errors import InputError
from lab.files.text import columns
from lab.files.text.csv_text import Table, read_table

UNIT_FACTOR = 50.0  # between the steps of the timestamps and of the frame rate, from which one of them is a mistake


@dataclass(slots=True)
class Times:
    """Time of each frame: seconds since frame 0, at mid-exposure. Of a run that is watched they come at its end."""

    frame_rate_hz: float
    frames: Ints | None = None  # (n,) increasing: the frames with a timestamp; None: a constant rate
    times_s: Array | None = None  # (n,) increasing
    sigma_s: Array | None = None  # (n,) of these, where the stamps of a free-running camera scatter; None: exact

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

    @property
    def usual_step_s(self) -> float:
        """The usual time from one frame to the next; that of the frame rate where no two frames have a timestamp."""
        if self.frames is None or self.times_s is None or len(self.frames) < 2:
            return 1 / self.frame_rate_hz
        return float(np.median(np.diff(self.times_s) / np.diff(self.frames)))

    @property
    def scatter(self) -> str | None:
        """What is unknown of the times of a free-running camera, in words; None: nothing."""
        if self.sigma_s is None or self.frames is None:
            return None
        usual_s, largest = float(np.median(self.sigma_s)), int(np.argmax(self.sigma_s))
        number, largest_s = self.frames[largest], float(self.sigma_s[largest])
        if largest_s > STAMP_OUTLIER * usual_s:
            return f"t_s of frame {number} is {1e3 * largest_s:.3g} ms from where the other times put it"
        return f"the times scatter by {1e3 * usual_s:.2g} ms about a constant rate"

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
    frames, times_s = table.rising("frame"), table.finite("t_s", "seconds")
    for i in np.flatnonzero(np.diff(times_s) <= 0)[:1] + 1:
        raise table.error(
            i,
            f"t_s: expected increasing times, got {times_s[i]:g} s of frame {frames[i]} after {times_s[i - 1]:g} s of"
            f" frame {frames[i - 1]}",
        )
    times = Times(frame_rate_hz, frames, times_s)
    _check_unit(table, times)
    return times


def _check_unit(table: Table, times: Times) -> None:
    """Raises InputError where the usual step is far from that of the frame rate: milliseconds, or a wrong rate."""
    rate_hz, step_s = times.frame_rate_hz, times.usual_step_s
    if not 1 / UNIT_FACTOR < step_s * rate_hz < UNIT_FACTOR:
        raise table.error(
            1,
            f"t_s: expected steps of about {1 / rate_hz:.3g} s (frame_rate_hz: {rate_hz:g}), got {step_s:.3g} s for"
            " each frame; give seconds, not milliseconds, or correct frame_rate_hz in run.yaml",
        )


FEWEST_STAMPS = 12  # that show whether they are those of a constant rate
LARGEST_SCATTER, NEGLIGIBLE_SCATTER = 0.15, 1e-3  # of the usual step: pictures at any time; stamps without errors
STAMP_OUTLIER = 5.0  # sigmas of the scatter


def stamp_sigmas(times: Times) -> Array | None:
    """Sigmas (n,), s, of the stamps of a camera of constant rate; None: they are exact, or its rate is not constant.

    A stamp that is not where the others put it may be an error of the stamp or a picture at that time. Its sigma is its
    distance from a line over the pictures, at least the scatter of all stamps. The line may change its slope slowly: it
    is fitted to parts of the recording, as long as their stamps scatter evenly about it.
    """
    if times.times_s is None or len(times.times_s) < FEWEST_STAMPS:
        return None
    # Dropped pictures may have numbers or not.
    index = np.cumsum(np.round(np.diff(times.times_s, prepend=times.times_s[0]) / times.usual_step_s))
    away, step_s = _from_line(index, times.times_s), times.usual_step_s
    scatter_s = _scatter(away)
    sigma_s = np.where(np.abs(away) > max(STAMP_OUTLIER * scatter_s, NEGLIGIBLE_SCATTER * step_s), np.abs(away), 0.0)
    if scatter_s > LARGEST_SCATTER * step_s or np.mean(sigma_s > 0) > LARGEST_SCATTER:
        return None
    if scatter_s > NEGLIGIBLE_SCATTER * step_s:
        sigma_s = np.maximum(sigma_s, scatter_s)
    return sigma_s if sigma_s.any() else None


def _scatter(away: Array) -> float:
    """A robust sigma of distances (n,) from 0."""
    return float(np.median(np.abs(away))) / NORMAL_MEDIAN


def _from_line(index: Array, t_s: Array) -> Array:
    """Distances (n,), s, of stamps from lines over the pictures (n,), which most of the stamps determine."""
    near = np.ones(len(t_s), dtype=bool)
    away = t_s - t_s[0]
    for _ in range(3):
        slope, offset = np.polyfit(index[near] - index[0], t_s[near] - t_s[0], 1)
        away = t_s - t_s[0] - offset - slope * (index - index[0])
        scatter_s = _scatter(away)
        near = np.abs(away) <= STAMP_OUTLIER * scatter_s
    half = len(t_s) // 2
    if half >= FEWEST_STAMPS:
        # A change of the slope puts the ends on one side of the line and the middle on the other.
        means = [float(np.mean(part)) for part in np.array_split(away[near], 4)]
        if max(means) - min(means) > STAMP_OUTLIER * scatter_s / np.sqrt(np.count_nonzero(near) / 4):
            return np.concatenate([_from_line(index[:half], t_s[:half]), _from_line(index[half:], t_s[half:])])
    return away


LONGEST_READOUT = 1.05  # of the time between two pictures; above 1 for a rounded row time


ESTIMATE = "estimate"  # the word in run.yaml for a number that the run estimates
# Sigmas of the priors of such numbers, both around 0: of an offset in steps between two frames, of a row time as a
# share of the longest one, with which the rows fill the time between two pictures.
OFFSET_SIGMA_FRAMES, ROW_TIME_SIGMA = 1.0, 1.0
WIDE = 0.25  # of these: a larger sigma needs causal passes before the smoothing pass estimates the number


@dataclass(frozen=True, slots=True)
class CameraClock:
    """When a camera takes its pictures. Without times of its own, picture n belongs to frame n of the run."""

    offset_s: float = 0.0  # its mid-exposure minus the frame's instant, or added to its own times
    row_time_s: float = 0.0  # by which each row is exposed later than the one above
    times: Times | None = None  # of its own pictures
    times_path: Path | None = None
    # Sigmas of the priors of what is estimated, s; 0: the number is known.
    offset_prior_s: float = 0.0
    row_time_prior_s: float = 0.0
    # Sigmas of the two numbers as far as they are known, s.
    offset_sigma_s: float = 0.0
    row_time_sigma_s: float = 0.0

    def instants_s(self, run_times: Times, numbers: Ints) -> Array:
        """Times (m,), s, of pictures (m,) at mid-exposure of their middle rows, on the run's clock."""
        times = run_times if self.times is None else self.times
        return np.asarray(times.t_s(numbers) + self.offset_s)

    def stamp_sigma_s(self, number: int) -> float:
        """Of the time of one picture in the camera's own times."""
        if self.times is None or self.times.sigma_s is None or self.times.frames is None:
            return 0.0
        at = np.searchsorted(self.times.frames, number)
        return float(self.times.sigma_s[min(int(at), len(self.times.sigma_s) - 1)])

    def wide(self, rate_hz: float, height: int) -> bool:
        """Whether the sigma of a prior is wide. rate_hz: of the run; height: of the pictures, px."""
        step_s = 1 / rate_hz if self.times is None else self.times.usual_step_s
        priors = self.offset_prior_s / OFFSET_SIGMA_FRAMES, self.row_time_prior_s * height / ROW_TIME_SIGMA
        return max(priors) > WIDE * step_s


def clocks_in(
    rig: Rig, covariance: RigCovariance | None, own: Mapping[str, CameraClock], before: Rig | None = None
) -> dict[str, CameraClock]:
    """The clocks of a rig's cameras: what the rig states, added to a run's own; its sigmas are those of the priors.

    own: of the run, by camera, with what the rig `before` states.
    """
    known = {} if covariance is None else dict(zip(covariance.names, np.diagonal(covariance.matrix), strict=True))
    out = {}
    for name, camera in rig.cameras.items():
        clock, old = own.get(name, CameraClock()), None if before is None else before.cameras[name]
        sigmas = [float(np.sqrt(known.get(f"cameras.{name}.{number}", 0.0))) for number in (TIME_OFFSET, ROW_TIME)]
        priors = sigmas[0] or clock.offset_prior_s, sigmas[1] or clock.row_time_prior_s
        offset_s = clock.offset_s + camera.time_offset_s - (0.0 if old is None else old.time_offset_s)
        row_time_s = clock.row_time_s + camera.row_time_s - (0.0 if old is None else old.row_time_s)
        out[name] = CameraClock(offset_s, row_time_s, clock.times, clock.times_path, *priors, *priors)
    return {name: clock for name, clock in out.items() if clock != CameraClock()}


def picture_numbers(clock: CameraClock | None, run_times: Times, rows: Ints) -> Ints:
    """(m,): the number of the camera's picture of each row (m,) of the tables; -1 where it has none.

    Without times of its own it is the row's number, else the picture nearest to the row's instant, within half a row.
    """
    rows = np.asarray(rows, dtype=np.int64)
    if clock is None or clock.times is None or clock.times.frames is None:
        return rows
    numbers = clock.times.frames
    instants, rows_s = clock.instants_s(run_times, numbers), run_times.t_s(rows)
    after = np.clip(np.searchsorted(instants, rows_s), 1, max(len(instants) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(instants) - 1)
    nearest = np.where(rows_s - instants[before] <= instants[after] - rows_s, before, after)
    near = np.abs(instants[nearest] - rows_s) <= 0.5 * (run_times.t_s(rows + 1) - rows_s)
    return np.where(near, numbers[nearest], -1)


def load_clock(
    offset_s: float | str,
    row_time_s: float | str,
    timestamps: str | None,
    folder: Path,
    where: str,
    rate_hz: float,
    height: int,
    recording: bool = False,
) -> CameraClock | None:
    """The clock of a camera as run.yaml states it, ESTIMATE or seconds; None: that of the run.

    timestamps: the file's name, from the run folder. where: of the camera in run.yaml, for messages. rate_hz: of the
    run; height: of the pictures, px. recording: the file is still being written. Raises InputError.
    """
    times: Times | None = None
    path: Path | None = None
    offset_prior_s = OFFSET_SIGMA_FRAMES / rate_hz if isinstance(offset_s, str) else 0.0
    if timestamps is not None:
        path = folder / timestamps
        if not recording and not path.is_file():
            raise InputError(f"{where}.timestamps: expected a table frame,t_s, found none at {path}")
        times = Times(rate_hz) if recording else load_times(path, rate_hz)
        times.sigma_s = stamp_sigmas(times)
        rate_hz = 1 / times.usual_step_s
    row_time_prior_s = ROW_TIME_SIGMA / rate_hz / height if isinstance(row_time_s, str) else 0.0
    offset_s = 0.0 if isinstance(offset_s, str) else offset_s
    row_time_s = 0.0 if isinstance(row_time_s, str) else row_time_s
    readout_s = abs(row_time_s) * height
    if readout_s * rate_hz > LONGEST_READOUT:
        raise InputError(
            f"{where}.row_time_s: expected {height} rows within the {1 / rate_hz:.6g} s between two pictures, got"
            f" {readout_s:.6g} s; give seconds for one row, not microseconds and not for the whole picture"
        )
    priors = offset_prior_s, row_time_prior_s
    if offset_s == 0.0 and row_time_s == 0.0 and times is None and not any(priors):
        return None
    return CameraClock(offset_s, row_time_s, times, path, *priors, *priors)
