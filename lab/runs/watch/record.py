"""`beampose record`: pictures of cameras into a run folder, which is a valid run from the first picture on."""

from __future__ import annotations

import datetime
import os
import queue
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from lab.errors import BeamposeError, InputError
from lab.files.rig.rig_file import load_rig
from lab.files.run.run_file import save_run
from lab.files.text import columns
from lab.files.text.atomic_write import made_folder
from lab.files.text.error_text import suggest_name
from lab.findings.finding import Done
from lab.pictures.live_source import LiveSource, open_live
from lab.pictures.picture_file import GreyPicture, MissingPicture
from lab.pictures.png import encoded
from lab.runs.watch.cameras import FrameClock

_WAITING = 64  # pictures per camera in memory that are not written yet
_FAILURES = 5  # consecutive failures after which a camera counts as disconnected
_ALIGNING_S = 10.0  # in which the least delay of the pictures aligns a camera's clock with that of the computer
_STATUS_S = 1.0  # between two status lines


@dataclass(frozen=True, slots=True)
class RecordOptions:
    """How to record."""

    rig: Path | None = None  # copied into the run folder
    rate_hz: float | None = None  # pictures per second; None: 25, or what a replayed source has
    seconds: float | None = None  # None: until it is stopped, or until all cameras have ended
    triggered: bool = False  # one signal triggers all cameras: the same number is the same instant
    exposure_s: float | None = None
    image_size_px: tuple[int, int] | None = None  # requested from devices; None: that of the rig


@dataclass(slots=True)
class _Clock:
    """Times of one camera's pictures on the run's clock, from its own clock, or from their arrival.

    The camera's clock is aligned with that of the computer by the arrival of the first picture; `late_s` is by how much
    the first one was later than the least delayed of the first seconds. `drift` compares both clocks' rates.
    """

    start_s: float  # time.perf_counter() of the recording's start
    endless: bool
    own: bool = True  # whether the camera's own clock is used
    late_s: float = 0.0
    _first: tuple[float, float] | None = None  # own time and arrival of the first picture
    _last_s: float = -np.inf
    _delays: dict[int, float] = field(default_factory=dict)  # least delay in each second

    def t_s(self, own_s: float | None, arrived_s: float) -> float:
        """The time of a picture, s since the start of the recording."""
        if self._first is None:
            self.own = own_s is not None
            self._first = (own_s or 0.0, arrived_s if self.endless else self.start_s)
        own_0, arrived_0 = self._first
        since_s = own_s - own_0 if self.own and own_s is not None else arrived_s - arrived_0
        delay, second = arrived_s - arrived_0 - since_s, int(since_s)
        self._delays[second] = min(self._delays.get(second, np.inf), delay)
        if since_s < _ALIGNING_S:
            self.late_s = max(self.late_s, -delay)
        # A clock that stands still or goes back must not make two pictures of one instant.
        t_s = max(arrived_0 - self.start_s + since_s, self._last_s + 1e-6)
        self._last_s = t_s
        return t_s

    @property
    def drift(self) -> float:
        """Rate of the computer's clock over the camera's, minus 1; nan for less than ten seconds."""
        if not (self.own and self.endless and len(self._delays) > 10):
            return float("nan")
        return float(np.polyfit(list(self._delays), list(self._delays.values()), 1)[0])


