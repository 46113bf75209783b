"""Streams of a watched run: each frame's pose, as it is known, to other programs by UDP, ZeroMQ or LSL.

None of them waits for a receiver: what cannot be sent is counted.
"""

from __future__ import annotations

import contextlib
import json
import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

from lab.errors import InputError
from lab.files.text.json_text import plain_value
from lab.packages import needed
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
