"""Accuracy, tracked share and cost of the circle tracker (Zhou 2014).

python -m bench.related_measurements.circle stills SEED COUNT     errors of stills, COUNT of each hidden share
python -m bench.related_measurements.circle hidden SEED COUNT     eight fully hidden frames, COUNT runs
python -m bench.related_measurements.circle lights SEED FRAMES    rendered approach in three lights
python -m bench.related_measurements.circle cost SEED             process time against cv2.HoughCircles
python -m bench.related_measurements.circle real FOLDER           circles of real pictures, for a table
"""

from __future__ import annotations

import sys
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from studies.zhou2014 import HIDDEN, PAPER_PERCENT, approach, cost_ratio, followed, hidden_run, still_errors
from tracking.drogue_circle.detectors import CircleParameters, classical_detector
from tracking.drogue_circle.tracker import Wanted, acquire


def stills(seed: int, count: int) -> None:
    """Median errors and NEES of stills."""
    errors = still_errors(seed, count)
    for method in ("opencv", "printed", "ours"):
        medians = ", ".join(f"{100 * h:g} % hidden {errors.median(method, h):.3f}" for h in HIDDEN)
        all_px, lost = errors.median(method), errors.failures(method)
        print(f"{method}: median error {all_px:.3f} px ({medians}); not within 8 px: {100 * lost:.1f} %")
    for hidden in HIDDEN:
        own = errors.hidden == hidden
        centre, circle = np.nanmean(errors.nees_centre[own]) / 2, np.nanmean(errors.nees[own]) / 3
        print(f"NEES at {100 * hidden:g} % hidden: centre / 2 {centre:.2f}, circle / 3 {circle:.2f}")


def hidden(seed: int, count: int) -> None:
    """Largest errors during eight fully hidden frames."""
    runs = [hidden_run(1000 * seed + k) for k in range(count)]
    for name in ("printed_px", "ours_px"):
        largest = np.array([run.largest(getattr(run, name)) for run in runs])
        print(
            f"{name}: median {np.median(largest):.2f}, 95 % {np.percentile(largest, 95):.2f}, largest"
            f" {largest.max():.2f} px; within 2 px: {100 * np.mean(largest <= 2):.0f} %"
        )


def lights(seed: int, frames: int) -> None:
    """Tracked share of an approach in each light."""
    for light, paper in PAPER_PERCENT.items():
        for form, r in zip(("sound", "printed"), followed(seed, light, frames), strict=True):
            print(
                f"{light}, {form}: tracked {r.percent:.2f} % (paper {paper}), measured"
                f" {100 * r.measured / r.frames:.2f} %, median error {np.median(r.errors_px):.3f} px,"
                f" 95 % {np.percentile(r.errors_px, 95):.3f} px"
            )


def cost(seed: int) -> None:
    """Process time of a frame of 1280 x 1024 px: a ring on a smooth background, and a rendered drogue."""
    ours, opencv = cost_ratio(seed)
    print(f"ring: beampose {ours:.2f} ms, HoughCircles {opencv:.2f} ms, ratio {ours / opencv:.3f}")
    drawn = [f.picture for f in islice(approach(seed, "overcast", 1000, scale=2), 28)]
    ours, opencv = cost_ratio(seed, drawn)
    print(f"drogue: beampose {ours:.2f} ms, HoughCircles {opencv:.2f} ms, ratio {ours / opencv:.3f}")


def real(folder: Path) -> None:
    """All circles of the pictures of a folder; whether the choice of one is clear."""
    parameters = CircleParameters()
    for path in sorted(p for p in folder.iterdir() if p.suffix in (".png", ".jpg")):
        picture = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
        search = acquire(picture, classical_detector(parameters), parameters, Wanted())
        print(f"{path.name}: {len(search.circles)} circles, {'one is clear' if search.found else 'ambiguous'}")
        for c in search.circles:
            sigma = np.sqrt(np.diag(c.covariance_px2))
            u, v, radius = c.centre_and_radius
            print(f"  {u:.2f} {v:.2f} r {radius:.2f} sigma {sigma[0]:.3f} {sigma[1]:.3f} coverage {c.coverage:.2f}")


if __name__ == "__main__":
    what, *rest = sys.argv[1:] or [""]
    if what == "real" and len(rest) == 1:
        real(Path(rest[0]))
    elif what in ("stills", "hidden", "lights") and len(rest) == 2:
        {"stills": stills, "hidden": hidden, "lights": lights}[what](int(rest[0]), int(rest[1]))
    elif what == "cost" and len(rest) == 1:
        cost(int(rest[0]))
    else:
        sys.exit(__doc__)
