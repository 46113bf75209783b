"""Cost of a run: `python -m bench.throughput` prints process time per frame of each stage, and peak memory.

Two simulated cameras of 1280x1024, 8 bit. User and system time of all threads, ms per frame, compared with cv2.imread
(IMREAD_UNCHANGED, one thread) over the same files. Each job runs in its own process; the minimum of some repeats
counts. The pictures are made once and kept in build/throughput (0.3 GB per format; longer runs link to them).
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from bench.throughput.folders import FORMATS, run_folder

COLUMNS = ("decode", "detect", "track", "smooth", "tables", "model check", "report")
ONCE = ("start-up", "load compiled", "compile")  # s, independent of the length


def job(*arguments: object) -> dict[str, Any]:
    """The output of bench.throughput.stages for one job."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}  # as for users
    command = [sys.executable, "-m", "bench.throughput.stages", *map(str, arguments)]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True, env=environment)
    out: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return out


def least(repeats: int, *arguments: object) -> dict[str, Any]:
    """The repeat of a job with the lowest total."""
    return min((job(*arguments) for _ in range(repeats)), key=lambda result: float(result["total"]))


def measure(kind: str, folder: Path, frames: int, out: Path, repeats: int) -> None:
    """Measure one format and length, and print its row."""
    reading = None
    if kind != "points":
        ours = least(repeats, "read", folder)["stages"]["read"]
        theirs = least(repeats, "video" if kind == "mjpeg" else "imread", folder)["stages"]["read"]
        reading = (1e3 * ours / frames, 1e3 * theirs / frames)
    job("run", folder, out)  # compiles if necessary
    run = least(repeats, "run", folder, out)
    again = least(repeats, "report", out)["stages"]["report"]
    stages = run["stages"]
    once = sum(stages.get(name, 0.0) for name in ONCE)
    rest = run["total"] - once - sum(stages.get(name, 0.0) for name in COLUMNS)
    cells = [f"{1e3 * stages.get(name, 0.0) / frames:9.2f}" for name in COLUMNS]
    cells += [f"{1e3 * rest / frames:9.2f}", f"{1e3 * (run['total'] - once) / frames:9.2f}"]
    cells += [f"{stages.get(name, 0.0):9.2f}" for name in ONCE[:2]]
    cells += [f"{run['total']:9.2f}", f"{run['wall']:9.2f}", f"{again:9.2f}", f"{run['megabytes']:7.0f}"]
    read = " " * 27
    if reading is not None:
        read = f"{reading[0]:9.2f}{reading[1]:9.2f}{reading[0] / reading[1]:9.2f}"
    print(f"{kind:8s}{frames:7d}{read}{''.join(cells)}", flush=True)
    if reading is not None:
        imread_s = reading[1] * frames / 1e3
        print(
            f"{'':15s}run / cv2: {(run['total'] - once) / imread_s:.2f} without start-up, {run['total'] / imread_s:.2f}"
            f" with; wall {run['wall'] / imread_s:.2f}",
            flush=True,
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[300, 3000])
    parser.add_argument("--long", action="store_true", help="also 30,000 frames (no video)")
    parser.add_argument("--formats", nargs="+", choices=FORMATS, default=list(FORMATS))
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--scenario", default="huo2015")
    parser.add_argument("--keep", type=Path, default=Path("build/throughput"), help="where the pictures are kept")
    a = parser.parse_args()
    print("ms of process time per frame of two cameras; once, total, wall and report again in s; memory in MB")
    names = ["reading", "cv2", "ratio", *COLUMNS, "rest", "all", *ONCE[:2], "total", "wall", "again"]
    print(f"{'':8s}{'frames':>7s}" + "".join(f"{name[:8]:>9s}" for name in names) + f"{'memory':>7s}")
    for kind in a.formats:
        for frames in [*a.frames, *([30_000] if a.long and kind != "mjpeg" else [])]:
            folder = run_folder(a.keep, kind, frames, a.scenario)
            repeats = a.repeats if frames <= 3000 else 1
            measure(kind, folder, frames, a.keep / "out", repeats)
            if frames > 3000:
                shutil.rmtree(folder)
    shutil.rmtree(a.keep / "out", ignore_errors=True)


if __name__ == "__main__":
    main()
