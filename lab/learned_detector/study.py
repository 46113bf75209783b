"""Rows of `beampose study zhou2020` on the learned detector."""

from __future__ import annotations

import numpy as np

from lab.learned_detector.samples import draw_sample
from lab.study.comparison import ComparisonRow
from tracking.learned_detector.detector import find_drogues

FRAMES = 60
SIZE_PX, DIAMETERS_PX = (640, 480), (9.0, 200.0)
_RIGHT = 0.25  # of the diameter


def detector_rows(seed: int, columns: int = 1) -> tuple[ComparisonRow, ...]:
    """Share of rendered drogues that are the best candidate, and the error of their centre, before unseen backgrounds.

    columns: number of methods of the study; the figures stand in the last one.
    """
    rng = np.random.default_rng([seed, 42])
    errors = []
    for _ in range(FRAMES):
        sample = draw_sample(rng, SIZE_PX, DIAMETERS_PX, unseen=True, empty=False)
        best = next(iter(find_drogues(sample.image, *DIAMETERS_PX)), None)
        away = np.inf if best is None else np.hypot(best.u_px - sample.centre_px[0], best.v_px - sample.centre_px[1])
        errors.append(away / sample.diameter_px)
    error = np.array(errors)
    found = error < _RIGHT
    note = f"{FRAMES} rendered pictures, diameter 9 to 200 px, backgrounds that training does not show"
    empty = (None,) * (columns - 1)
    return (
        ComparisonRow("learned detector: found first", "%", None, (*empty, 100 * float(found.mean())), note),
        ComparisonRow(
            "learned detector: centre, median error over the diameter", "%", None,
            (*empty, 100 * float(np.median(error[found])) if found.any() else None), note,
        ),
    )  # fmt: skip
