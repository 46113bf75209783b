"""Latency of the poses of `beampose watch`: `python -m bench.live [--frames 1000] [--rate 100] [--format pgm]`.

A second process writes simulated pictures of two 1280x1024 cameras into the frame folders at the given rate, as a
recorder does (the pictures are made once and kept in build/live). The latency is that of summary.json: from the arrival
of the last picture of a frame until its pose is written. The load of the machine is printed as well: the figure is for
two free cores.

--page: a third process reads the live page as a browser does, in every second block of two seconds; the latencies with
and without it come from the same run. It draws nothing: what a browser on the same computer computes is not included.
"""

from __future__ import annotations

import argparse
import http.client
import json
import multiprocessing
import os
import shutil
import socket
import tempfile
import threading
import time
from multiprocessing.synchronize import Event
from pathlib import Path
from threading import Timer

import numpy as np

from bench.throughput.folders import run_folder
from lab.runs.watch.live_frames import WatchOptions
from lab.runs.watch.watch import watch_run

PORT = 8735  # of the page
BLOCK_S = 2.0  # with and without a reader of the page, in turn
KEPT = 300  # latest frames kept on disk; older ones are deleted, as in a ring buffer


def feed(source: Path, target: Path, frames: int, rate_hz: float, begin: Event) -> None:
    """Write the pictures of a run folder into another one at a constant rate."""
    cameras = sorted(p.name for p in (source / "frames").iterdir())
    pictures = {c: [p.read_bytes() for p in sorted((source / "frames" / c).iterdir())] for c in cameras}
    suffix = next((source / "frames" / cameras[0]).iterdir()).suffix
    begin.wait()
    start = time.perf_counter()
    for frame in range(frames):
        time.sleep(max(0.0, start + frame / rate_hz - time.perf_counter()))
        for camera in cameras:
            some = pictures[camera]
            turn, k = divmod(frame, len(some))
            data = some[k if turn % 2 == 0 else len(some) - 1 - k]
            (target / "frames" / camera / f"{frame:06d}{suffix}").write_bytes(data)
            old = target / "frames" / camera / f"{frame - KEPT:06d}{suffix}"
            old.unlink(missing_ok=True)
    took = time.perf_counter() - start
    print(f"fed {frames} frames in {took:.2f} s ({frames / took:.1f} Hz)", flush=True)


def read_page(poses: socket.socket, reading: threading.Event) -> None:
    """Read states and pictures as the page's program does, while `reading` is set."""
    while True:
        reading.wait()
        try:
            events, pictures = (http.client.HTTPConnection("127.0.0.1", PORT, timeout=5) for _ in range(2))
            events.request("GET", "/state")
            stream = events.getresponse()
            while reading.is_set():
                line = stream.readline()
                if not line.startswith(b"data: "):
                    continue
                for camera in json.loads(line[6:])["cameras"]:
                    pictures.request("GET", f"/picture?camera={camera['name']}")
                    pictures.getresponse().read()
                    pictures.close()
            events.close()
        except OSError:
            time.sleep(0.1)


def compare(answer: multiprocessing.Queue[object]) -> None:
    """Latencies with and without a reader of the page, by the lines that `watch` sends."""
    poses = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    poses.bind(("127.0.0.1", PORT))
    poses.settimeout(1.0)
    reading, found = threading.Event(), {True: [], False: []}
    threading.Thread(target=read_page, args=(poses, reading), daemon=True).start()
    start = None
    while True:
        try:
            latency = json.loads(poses.recv(65536))["latency_ms"]
        except TimeoutError:
            if start is not None:
                break
            continue
        now = time.perf_counter()
        start = now + 4 if start is None else start  # after the start's backlog
        block, within = divmod(now - start, BLOCK_S)
        reading.set() if block % 2 else reading.clear()
        if now > start and within > 0.3 and latency is not None:
            found[bool(block % 2)].append(latency)
    out = {}
    for name, read in (("without", False), ("with", True)):
        values = np.array(found[read])
        out[name] = {"frames": len(values), "median": np.median(values), "p95": np.percentile(values, 95)}
    out["ratio"] = {k: out["with"][k] / out["without"][k] for k in ("median", "p95")}
    answer.put(out)


def measure(
    kept: Path, work: Path, kind: str, frames: int, rate_hz: float, scenario: str, page: bool = False
) -> dict[str, object]:
    """Feed and watch one run; returns the latency in summary.json."""
    source = run_folder(kept, kind, min(frames, 100), scenario)
    target = work / "run"
    for camera in sorted(p.name for p in (source / "frames").iterdir()):
        (target / "frames" / camera).mkdir(parents=True)
    for name in ("rig.yaml", "run.yaml"):
        shutil.copy(source / name, target / name)
    begin = multiprocessing.Event()
    feeder = multiprocessing.Process(target=feed, args=(source, target, frames, rate_hz, begin), daemon=True)
    feeder.start()
    Timer(8.0, begin.set).start()  # loading takes some seconds
    answer: multiprocessing.Queue[object] = multiprocessing.Queue()
    if page:
        multiprocessing.Process(target=compare, args=(answer,), daemon=True).start()
    more = {"page": str(PORT), "udp": f"127.0.0.1:{PORT}"} if page else {}
    watch_run(target, work / "out", options=WatchOptions(idle_s=2.0), **more)
    feeder.join()
    summary = json.loads((work / "out" / "summary.json").read_text("utf-8"))
    live: dict[str, object] = summary["live"]["latency_ms"]
    live["notes"], live["timings"] = summary["notes"], summary["timings"]
    if page:
        live["page"] = answer.get(timeout=30)
    return live


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--rate", type=float, default=100.0, help="Hz")
    parser.add_argument("--format", default="pgm", choices=("pgm", "tiff", "png"))
    parser.add_argument("--scenario", default="huo2015")
    parser.add_argument("--kept", type=Path, default=Path("build/live"))
    parser.add_argument("--page", action="store_true", help="compare latencies with and without a reader of the page")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="beampose-live-") as name:
        load = os.getloadavg()[0]
        live = measure(given.kept, Path(name), given.format, given.frames, given.rate, given.scenario, given.page)
        print(f"load before {load:.1f}, after {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
        print(json.dumps(live, indent=1))


if __name__ == "__main__":
    main()
