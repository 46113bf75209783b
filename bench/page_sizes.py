"""Sizes of the pages: `python -m bench.page_sizes [--frames 300 10000 100000] [--runs 2000] [--seed 1]`.

The reports are of simulated recordings of points that are processed as any run, with causal poses and truth. The index
is of a batch: PROCESSED different runs of 300 frames, whose results are copied until there are as many as asked for.
The goals are those of the project: 0.6, 2 and 5 MB; 3 MB. 100,000 frames take a quarter of an hour.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path

from lab.report.index import write_index
from lab.runs.batch.batch import process_batch, read_rows
from lab.runs.process import process_run
from lab.simulate.write import simulate

SCENARIO = "smooth"
PROCESSED = 20
INDEX_READS = ("attitude.csv", "summary.json")


def report_bytes(frames: int, seed: int, work: Path) -> int:
    """Size of the report of a simulated recording."""
    run = simulate(SCENARIO, work / f"run-{frames}", seed=seed, frames=frames, points=True)
    process_run(run, work / f"out-{frames}")
    return (work / f"out-{frames}" / "report.html").stat().st_size


def index_bytes(runs: int, seed: int, work: Path) -> int:
    """Size of the index of a batch of so many runs."""
    folders = [
        simulate(SCENARIO, work / f"run-of-day-{k:04d}", seed=seed + k, frames=300, points=True)
        for k in range(min(PROCESSED, runs))
    ]
    process_batch(folders, work / "batch")
    rows = read_rows(work / "batch" / "batch.csv")
    copied = []
    for k in range(runs):
        row = rows[k % len(rows)]
        name = f"run-of-day-{k:04d}"
        if k >= len(rows):
            (work / "batch" / name).mkdir()
            for file in INDEX_READS:
                shutil.copyfile(work / "batch" / row["results"] / file, work / "batch" / name / file)
        folder = str(Path(row["folder"]).with_name(name))
        copied.append({**row, "name": name, "run": folder, "folder": folder, "results": name})
    return write_index(copied, work / "batch").stat().st_size


def main() -> None:
    """Print the sizes."""
    parser = argparse.ArgumentParser(prog="bench.page_sizes", description=__doc__)
    parser.add_argument("--frames", type=int, nargs="*", default=[300, 10_000, 100_000])
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    a = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="beampose-") as name:
        if a.runs:
            size = index_bytes(a.runs, a.seed, Path(name))
            print(f"index of {a.runs} runs: {size / 1e6:.2f} MB", flush=True)
        for frames in a.frames:
            size = report_bytes(frames, a.seed, Path(name))
            print(f"report of {frames} frames: {size / 1e6:.2f} MB", flush=True)


if __name__ == "__main__":
    main()