@dataclass(slots=True)
class CameraRecorder:
    """Takes the pictures of one camera in a thread, and writes them in another one."""

    name: str
    source: LiveSource
    folder: Path  # of the run
    rate_hz: float
    size_px: tuple[int, int] | None
    start_s: float
    stop: threading.Event
    begun: Callable[[], None]  # called when its first picture is in the folder
    # Of cameras with a common trigger: the time of picture 0, from that of this camera's first picture.
    zero_s: Callable[[float], float] | None = None
    written: int = 0
    unwritten: int = 0  # dropped since writing could not keep up
    unusable: int = 0  # damaged, or of another size ...
    reason: str = ""  # ... and why the last one was
    failure: str = ""  # why it ended; empty: it was stopped, or its file ended
    numbers: FrameClock = field(init=False)
    clock: _Clock = field(init=False)
    _waiting: queue.Queue[tuple[int, float, GreyPicture] | None] = field(default_factory=lambda: queue.Queue(_WAITING))
    _times: TextIO | None = None
    _threads: list[threading.Thread] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.numbers = FrameClock(self.rate_hz)
        self.clock = _Clock(self.start_s, self.source.endless)

    @property
    def lost(self) -> int:
        """Pictures that the camera or the connection has lost, by its count or its clock."""
        return self.numbers.lost

    @property
    def times_name(self) -> str:
        """Of its table of times, in the run folder."""
        return f"times-{self.name}.csv"

    def start(self) -> None:
        """Start both threads."""
        for work in (self._take, self._write):
            self._threads.append(threading.Thread(target=work, name=f"record-{self.name}", daemon=True))
            self._threads[-1].start()

    @property
    def running(self) -> bool:
        """Whether pictures come or are waiting to be written."""
        return any(thread.is_alive() for thread in self._threads)

    def join(self, timeout_s: float) -> None:
        """Wait until everything that was taken is written."""
        end_s = time.perf_counter() + timeout_s
        for thread in self._threads:
            thread.join(max(end_s - time.perf_counter(), 0.0))

    def _take(self) -> None:
        failures, previous_s = 0, None
        try:
            while not self.stop.is_set():
                if not self.source.grab():
                    failures += 1
                    if not self.source.endless:
                        break
                    if failures >= _FAILURES:
                        self.failure = "no picture came any more (unplugged?)"
                        break
                    self.stop.wait(0.02)
                    continue
                failures, arrived_s = 0, time.perf_counter()
                own_s = self.source.clock_s()
                t_s = self.clock.t_s(own_s, arrived_s)
                number = self._number(t_s, previous_s)
                if number < 0:  # before the first picture of the camera that began the numbers
                    continue
                previous_s = t_s
                if self.source.endless and self._waiting.full():
                    self.unwritten += 1
                    continue
                picture = self.source.picture(self.size_px)
                if isinstance(picture, MissingPicture):
                    self.unusable, self.reason = self.unusable + 1, picture.reason
                    continue
                self._waiting.put((number, t_s, picture))
        except Exception as error:  # of a driver
            self.failure = f"{type(error).__name__}: {error}"
        finally:
            with suppress(Exception):
                self.source.release()
            self._waiting.put(None)

    def _number(self, t_s: float, previous_s: float | None) -> int:
        if not self.source.endless:
            return self.numbers.count()
        if self.zero_s is not None and previous_s is None:
            first = round((t_s - self.zero_s(t_s)) * self.rate_hz)
            self.numbers = FrameClock(self.rate_hz, 0, max(first, 0))
            if first < 0:
                return first
        counted = self.source.number()
        if counted is not None or not self.clock.own:
            return self.numbers.number(t_s, counted)
        return self.numbers.skipping(0 if previous_s is None else max(round((t_s - previous_s) * self.rate_hz) - 1, 0))

    def _write(self) -> None:
        folder = self.folder / "frames" / self.name
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with (self.folder / self.times_name).open("x", encoding="utf-8", newline="") as self._times:
                self._append(",".join(columns.TIMES))
                while (one := self._waiting.get()) is not None:
                    self._write_one(folder, *one)
        except OSError as error:
            self.failure = f"cannot be written: {error.strerror}"
            self.stop.set()  # the other cameras write to the same disk
            while self._waiting.get() is not None:
                self.unwritten += 1

    def _write_one(self, folder: Path, number: int, t_s: float, picture: GreyPicture) -> None:
        """Write a picture and its time: both or none. Raises OSError.

        The time is first: a recording that is killed in between has a time without its picture, which counts as
        dropped. A picture without its time would be an error of the run.
        """
        assert self._times is not None
        part, end = folder / f".{number:06d}.part", os.fstat(self._times.fileno()).st_size
        try:
            part.write_bytes(encoded(picture))
            self._append(f"{number},{t_s:.6f}")
            os.replace(part, folder / f"{number:06d}.png")
        except OSError:
            self.unwritten += 1
            with suppress(OSError, ValueError):
                os.truncate(self._times.fileno(), end)
            with suppress(OSError):
                part.unlink(missing_ok=True)
            raise
        self.written += 1
        if self.written == 1:
            self.begun()

    def _append(self, line: str) -> None:
        """Append a line to the table of times. Raises OSError."""
        assert self._times is not None
        self._times.write(f"{line}\n")
        self._times.flush()


def record(
    cameras: Mapping[str, int | str],
    out: Path,
    options: RecordOptions = RecordOptions(),
    *,
    stop: threading.Event | None = None,
    line: Callable[[str], None] | None = None,
) -> Done[Path]:
    """Record cameras into a new run folder: frames/CAMERA, times-CAMERA.csv and run.yaml, lossless.

    cameras: sources by name, as `open_live` takes them. stop: ends the recording when set. line: called with a line of
    status every second. run.yaml is written with the first picture of each camera, so that the folder is a valid run
    whenever the process ends. Exit status 1: a camera failed, or the disk is full; what was recorded is a run. Raises
    InputError: a camera cannot be opened, the folder has files in it, or no picture came.
    """
    stop, out = stop or threading.Event(), Path(out)
    if out.is_dir() and any(out.iterdir()):
        raise InputError(
            f"{out}: expected a new or empty folder for the recording, found files in it; name another one"
        )
    rig = None if options.rig is None else load_rig(options.rig)
    for name in cameras:
        if rig is not None and name not in rig.cameras:
            raise InputError(f"--camera: expected a camera of the rig, got {name!r}{suggest_name(name, rig.cameras)}")
    sizes = {n: options.image_size_px if rig is None else rig.cameras[n].image_size_px for n in cameras}
    rate_hz = options.rate_hz or 25.0
    sources: dict[str, LiveSource] = {}
    try:
        for name, source in cameras.items():
            try:
                sources[name] = open_live(source, sizes[name], options.rate_hz)
            except InputError as error:
                raise InputError(f"--camera {name}={source}: {error}") from None
        made_folder(out)
        if options.rig is not None:
            shutil.copyfile(options.rig, out / "rig.yaml")
    except BaseException:
        for opened in sources.values():
            opened.release()
        raise
    return _Recording(sources, sizes, out, options, rate_hz, stop).run(line)


