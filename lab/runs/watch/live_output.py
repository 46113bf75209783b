"""Live output of a watched run: a row of attitude_live.csv per frame, streams of the poses, and their latency.

Streams go to other programs by UDP, ZeroMQ or LSL. None of them waits for a receiver: what cannot be sent is counted.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TextIO

import numpy as np

from lab.errors import InputError
from lab.files.text import columns
from lab.files.text.atomic_write import replacement_within
from lab.files.text.csv_text import csv_word
from lab.files.text.json_text import plain_value
from lab.packages import needed
from lab.runs.frames.pipeline import FrameRecord
from lab.runs.tables import attitude_rows, pose_numbers
from lab.runs.verdict.run_statistics import FrameChecks
from lab.runs.watch.live_frames import LiveFrames
from tracking.statuses import PoseStatus


class Stream(Protocol):
    """A place that receives every frame."""

    kind: str  # udp, zmq or lsl
    address: str  # as the user gave it
    failures: int  # frames that could not be sent

    def send(self, content: Mapping[str, Any]) -> None:
        """Send one frame (`frame_content`). A failure is counted and raises no error."""

    def close(self) -> None:
        """Release what the stream uses."""


@contextmanager
def opened(udp: str | None, addresses: Sequence[str], rate_hz: float) -> Iterator[tuple[Stream, ...]]:
    """The streams of `--udp HOST:PORT` and `--stream KIND:ADDRESS`, during the block.

    rate_hz: of the frames, nominal. Raises InputError where an address is invalid, or its package is not installed.
    """
    with contextlib.ExitStack() as stack:
        out: list[Stream] = []
        for option, kind, address in _places(udp, addresses):
            stream = _KINDS[kind](option, address, rate_hz)
            stack.callback(stream.close)
            out.append(stream)
        yield tuple(out)


def _places(udp: str | None, addresses: Sequence[str]) -> Iterator[tuple[str, str, str]]:
    """Option (for messages), kind and address of each stream."""
    if udp is not None:
        yield "--udp", "udp", udp
    for text in addresses:
        kind, colon, address = text.partition(":")
        if kind not in _KINDS or not colon or not address:
            raise InputError(
                f"--stream: expected udp:HOST:PORT, zmq:HOST:PORT or lsl:NAME, such as zmq:127.0.0.1:5556, got {text!r}"
            )
        yield f"--stream {kind}", kind, address


def _host_and_port(option: str, address: str) -> tuple[str, int]:
    host, colon, port = address.rpartition(":")
    if not (colon and host and port.isascii() and port.isdigit() and 0 < int(port) < 65536):
        raise InputError(f"{option}: expected HOST:PORT, such as 127.0.0.1:5005, got {address!r}")
    return host, int(port)


def json_line(content: Mapping[str, Any]) -> bytes:
    """One frame as a line of JSON; unknown values are null."""
    return (json.dumps(plain_value(content), allow_nan=False) + "\n").encode()


class UdpLines:
    """Sends a line of JSON to one address, whether or not there is a listener."""

    kind = "udp"

    def __init__(self, option: str, address: str, rate_hz: float) -> None:
        """Raises InputError if the address is invalid."""
        self.address, self.failures = address, 0
        host, port = _host_and_port(option, address)
        try:
            found = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_DGRAM)
        except OSError as error:
            raise InputError(f"{option}: the host {host!r} is unknown: {error.strerror}") from None
        self._to: Any
        family, kind, protocol, _, self._to = found[0]
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)

    def send(self, content: Mapping[str, Any]) -> None:
        """See `Stream`."""
        try:
            self._socket.sendto(json_line(content), self._to)
        except OSError:
            self.failures += 1

    def close(self) -> None:
        """See `Stream`."""
        self._socket.close()


class ZmqLines:
    """Publishes a line of JSON per frame (PUB): subscribers that are slow or absent lose frames."""

    kind = "zmq"

    def __init__(self, option: str, address: str, rate_hz: float) -> None:
        """Raises InputError where nothing can be published there, or pyzmq is not installed."""
        self.address, self.failures = address, 0
        host, port = _host_and_port(option, address)
        self._zmq = needed("zmq", option)
        self._context = self._zmq.Context()
        self._socket = self._context.socket(self._zmq.PUB)
        self._socket.setsockopt(self._zmq.LINGER, 0)
        try:
            self._socket.bind(f"tcp://{host}:{port}")
        except self._zmq.ZMQError as error:
            self.close()
            raise InputError(
                f"{option}: expected an address of this computer (0.0.0.0: all) and a free port, got {address}: {error}"
            ) from None

    def send(self, content: Mapping[str, Any]) -> None:
        """See `Stream`."""
        try:
            self._socket.send(json_line(content), self._zmq.NOBLOCK)
        except self._zmq.ZMQError:
            self.failures += 1

    def close(self) -> None:
        """See `Stream`."""
        self._socket.close()
        self._context.term()


# Channels of an LSL stream: key of the frame's content, labels of its numbers, unit.
_CHANNELS = (
    ("frame", ("frame",), ""),
    ("t_s", ("t_s",), "seconds"),
    ("position_m", ("x", "y", "z"), "meters"),
    ("quaternion_wxyz", ("qw", "qx", "qy", "qz"), ""),
    ("yaw_pitch_roll_deg", ("yaw", "pitch", "roll"), "degrees"),
    ("sigma_position_m", ("sigma_x", "sigma_y", "sigma_z"), "meters"),
    ("sigma_yaw_pitch_roll_deg", ("sigma_yaw", "sigma_pitch", "sigma_roll"), "degrees"),
    ("status", ("status",), ", ".join(f"{i} {word.value}" for i, word in enumerate(PoseStatus))),
)


class LslSamples:
    """An LSL outlet with a sample of float64 per frame: nan where nothing is known.

    The time stamp of a sample is that of the arrival of its last picture.
    """

    kind = "lsl"

    def __init__(self, option: str, address: str, rate_hz: float) -> None:
        """address: the name of the stream. Raises InputError where pylsl is not installed."""
        self.address, self.failures = address, 0
        self._lsl = needed("lsl", option)
        count = sum(len(labels) for _, labels, _ in _CHANNELS)
        info = self._lsl.StreamInfo(address, "MoCap", count, rate_hz, "double64", f"beampose-{address}")
        info.desc().append_child_value("pose", "world_from_body: x_world = R x_body + t; the quaternion is of R")
        listed = info.desc().append_child("channels")
        for _, labels, unit in _CHANNELS:
            for label in labels:
                channel = listed.append_child("channel")
                channel.append_child_value("label", label)
                channel.append_child_value("unit", unit)
        self._outlet = self._lsl.StreamOutlet(info)

    def send(self, content: Mapping[str, Any]) -> None:
        """See `Stream`."""
        sample: list[float] = []
        for key, labels, _ in _CHANNELS:
            value = content[key]
            if key == "status":
                value = list(PoseStatus).index(value)
            values = value if isinstance(value, list) else [value] * len(labels)
            sample += [float("nan") if v is None else float(v) for v in values]
        try:
            self._outlet.push_sample(sample, self._lsl.local_clock() - (content["latency_ms"] or 0.0) / 1e3)
        except (RuntimeError, OSError):
            self.failures += 1

    def close(self) -> None:
        """See `Stream`."""
        del self._outlet


_KINDS: Mapping[str, type[UdpLines | ZmqLines | LslSamples]] = {"udp": UdpLines, "zmq": ZmqLines, "lsl": LslSamples}


if TYPE_CHECKING:
    from lab.runs.watch.board import Board

LIVE_TABLE = "attitude_live.csv"
_LINE_S = 1.0  # between two lines of status
_LATE_MS = 1000.0  # latency of the last pose above which the watch has not kept up


@dataclass(slots=True)
class Latency:
    """Latencies from the arrival of a frame's last picture until its pose is written, ms."""

    steady: list[float] = field(default_factory=list)  # after the backlog of the start has been processed
    start: list[float] = field(default_factory=list)  # before that

    def as_mapping(self) -> dict[str, Any]:
        """For summary.json."""
        out: dict[str, Any] = {"frames": len(self.steady), "start_frames": len(self.start)}
        if self.steady:
            values = np.array(self.steady)
            out |= dict(zip(("median", "p95", "p99"), np.percentile(values, [50, 95, 99]).tolist(), strict=True))
            out["largest"] = float(values.max())
        if self.start:
            out["largest_at_start"] = max(self.start)
        if self.steady or self.start:
            out["last"] = (self.steady or self.start)[-1]
        return out

    def lines(self) -> tuple[str, ...]:
        """For the terminal; empty without a frame."""
        known, out = self.as_mapping(), []
        if self.steady:
            out.append(
                f"latency: median {known['median']:.1f} ms, 95 % within {known['p95']:.1f} ms, 99 % within"
                f" {known['p99']:.1f} ms, largest {known['largest']:.1f} ms ({known['frames']} frames)"
            )
        if known.get("last", 0.0) > _LATE_MS:
            out.append(
                "the pictures came faster than they were processed: the last pose was written"
                f" {known['last'] / 1e3:.1f} s after its pictures. Pictures in folders wait and are all used, so the"
                " poses come ever later; record at a lower rate, or use `beampose run` on the finished folder"
            )
        return tuple(out)


