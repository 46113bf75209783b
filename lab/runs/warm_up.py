"""Compiles the code that runs need, so that the first run does not wait: `python -m lab.runs.warm_up`.

`make setup` calls it last. It processes two short simulated recordings in a temporary folder, one of points and one of
small pictures. A second process meanwhile compiles the detection in pictures. Code that is compiled already is only
loaded.
"""

from __future__ import annotations

import multiprocessing
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from geometry.compiled_linalg import pose_minus, pose_plus, posterior, solve
from lab.runs.process import process_run
from lab.simulate.write import simulate

SCENARIO = "huo2015"
FRAMES = 100  # of the points: with a bend, false points, a spot that leaves the picture, a long steady part
PICTURES = 6  # frames of the recording of pictures


def warm_up() -> float:
    """Process both recordings. Returns the time taken, s."""
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="beampose-") as name:
        folder = Path(name)
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as other:
            algebra = other.submit(_linear_algebra)
            pictures = simulate(SCENARIO, folder / "pictures", frames=PICTURES, scale=0.5)
            # The spots' own tracker: it shares only detection and smoothing with the one that this process compiles.
            detecting = other.submit(process_run, pictures, folder / "out-of-other", overrides={"method": "spots"})
            points = simulate(SCENARIO, folder / "points", frames=FRAMES, points=True)
            process_run(points, folder / "out")
            algebra.result()
            detecting.result()
        process_run(pictures, folder / "out")
        _linear_algebra()  # loads it here: Python calls some of it in runs whose rig states errors of its calibration
    return time.perf_counter() - begun


def _linear_algebra() -> None:
    """What the tracker needs only later."""
    R, t = np.eye(3), np.zeros(3)
    pose_minus(R, t, R, t)
    pose_plus(R, t, np.zeros(6))
    posterior(np.eye(6), np.eye(6))
    solve(np.eye(6), np.zeros((6, 7)))


if __name__ == "__main__":
    print(f"Compiled code is ready ({warm_up():.0f} s).", file=sys.stderr)
