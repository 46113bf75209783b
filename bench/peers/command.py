"""Comparison of trackers: `python -m bench.peers` (or `make bench-peers`).

All trackers get the same points (bench/peers/scenes.py). Identity, gaps and re-entries are scored with the first label
of each spot (identity.py), IDF1, switches and MOTA by py-motmetrics, speed by process time of the tracking loop. Our
trackers get the rig and a wide prior (1 m, 35 deg), but no labels; the fixed targets of PyRecEst get those of frame 0.
Writes bench/peers/results.csv, where new figures replace those of the same tracker, scene, seed and length, and prints
the figures of this run as a Markdown table.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path

from bench.peers.results import Result, judged, merged, read_results, write_results
from bench.peers.scenes import SCENES, make_scene
from bench.peers.table import MISSING, markdown
from bench.peers.trackers import ENTRIES, OURS, Entry

RESULTS = Path(__file__).with_name("results.csv")
WARM_UP_FRAMES = 200  # tracked first without timing, which excludes imports and compilation. With 40, before the first
# occlusion, 0.9 s of compilation remained in the first scene.


def run(
    entries: Sequence[Entry], scenes: Sequence[str], seeds: Sequence[int], frames: int, keep: Callable[[Result], None]
) -> list[str]:
    """Passes each result to `keep` at once. Returns a line for each tracker that failed."""
    measured = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    failures: list[str] = []
    # `rigid` comes first in every scene, so that the others are compared with its latest time.
    ready = sorted((e for e in entries if e.installed), key=lambda e: e.name != "rigid")
    warm: set[str] = set()
    for name in scenes:
        for i, seed in enumerate(seeds):
            scene = make_scene(name, seed, frames)
            rigid_s = math.nan
            for entry in ready:
                if entry.seeds is not None and i >= entry.seeds:
                    continue
                try:
                    if entry.name not in warm:
                        entry.track(make_scene("standard", seed, WARM_UP_FRAMES))
                        warm.add(entry.name)
                    rows = entry.track(scene)
                except Exception as error:  # other packages may raise anything; the bench continues
                    failures.append(f"{entry.name} on {name}, seed {seed}: {type(error).__name__}: {error}")
                    continue
                if entry.name == "rigid":
                    rigid_s = rows.spent_s
                keep(judged(entry, scene, rows, rigid_s, measured))
    return failures


def notes(entries: Iterable[Entry], seeds: Sequence[int]) -> list[str]:
    """Notes on the table: missing trackers, and trackers with fewer seeds."""
    lines = [f"{e.name}: {MISSING}" for e in entries if not e.installed]
    short = [e for e in entries if e.installed and e.seeds is not None and e.seeds < len(seeds)]
    lines += [f"{e.name}: slow, seeds {', '.join(map(str, seeds[: e.seeds]))} only" for e in short]
    if find_spec("motmetrics") is None:
        lines.append("IDF1, switches and MOTA: motmetrics is not installed: make peers")
    return lines


def _print(result: Result) -> None:
    """Print progress to standard error."""
    print(
        f"{result.tracker:14s} {result.scene:9s} {result.seed}: identity {result.identity:.4f},"
        f" {result.frames_per_s:.0f} frames/s",
        file=sys.stderr,
        flush=True,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the comparison; returns exit status 1 if a tracker failed."""
    parser = argparse.ArgumentParser("bench.peers", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "LAST"), default=(101, 102))
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES), metavar="SCENE")
    parser.add_argument("--trackers", nargs="+", choices=[*ENTRIES, "ours"], default=list(ENTRIES), metavar="TRACKER")
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--out", type=Path, default=RESULTS)
    a = parser.parse_args(arguments)
    names = list(dict.fromkeys(n for given in a.trackers for n in (OURS if given == "ours" else (given,))))
    entries = [ENTRIES[name] for name in names]
    seeds = range(a.seeds[0], a.seeds[1] + 1)
    if not seeds:
        parser.error(f"--seeds: expected FIRST <= LAST, got {a.seeds[0]} {a.seeds[1]}")
    try:
        old = read_results(a.out)  # reports a wrong file before the work
    except ValueError as error:
        parser.error(str(error))
    results: list[Result] = []

    def keep(result: Result) -> None:
        results.append(result)
        write_results(merged(old, results), a.out)  # at once: the bench may be interrupted after half an hour
        _print(result)

    failures = run(entries, a.scenes, seeds, a.frames, keep)
    print(markdown(results, names))
    for line in notes(entries, seeds):
        print(f"\n{line}")
    for line in failures:
        print(line, file=sys.stderr)
    return 1 if failures else 0
