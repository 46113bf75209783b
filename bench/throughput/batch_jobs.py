"""What a second process brings a batch: `python -m bench.throughput.batch_jobs [--runs 12] [--frames 600] [--jobs 2]`.

A batch of equal runs with 1 process and with N, in turn, each in a program of its own. Printed are wall time, the
process time of all its processes (user and system), and their ratios. The speed-up in wall time needs an idle machine
with N free cores; the ratio of the process times does not: above 1 it is what the processes cost each other (start-up,
threads). The runs are made once and kept in build/batch_jobs.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from bench.throughput.folders import FORMATS, run_folder


@dataclass(frozen=True, slots=True)
class Cost:
    """Of one program."""

    wall_s: float
    process_s: float  # user and system, of its processes too


def batch(runs: list[Path], out: Path, jobs: int, *more: str) -> Cost:
    """Process the runs in a new program."""
    command = [sys.executable, "-m", "cli", "batch", *map(str, runs), "--out", str(out), "--jobs", str(jobs), *more]
    begun = time.perf_counter()
    program = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(program.pid, 0)
    program.returncode = os.waitstatus_to_exitcode(status)
    if program.returncode not in (0, 4):
        raise SystemExit(f"the batch ended with status {program.returncode}")
    return Cost(time.perf_counter() - begun, used.ru_utime + used.ru_stime)


def copies(folder: Path, count: int) -> list[Path]:
    """The run folder under several names."""
    out = []
    for i in range(count):
        place = folder.with_name(f"{folder.name}-copies") / f"run-{i:03d}"
        if not (place / "run.yaml").is_file():
            shutil.rmtree(place, ignore_errors=True)
            shutil.copytree(folder, place, copy_function=os.link)
        out.append(place)
    return out


def measure(kind: str, a: argparse.Namespace) -> None:
    """Measure one format, and print its row."""
    runs, out = copies(run_folder(a.keep, kind, a.frames, a.scenario), a.runs), a.keep / "out"
    one, many = [], []
    batch(runs[:1], out, 1)  # compiles if necessary
    for _ in range(a.repeats):
        one.append(batch(runs, out, 1, "--force"))
        many.append(batch(runs, out, a.jobs, "--force"))
    skipped = batch(runs, out, a.jobs)
    shutil.rmtree(out)
    wall = [statistics.median(cost.wall_s for cost in costs) for costs in (one, many)]
    used = [min(cost.process_s for cost in costs) for costs in (one, many)]
    print(
        f"{kind:8s}{wall[0]:9.2f}{wall[1]:9.2f}{wall[0] / wall[1]:10.2f}"
        f"{used[0]:11.2f}{used[1]:9.2f}{used[1] / used[0]:8.2f}{used[1] / wall[1]:8.2f}{skipped.wall_s:10.2f}",
        flush=True,
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=12)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--formats", nargs="+", choices=FORMATS, default=["points", "png"])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--scenario", default="huo2015")
    parser.add_argument("--keep", type=Path, default=Path("build/batch_jobs"), help="where the runs are kept")
    a = parser.parse_args()
    print(f"{a.runs} runs of {a.frames} frames; s, medians of wall and minima of process time of {a.repeats}")
    print(f"load of the machine before: {os.getloadavg()[0]:.1f}")
    names = ("wall 1", f"wall {a.jobs}", "speed-up", "process 1", f"proc {a.jobs}", "ratio", "cores", "skipped")
    widths = (9, 9, 10, 11, 9, 8, 8, 10)
    print(f"{'':8s}" + "".join(f"{name:>{width}s}" for name, width in zip(names, widths, strict=True)))
    for kind in a.formats:
        measure(kind, a)


if __name__ == "__main__":
    main()
