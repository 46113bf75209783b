"""Duan (2020): the filter as printed, corrected, and the tracker of `beampose track point`, on simulated targets."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools
from lab.report.plot.series import Line, Shade, time_panel
from lab.report.plot.svg import BLUE, GREEN, ORANGE, VERMILLION
from lab.single_target.experiment_duan2020 import (
    CLUTTER,
    FILTERS,
    FRAMES,
    HIDDEN,
    NOISE_PX,
    TURN,
    PointScene,
    TrackedScene,
    simulate,
    track,
)
from lab.study.comparison import Comparison, ComparisonRow, Figure

SCENES = 20
START_FRAMES = 5
COLOURS = {"detections": GREEN, "as printed": ORANGE, "corrected": BLUE, "beampose": VERMILLION}
# Quantity, unit, note; in the order of `figures_of`.
QUANTITIES = (
    ("RMS error in view", "px", "per coordinate, without the first frames"),
    ("largest error in the turn", "px", "a turn of 90 degrees in 20 frames"),
    ("largest error, 8 hidden frames", "px", ""),
    ("largest error, 20 hidden frames", "px", ""),
    ("own detection used", "%", "of the frames in which the target is in view"),
    ("NEES per coordinate", "", "squared errors in units of the stated variances; 1 for correct covariances"),
)


def compare_duan2020(seed: int = 1, scenes: int = SCENES) -> Comparison:
    """The table and the figures; the seed determines the result. The paper has no figure to compare with."""
    rows = []
    for clutter in (False, True):
        of: dict[str, list[list[float]]] = {name: [] for name in FILTERS}
        for number in range(scenes):
            scene = simulate(seed, number, clutter)
            for name in FILTERS:
                of[name].append(figures_of(scene, track(scene, name)))
        middle = {name: np.median(np.where(np.isfinite(v), v, np.inf), axis=0) for name, v in of.items()}
        for i, (quantity, unit, note) in enumerate(QUANTITIES):
            values = tuple(float(v[i]) if np.isfinite(v[i]) else None for v in middle.values())
            title = f"{quantity}, {'with' if clutter else 'without'} false detections"
            rows.append(ComparisonRow(title, unit, None, values, note))
    return Comparison(
        title="Duan, Yuan, Wang & Huangfu (2020)",
        setting=f"{scenes} scenes of {FRAMES} frames · {NOISE_PX:g} px noise · hidden for {len(HIDDEN[0])} and"
        f" {len(HIDDEN[1])} frames · seed {seed}",
        methods=FILTERS,
        rows=tuple(rows),
        explanation="Detections: the brightest one of each frame, without a filter. As printed: eqs. (1) to (9), with"
        " P (1 - K H) in eq. (5) and the detection that is nearest to the prediction. Corrected: the same with"
        " (I - K H) P. Both get the true noise and acceleration. Beampose: the command “track point”, which has a gate,"
        " estimates the acceleration, and waits for three detections that agree. Values are medians over the scenes."
        f" False detections: {5 * CLUTTER:g} per frame on average, half as bright as the target. The paper shows"
        " pictures of a tracked car and states no figure.",
        figures=_curves(seed),
        source="H. Duan, T. Yuan, Y. Wang, P. Huangfu, Intelligent Computer and Applications 10(10), 92 (2020).",
    )


def figures_of(scene: PointScene, tracked: TrackedScene) -> list[float]:
    """The QUANTITIES of a scene; nan where there is no position."""
    difference = tracked.uv_px - scene.uv_px
    error = np.linalg.norm(difference, axis=1)
    view = ~scene.hidden
    view[:START_FRAMES] = False
    known = view & np.isfinite(error)
    inverse = np.linalg.inv(tracked.P[known])
    nees = np.einsum("ni,nij,nj->n", difference[known], inverse, difference[known]) / 2
    return [
        float(np.sqrt(np.mean(error[known] ** 2) / 2)),
        _largest(error, _frames(TURN)),
        *(_largest(error, _frames(some)) for some in HIDDEN),
        100 * float(np.mean(tracked.right[view])),
        float(np.mean(nees)),
    ]


def _frames(some: range) -> Bools:
    return np.isin(np.arange(FRAMES), list(some))


def _largest(error: Array, where: Bools) -> float:
    values = error[where & np.isfinite(error)]
    return float(values.max()) if values.size else float("nan")


def _curves(seed: int) -> tuple[Figure, ...]:
    out = []
    for clutter in (False, True):
        scene = simulate(seed, 0, clutter)
        frames = np.arange(FRAMES, dtype=float)
        shades = (Shade(scene.hidden, "predicted", "hidden"), Shade(_frames(TURN), "outside", "turn"))
        panels = []
        for axis in (0, 1):
            errors = {name: (track(scene, name).uv_px - scene.uv_px)[:, axis] for name in FILTERS}
            lines = tuple(Line(errors[name], COLOURS[name], name) for name in FILTERS)
            title = f"{'uv'[axis]}: estimate − true"
            panels.append(
                time_panel(frames, title, "px", lines=lines, shades=shades, y_range=(-8.0, 8.0), time_name="frame")
            )
        out.append(
            Figure(
                f"Errors {'with' if clutter else 'without'} false detections",
                "Green: detections. Orange: as printed. Blue: corrected. Red: beampose. Yellow: hidden; blue: the turn."
                + (
                    " Without a gate the nearest false detection takes the track as soon as the target is hidden."
                    if clutter
                    else " The printed covariance is not symmetric and its gain is wrong after a hidden interval."
                ),
                "".join(panels),
            )
        )
    return tuple(out)
