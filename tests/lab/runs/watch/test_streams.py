"""Every stream of a watched run delivers the frames to the library at its other end, and none waits for it."""

from __future__ import annotations

import importlib
import json
import math
import socket
import time

import pytest

from lab.errors import InputError
from lab.packages import PACKAGES
from lab.runs.watch.live_output import opened
from tracking.statuses import PoseStatus

POSE = {
    "frame": 7,
    "t_s": 0.07,
    "status": "measured",
    "position_m": [0.1, -0.2, 1 / 3],
    "quaternion_wxyz": [math.cos(0.25), 0.0, 0.0, math.sin(0.25)],
    "yaw_pitch_roll_deg": [math.degrees(0.5), 0.0, 0.0],
    "sigma_position_m": [1e-4, 2e-4, 3e-4],
    "sigma_yaw_pitch_roll_deg": [0.01, 0.02, 0.03],
    "spots_used": 6,
    "latency_ms": 250.0,
}
LOST = {
    **POSE,
    "frame": 8,
    "status": "lost",
    "latency_ms": None,
    **dict.fromkeys([k for k in POSE if k[-2:] in ("_m", "yz", "eg")]),
}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_udp_and_zeromq_receive_a_line_of_json_per_frame():
    zmq, port = pytest.importorskip("zmq"), free_port()
    context = zmq.Context()
    subscriber, listener = context.socket(zmq.SUB), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    subscriber.setsockopt(zmq.RCVTIMEO, 100)
    subscriber.setsockopt(zmq.LINGER, 0)
    subscriber.subscribe(b"")
    listener.bind(("127.0.0.1", 0))
    udp = f"127.0.0.1:{listener.getsockname()[1]}"
    with listener, opened(udp, [f"zmq:127.0.0.1:{port}", f"udp:{udp}"], 100.0) as streams:
        subscriber.connect(f"tcp://127.0.0.1:{port}")
        first = b""
        for _ in range(100):  # a subscriber receives what is published once it is connected
            streams[1].send(POSE)
            try:
                first = subscriber.recv()
                break
            except zmq.Again:
                pass
        assert json.loads(first) == POSE
        for content in (POSE, LOST):
            for stream in streams:
                stream.send(content)
        assert [json.loads(listener.recv(10_000)) for _ in range(4)] == [POSE, POSE, LOST, LOST]
        got = [json.loads(subscriber.recv()) for _ in range(2)]
        assert got[-1] == LOST or json.loads(subscriber.recv()) == LOST
    assert [stream.failures for stream in streams] == [0, 0, 0]
    subscriber.close()
    context.term()


def test_lsl_receives_labelled_samples_with_the_time_of_the_picture():
    lsl = pytest.importorskip("pylsl")
    name = f"beampose-test-{time.time_ns()}"
    with opened(None, [f"lsl:{name}"], 100.0) as (stream,):
        found = lsl.resolve_byprop("name", name, timeout=20)
        assert len(found) == 1
        inlet = lsl.StreamInlet(found[0])
        inlet.open_stream(timeout=20)
        before = lsl.local_clock()
        for content in (POSE, LOST):
            stream.send(content)
        (sample, stamp), (lost, _) = (inlet.pull_sample(timeout=20) for _ in range(2))
        channel, labels, units = inlet.info().desc().child("channels").child("channel"), [], []
        while not channel.empty():
            labels.append(channel.child_value("label"))
            units.append(channel.child_value("unit"))
            channel = channel.next_sibling("channel")
        assert inlet.info().nominal_srate() == 100.0
        inlet.close_stream()
    read, unit = dict(zip(labels, sample, strict=True)), dict(zip(labels, units, strict=True))
    assert [read[k] for k in "xyz"] == POSE["position_m"]
    assert [read[k] for k in ("qw", "qx", "qy", "qz")] == POSE["quaternion_wxyz"]
    assert [read[k] for k in ("yaw", "sigma_roll", "frame")] == [POSE["yaw_pitch_roll_deg"][0], 0.03, 7]
    assert (unit["x"], unit["yaw"]) == ("meters", "degrees")
    assert f"{int(read['status'])} measured" in unit["status"]
    assert -0.25 <= stamp - before < 0.25  # a quarter of a second before it was sent
    assert math.isnan(lost[labels.index("x")])
    assert list(PoseStatus)[int(lost[labels.index("status")])] == "lost"


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("127.0.0.1:5556", "--stream: expected udp:HOST:PORT, zmq:HOST:PORT or lsl:NAME"),
        ("lsl:", "--stream: expected udp:HOST:PORT"),
        ("udp:127.0.0.1", "--stream udp: expected HOST:PORT"),
        ("zmq:no.such.host.invalid:5556", "--stream zmq: expected an address of this computer"),
    ],
)
def test_an_address_that_cannot_be_used_is_an_input_error(address, words):
    if address.startswith("zmq"):
        pytest.importorskip("zmq")
    with pytest.raises(InputError) as raised, opened(None, [address], 100.0):
        pass
    assert str(raised.value).startswith(words)


@pytest.mark.parametrize("extra", ["zmq", "lsl"])
def test_a_package_that_is_missing_is_named_with_its_extra(extra, monkeypatch):
    real = importlib.import_module
    top = PACKAGES[extra][0]
    monkeypatch.setattr(importlib, "import_module", lambda name, *a: real("no_such" if name == top else name, *a))
    with (
        pytest.raises(InputError, match=rf"pip install 'beampose\[{extra}\]'"),
        opened(None, [f"{extra}:127.0.0.1:1"], 9),
    ):
        pass