@dataclass(slots=True)
class _Recording:
    sources: Mapping[str, LiveSource]
    sizes: Mapping[str, tuple[int, int] | None]
    out: Path
    options: RecordOptions
    rate_hz: float
    stop: threading.Event
    recorders: list[CameraRecorder] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _zero_s: float | None = None

    def run(self, line: Callable[[str], None] | None) -> Done[Path]:
        """Record until the end. Raises InputError where no picture came."""
        start_s, zero_s = time.perf_counter(), self._zero if self.options.triggered else None
        self.recorders = [
            CameraRecorder(n, s, self.out, self.rate_hz, self.sizes[n], start_s, self.stop, self._save, zero_s)
            for n, s in self.sources.items()
        ]
        try:
            for one in self.recorders:
                one.start()
            end_s, next_s = start_s + (self.options.seconds or np.inf), start_s + _STATUS_S
            while any(one.running for one in self.recorders) and not self.stop.is_set():
                now_s = time.perf_counter()
                if now_s >= end_s:
                    break
                if now_s >= next_s and line is not None:
                    line(f"{now_s - start_s:.0f} s: {self._counts()}")
                    next_s += _STATUS_S
                self.stop.wait(min(0.05, end_s - now_s))
        finally:  # also of a signal
            self.stop.set()
            for one in self.recorders:
                one.join(3.0)
        return self._concluded()

    def _zero(self, first_s: float) -> float:
        """The time of picture 0: that of the first picture of any camera."""
        with self._lock:
            self._zero_s = first_s if self._zero_s is None else self._zero_s
            return self._zero_s

    def _save(self, final: bool = False) -> None:
        """Write run.yaml with the cameras that have pictures."""
        with self._lock, suppress(BeamposeError, OSError):  # a full disk: the earlier one stays
            cameras: dict[str, Any] = {}
            latest_s = max(one.clock.late_s for one in self.recorders)
            for one in self.recorders:
                if not one.written:
                    continue
                cameras[one.name] = {"frames": f"frames/{one.name}"}
                if not self.options.triggered:
                    cameras[one.name]["timestamps"] = one.times_name
                    later_s = round(latest_s - one.clock.late_s, 6)
                    if final and one.source.endless and later_s > 0:  # never negative: no picture lies before frame 0
                        cameras[one.name]["time_offset_s"] = later_s
            more = {} if self.options.exposure_s is None else {"exposure_s": self.options.exposure_s}
            day = datetime.date.today().isoformat()
            content = {"name": self.out.resolve().name, "rig": "rig.yaml", "frame_rate_hz": self.rate_hz, **more}
            notes = f"Recorded by beampose. {self._counts()}."
            save_run({**content, "recorded": day, "cameras": cameras, "notes": notes}, self.out)

    def _counts(self) -> str:
        return "; ".join(
            f"{one.name} {one.written} pictures, {one.lost} lost, {one.unwritten} not written" for one in self.recorders
        )

    def _concluded(self) -> Done[Path]:
        if not any(one.written for one in self.recorders):
            why = "; ".join(f"{one.name}: {one.reason or one.failure or 'no picture came'}" for one in self.recorders)
            raise InputError(f"{self.out}: nothing was recorded: {why}")
        self._save(final=True)
        notes = []
        for one in self.recorders:
            if one.failure:
                notes.append(f"{one.name}: {one.failure}")
            if one.unusable:
                notes.append(f"{one.name}: {one.unusable} pictures were left out: {one.reason}")
            if not one.clock.own:
                notes.append(f"{one.name}: the camera states no times; those of arrival are used")
            if abs(one.clock.drift) > 1e-4:
                notes.append(f"{one.name}: its clock differs by {1e6 * one.clock.drift:.0f} ppm from the computer's")
        failed = any(one.failure for one in self.recorders)
        lines = [f"{self._counts()} -> {self.out}"]
        if self.options.rig is None:
            lines.append(f"Next: copy the rig.yaml of these cameras into {self.out}; beampose check {self.out}")
        return Done(self.out, tuple(lines), tuple(notes), exit_status=int(failed))
