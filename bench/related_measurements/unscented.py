"""The unscented filter under a disturbance: peaks and quiet RMS of the robust filter against the standard one.

    python -m bench.related_measurements.unscented --seeds 5000:5040
    python -m bench.related_measurements.unscented --pictures 5000:5004
    python -m bench.related_measurements.unscented --rivals 5000:5040 --process 4

Goals: peaks of position and velocity error at most 1/5 of the standard filter's (median of the recordings), quiet RMS
at most 1.2 times the standard filter's. Exit status 1 where one is missed. --pictures: one recording
of rendered pictures per seed through corners, RANSAC, pose and the Student-t filter; printed, without a goal.
--rivals: peaks of the position error under five disturbances over those of the better of the standard filter and one
that ignores the disturbed measurements. --process: factor of the paper's process noise, for all of these filters.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from functools import partial

import numpy as np

from studies.fu2016 import (
    DISTURBANCES,
    DT_S,
    FROM_S,
    POSITION,
    SIZE,
    TO_S,
    Recording,
    estimate,
    peaks,
    quiet_rms,
    run_pictures,
    simulate,
)
from tracking.unscented import (
    P0,
    SPREAD,
    X0,
    Lasting,
    Q,
    R,
    Rule,
    full_weight,
    gate,
    predict,
    process,
    selection,
    student_t,
    update,
)

LARGEST_PEAK_RATIO, LARGEST_QUIET_RATIO = 0.2, 1.2
SHAPES = ("burst", "ramp", "smooth bias", "oscillation", "outage")
OUTAGE_S = 4.0
AFTER = 11  # steps after a disturbance in which peaks are searched, too
OBSERVED = [1, 2, 4, 5, 6, 7]  # the observed states


def ratios(seeds: range, disturbance: str, name: str) -> np.ndarray:
    """(N, 3): errors of a filter over those of the standard one; position, velocity, angle."""
    out = []
    for seed in seeds:
        recording = simulate(seed, 0, disturbance)
        measure = quiet_rms if disturbance == "none" else peaks
        ours, standard = (np.array(measure(recording, estimate(recording, n))[:3]) for n in (name, "standard"))
        out.append(ours / standard)
    return np.array(out)


def pictures(seeds: range) -> None:
    """Shares of pictures with a pose and with wrong labels, and the filter's errors, over the recordings."""
    clear, disturbed, wrong, rms, largest = [], [], 0, [], []
    for seed in seeds:
        run = run_pictures(seed, robust=True)
        has_pose, quiet = np.isfinite(run.single[:, 0]), ~run.gust & (run.t_s > 1.0)
        clear.append(has_pose[~run.gust].mean())
        disturbed.append(has_pose[run.gust].mean())
        wrong += int(run.wrong.sum())
        rms.append(np.sqrt(np.mean(run.error[quiet] ** 2, axis=0)))
        largest.append(np.abs(run.error[run.gust][:, :3]).max())
    x, y, z, *_, yaw, pitch = np.median(rms, axis=0)
    print(
        f"pictures: pose in {100 * np.mean(clear):.1f} % of the clear and {100 * np.mean(disturbed):.1f} % of the"
        f" disturbed ones; {wrong} of {201 * len(seeds)} with a wrong label; filter RMS x {x:.4f} m, y {y:.4f} m, z"
        f" {z:.4f} m, yaw {np.rad2deg(yaw):.3f}, pitch {np.rad2deg(pitch):.3f} deg; largest position error 6 to 8 s:"
        f" median {np.median(largest):.3f} m, worst {np.max(largest):.3f} m"
    )


def disturbed(seed: int, shape: str) -> tuple[Recording, np.ndarray]:
    """A recording with a disturbance of one of SHAPES, and the steps (T,) that it covers."""
    if shape in DISTURBANCES:
        recording = simulate(seed, 0, shape)
        return recording, recording.disturbed
    recording = simulate(seed, 0, "none")
    t, on = recording.t_s[:, None], recording.disturbed
    if shape == "outage":
        on = (recording.t_s > FROM_S - 0.5 * DT_S) & (recording.t_s < FROM_S + OUTAGE_S)
    added = {
        "ramp": (t - FROM_S) / (TO_S - FROM_S),
        "oscillation": np.sin(2 * np.pi * 1.5 * (t - FROM_S)),
        "outage": 3 * np.random.default_rng(seed).standard_normal(recording.measured.shape),
    }[shape]
    recording.measured[on] += (SIZE * added)[on]
    return recording, on


def rivals(seeds: range, factor: float) -> None:
    """Peaks and NEES/6 of the filters beside one that ignores the disturbed measurements; Q times a factor."""
    rules: dict[str, Callable[[], Rule]] = {
        "standard": lambda: full_weight,
        "ignoring": lambda: full_weight,
        "gate": lambda: gate,
        "Student-t": lambda: student_t,
        "lasting": lambda: Lasting(partial(student_t, p_full_weight=0.03, power=6.0)),
    }
    for shape in SHAPES:
        peak, nees = {n: np.zeros(len(seeds)) for n in rules}, {n: np.zeros(len(seeds)) for n in rules}
        for i, seed in enumerate(seeds):
            recording, on = disturbed(seed, shape)
            steps = np.flatnonzero(on)
            for name, make in rules.items():
                x, P, rule = X0, P0, make()
                for k, measured in enumerate(recording.measured[: steps[-1] + AFTER]):
                    x, P = predict(x, P, process(DT_S), factor * Q, SPREAD)
                    if not (name == "ignoring" and on[k]):
                        step = update(x, P, measured, selection, R, SPREAD, rule)
                        x, P = step.x, step.P
                    if k >= steps[0]:
                        error = x - recording.states[k]
                        peak[name][i] = max(peak[name][i], np.abs(error[POSITION]).max())
                        own = error[OBSERVED] @ np.linalg.solve(P[np.ix_(OBSERVED, OBSERVED)], error[OBSERVED]) / 6
                        nees[name][i] += own / (steps[-1] + AFTER - steps[0])
        best = np.minimum(peak["standard"], peak["ignoring"])
        for name in rules:
            of = peak[name] / best
            print(
                f"{shape:12s} {name:10s} peak {np.median(peak[name]):.2f} m, over the better rival: median"
                f" {np.median(of):.2f}, 95 % {np.percentile(of, 95):.2f}; NEES/6 {np.median(nees[name]):.1f}"
            )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="5000:5040", help="FIRST:LAST, one recording each")
    parser.add_argument("--pictures", help="FIRST:LAST: recordings of pictures instead")
    parser.add_argument("--rivals", help="FIRST:LAST: five disturbances, beside a filter that ignores them")
    parser.add_argument("--process", type=float, default=1.0, help="factor of the process noise, with --rivals")
    arguments = parser.parse_args()
    if arguments.rivals:
        rivals(range(*map(int, arguments.rivals.split(":"))), arguments.process)
        return 0
    if arguments.pictures:
        pictures(range(*map(int, arguments.pictures.split(":"))))
        return 0
    first, last = map(int, arguments.seeds.split(":"))
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