@dataclass(slots=True)
class LiveOutput:
    """Writes each frame's pose at once into the future result folder.

    The folder contains only the live table until the results replace it. Every pose passes the same checks as in a
    finished run: the rows are those that `beampose run --causal` writes.
    """

    out: Path
    frames: LiveFrames
    checks: FrameChecks
    streams: Sequence[Stream] = ()
    board: Board | None = None
    line: Callable[[str], None] | None = None  # called with a line of status every second
    latency: Latency = field(default_factory=Latency)
    _file: TextIO | None = None
    _pictures: dict[str, list[int]] = field(default_factory=dict)  # used since the last row, of cameras with clocks
    _counts: tuple[int, int] = (0, 0)  # frames, and measured ones
    _recent_ms: list[float] = field(default_factory=list)  # latencies since the last line
    _begun_s: float | None = None
    _said_s: float = 0.0  # when the last line was shown

    def write(self, record: FrameRecord) -> None:
        """Write and send one frame; of one without a row, only keep which pictures it has used."""
        pictures = None
        if record.moment is not None:
            for name, found in zip(self.checks.rig.cameras, record.detections, strict=True):
                if found is not None:
                    self._pictures.setdefault(name, []).append(record.moment.pictures[name].number)
            if not record.moment.is_row:
                return
            pictures, self._pictures = self._pictures, {}
        ((checked, _),) = self.checks.passed([(record, None)])
        if self._file is None:
            self._file = self._opened(pictures is not None)
        row = attitude_rows([checked])[0]
        if pictures is not None:
            used = " ".join(f"{name}:{number}" for name, of in pictures.items() for number in of)
            row = f"{row[:-1]},{csv_word(used)}\n"
        self._file.write(row)
        self._file.flush()
        arrived_s = self.frames.arrived_s.pop(record.frame, None)
        latency_ms = None if arrived_s is None else max(1e3 * (time.time() - arrived_s), 0.0)
        if latency_ms is not None:
            (self.latency.steady if self.frames.caught_up else self.latency.start).append(latency_ms)
        if self.streams:
            content = frame_content(checked, latency_ms)
            content |= {} if pictures is None else {columns.PICTURES: pictures}
            for stream in self.streams:
                stream.send(content)
        if self.board is not None:
            self.board.add(checked, latency_ms)
        if self.line is not None:
            self._say(checked, latency_ms, self.line)

    def _say(self, record: FrameRecord, latency_ms: float | None, line: Callable[[str], None]) -> None:
        now_s = time.perf_counter()
        if self._begun_s is None:
            self._begun_s = self._said_s = now_s
        frames, measured = self._counts
        self._counts = frames + 1, measured + (record.tracked.pose_status is PoseStatus.MEASURED)
        if latency_ms is not None:
            self._recent_ms.append(latency_ms)
        if now_s - self._said_s < _LINE_S:
            return
        self._said_s = now_s
        late = np.percentile(self._recent_ms, [50, 100]) if self._recent_ms else (np.nan, np.nan)
        self._recent_ms.clear()
        shown = "" if np.isnan(late[0]) else f", latency {late[0]:.1f} ms (largest {late[1]:.1f} ms)"
        line(f"{now_s - self._begun_s:.0f} s: {self._counts[0]} frames, {self._counts[1]} measured{shown}")

    def finish(self, work: Path) -> dict[str, Any]:
        """Copy the live table into the results in `work`. Returns the watch's part of summary.json."""
        if self._file is not None:
            self._file.seek(0)
            with (work / LIVE_TABLE).open("w", encoding="utf-8", newline="") as copy:
                shutil.copyfileobj(self._file, copy)
        sent = [{"kind": s.kind, "to": s.address, "not_sent": s.failures} for s in self.streams]
        return {
            "live": {
                "latency_ms": self.latency.as_mapping(),
                "notes": self.frames.notes,
                "idle_s": self.frames.options.idle_s,
                "timeout_s": self.frames.options.timeout_s,
                "udp": next((s for s in sent if s["kind"] == "udp"), None),
                "streams": sent,
            }
        }

    def close(self) -> None:
        """Close the file. The streams belong to the caller."""
        if self._file is not None:
            self._file.close()

    def _opened(self, with_pictures: bool) -> TextIO:
        """Open the live table in its own folder, which replaces earlier results."""
        heads = (*columns.ATTITUDE, columns.PICTURES) if with_pictures else columns.ATTITUDE
        with replacement_within(self.out) as new:
            file = (new / LIVE_TABLE).open("w+", encoding="utf-8", newline="")
            file.write(",".join(heads) + "\n")
        return file


def frame_content(record: FrameRecord, latency_ms: float | None) -> dict[str, Any]:
    """One frame for streams. Units are in the names; unknown values are None."""
    t = record.tracked
    content: dict[str, Any] = {"frame": record.frame, "t_s": record.t_s, "status": t.pose_status.value}
    names = ("position_m", "quaternion_wxyz", "yaw_pitch_roll_deg", "sigma_position_m", "sigma_yaw_pitch_roll_deg")
    if t.pose is None or t.pose_covariance is None:
        content |= dict.fromkeys(names)
    else:
        numbers = pose_numbers(t.pose, t.pose_covariance).tolist()
        parts = (numbers[0:3], numbers[3:7], numbers[7:10], numbers[10:13], numbers[13:16])
        content |= dict(zip(names, parts, strict=True))
    content |= {"spots_used": t.spots_used, "latency_ms": latency_ms}
    return content


def is_live_table(folder: Path) -> bool:
    """Whether a folder contains only a live table, as after a watch that was killed."""
    try:
        return [p.name for p in folder.iterdir()] == [LIVE_TABLE]
    except OSError:
        return False
