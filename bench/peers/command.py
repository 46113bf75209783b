"""The tracking bench with peers: `python -m bench.peers` (or `make bench-peers`).

All trackers get the same points (bench/peers/scenes.py). Identity, gaps and re-entries are judged under each spot's
first label (identity.py), IDF1, switches and MOTA by py-motmetrics, speed in process time of the tracking loop. Our
own trackers get the rig and a wide prior (1 m, 35 deg), but no labels; PyRecEst's fixed targets get those of frame 0.
Writes bench/peers/results.csv, where newer figures replace older ones of the same tracker, scene, seed and length, and
prints the figures of this run as a Markdown table.
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
WARM_UP_FRAMES = 200  # tracked beforehand, untimed: imports and compilation are not the loop. With 40, before anything
# is hidden, 0.9 s of compiling was left to the first scene.


def run(
    entries: Sequence[Entry], scenes: Sequence[str], seeds: Sequence[int], frames: int, keep: Callable[[Result], None]
) -> list[str]:
    """Hands each result to `keep` as soon as it is there. Returns a line on each tracker that failed."""
    measured = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    failures: list[str] = []
    # `rigid` comes first in every scene, so that the others are compared with what it took just before.
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
                except Exception as error:  # other people's code may raise anything; the rest of the bench goes on
                    failures.append(f"{entry.name} on {name}, seed {seed}: {type(error).__name__}: {error}")
                    continue
                if entry.name == "rigid":
                    rigid_s = rows.spent_s
                keep(judged(entry, scene, rows, rigid_s, measured))
    return failures


def notes(entries: Iterable[Entry], seeds: Sequence[int]) -> list[str]:
    """What a reader of the table must know: which trackers are missing, which took fewer seeds."""
    lines = [f"{e.name}: {MISSING}" for e in entries if not e.installed]
    short = [e for e in entries if e.installed and e.seeds is not None and e.seeds < len(seeds)]
    lines += [f"{e.name}: slow, seeds {', '.join(map(str, seeds[: e.seeds]))} only" for e in short]
    if find_spec("motmetrics") is None:
        lines.append("IDF1, switches and MOTA: motmetrics is not installed: make peers")
    return lines


def _tell(result: Result) -> None:
    """Progress, so that the table alone is on standard output."""
    print(
        f"{result.tracker:14s} {result.scene:9s} {result.seed}: identity {result.identity:.4f},"
        f" {result.frames_per_s:.0f} frames/s",
        file=sys.stderr,
        flush=True,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status 1 where a tracker failed."""
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
        parser.error(f"--seeds: the last, {a.seeds[1]}, comes before the first, {a.seeds[0]}")
    try:
        old = read_results(a.out)  # a file of another kind is told before the work
    except ValueError as error:
        parser.error(str(error))
    results: list[Result] = []

    def keep(result: Result) -> None:
        results.append(result)
        write_results(merged(old, results), a.out)  # at once: half an hour's bench may be broken off
        _tell(result)

    failures = run(entries, a.scenes, seeds, a.frames, keep)
    print(markdown(results, names))
    for line in notes(entries, seeds):
        print(f"\n{line}")
    for line in failures:
        print(line, file=sys.stderr)
    return 1 if failures else 0
