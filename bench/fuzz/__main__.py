"""Run damaged inputs and print what ended wrongly.

    python -m bench.fuzz --inputs 3000 --seed 1 --jobs 2

--only N repeats one case and keeps its input.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path

from bench.fuzz.inputs import write_inputs
from bench.fuzz.judge import run_case
from bench.fuzz.workers import endings
from lab.runs.warm_up import warm_up


def main() -> None:
    """Print the faults, and a count by kind and exit status."""
    parser = argparse.ArgumentParser(prog="bench.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only", type=int, help="the number of one case")
    a = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    warm_up()  # compiling, once for a machine, is no fault of a case
    base = write_inputs(folder / "base")
    if a.only is not None:
        print(run_case(a.seed, a.only, base, folder / "work-0"), f"\ninput: {folder}")
        return
    counts: Counter[tuple[str, int]] = Counter()
    faults, slowest = 0, 0.0
    for done, ending in enumerate(endings(range(a.inputs), a.seed, base, folder, a.jobs), 1):
        if done % 100 == 0:
            print(f"{done} of {a.inputs}, {faults} faults", file=sys.stderr, flush=True)
        counts[ending.kind, ending.status] += 1
        slowest = max(slowest, ending.seconds)
        if ending.fault:
            faults += 1
            print(
                f"case {ending.number} ({ending.kind}): {' '.join(ending.command)[:300]!a}\n{ending.fault!a}",
                flush=True,
            )
    shutil.rmtree(os.fsencode(folder), ignore_errors=True)
    for kind in sorted({kind for kind, _ in counts}):
        by_status = ", ".join(f"status {s}: {n}" for (k, s), n in sorted(counts.items()) if k == kind)
        print(f"{kind:20s}{by_status}")
    print(f"{a.inputs} inputs, seed {a.seed}: {faults} faults; slowest {slowest:.1f} s of process time")
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
