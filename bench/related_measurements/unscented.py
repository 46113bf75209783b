"""The unscented filter under a disturbance: peaks and quiet RMS of the robust filter against the standard one.

    python -m bench.related_measurements.unscented --seeds 5000:5040

Goals: peaks of position and velocity error at most 1/5 of the standard filter's (median of the recordings), quiet RMS
at most 1.2 times the standard filter's. Exit status 1 where one is missed.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from lab.unscented.experiment_fu2016 import DISTURBANCES, estimate, peaks, quiet_rms, simulate

LARGEST_PEAK_RATIO, LARGEST_QUIET_RATIO = 0.2, 1.2


def ratios(seeds: range, disturbance: str, name: str) -> np.ndarray:
    """(N, 3): errors of a filter over those of the standard one; position, velocity, angle."""
    out = []
    for seed in seeds:
        recording = simulate(seed, 0, disturbance)
        measure = quiet_rms if disturbance == "none" else peaks
        ours, standard = (np.array(measure(recording, estimate(recording, n))[:3]) for n in (name, "standard"))
        out.append(ours / standard)
    return np.array(out)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="5000:5040", help="FIRST:LAST, one recording each")
    first, last = map(int, parser.parse_args().seeds.split(":"))
    missed = 0
    for disturbance in DISTURBANCES:
        limit = LARGEST_QUIET_RATIO if disturbance == "none" else LARGEST_PEAK_RATIO
        for name in ("gate", "Student-t"):
            of = ratios(range(first, last), disturbance, name)
            middle, worst = np.median(of, axis=0), of.max(axis=0)
            good = bool(np.all(middle[:2] <= limit))
            missed += not good and name == "Student-t"
            print(
                f"{disturbance:12s} {name:10s} ratio to standard, median (worst): position {middle[0]:.3f}"
                f" ({worst[0]:.3f}), velocity {middle[1]:.3f} ({worst[1]:.3f}), angle {middle[2]:.3f} ({worst[2]:.3f});"
                f" goal {limit:g}: {'reached' if good else 'missed'}"
            )
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
