"""What a whole `run` costs: `python -m bench.whole_run` prints process time against reading the files, and peak memory.

Time: `beampose run` on simulated 1280x1024 PNG files against plain cv2.imread over the same files, each in a process of
its own, in turn, user + system time of all threads. Memory: peak resident size of runs of 300 and of 3000 frames
(points; and pictures with --pictures-memory, which takes some minutes and gigabytes of disk).
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2

from lab.simulate.write import simulate

_READ = """
import sys, pathlib, cv2
cv2.setNumThreads(1)
for path in sorted(pathlib.Path(sys.argv[1]).rglob("*.png")):
    cv2.imread(str(path), *map(int, sys.argv[2:]))
"""
_RUN = "from cli import main; main()"


def spent(code: str, *arguments: str) -> tuple[float, float]:
    """Process time, s, and peak resident size, MB, of a fresh Python that runs `code`. Raises if it fails."""
    child = subprocess.Popen([sys.executable, "-c", code, *arguments], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode not in (0, 4):
        raise RuntimeError(f"exit status {child.returncode}")
    return usage.ru_utime + usage.ru_stime, _megabytes(usage)


def _megabytes(usage: resource.struct_rusage) -> float:
    """Linux counts in kilobytes, macOS in bytes."""
    return usage.ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--scenario", default="huo2015")
    parser.add_argument("--pictures-memory", action="store_true")
    a = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run = simulate(a.scenario, folder / "run", seed=9100, frames=a.frames)
        reads, greys, runs = [], [], []
        for _ in range(a.repeats):
            reads.append(spent(_READ, str(run))[0])
            greys.append(spent(_READ, str(run), str(cv2.IMREAD_UNCHANGED))[0])
            runs.append(spent(_RUN, "run", str(run), "--out", str(folder / "out"))[0])
        ratios = [r / i for r, i in zip(runs, reads, strict=True)]
        to_grey = [r / i for r, i in zip(runs, greys, strict=True)]
        print(
            f"{a.frames} frames of two 1280x1024 cameras: imread {statistics.median(reads):.2f} s, run"
            f" {statistics.median(runs):.2f} s process time; ratio {statistics.median(ratios):.2f}"
            f" ({min(ratios):.2f} to {max(ratios):.2f}); goal <= 2. Against imread that keeps grey pictures grey"
            f" ({statistics.median(greys):.2f} s): {statistics.median(to_grey):.2f}"
        )
        shutil.rmtree(run)
        peaks = []
        for frames in (300, 3000):
            run = simulate(a.scenario, folder / "run", seed=9101, frames=frames, detections_only=not a.pictures_memory)
            peaks.append(spent(_RUN, "run", str(run), "--out", str(folder / "out"))[1])
            shutil.rmtree(run)
        what = "pictures" if a.pictures_memory else "points"
        print(
            f"peak resident size ({what}): {peaks[0]:.0f} MB at 300 frames, {peaks[1]:.0f} MB at 3000:"
            f" {peaks[1] / peaks[0] - 1:+.1%}; goal within 10 %"
        )


if __name__ == "__main__":
    main()
