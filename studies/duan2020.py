"""`beampose study duan2020`: the filter of Duan (2020) as printed, corrected, and in beampose, on simulated targets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools
from lab.report.page import Section
from lab.report.plot.series import Line, Shade, time_panel
from lab.report.plot.svg import BLUE, GREEN, ORANGE, VERMILLION
from studies.comparison import Comparison, ComparisonRow
from tracking import kalman
from tracking.detections import Detections
from tracking.single_target.point_tracker import PointParameters, track_point

# Simulated targets for the filter of Duan (2020): the paper shows pictures of a tracked car, but no figure.
#
# The target moves like a car seen from above: white acceleration, one turn. Its centre is detected with noise. It is
# hidden for 8 and for 20 frames, and other detections appear at random places.

FRAMES, SIZE_PX = 300, (1280, 720)
NOISE_PX, SIGMA_A_PX = 0.5, 0.1  # px; px/frame^2
SPEED_PX = 3.0  # px/frame
HIDDEN = (range(100, 108), range(200, 220))
TURN = range(150, 170)  # a turn by 90 degrees
CLUTTER = 0.2  # probability of each of five false detections per frame
FILTERS = ("detections", "as printed", "corrected", "beampose")
_PARAMETERS = PointParameters(sigma_model_px=0.0)


@dataclass(frozen=True, slots=True)
class PointScene:
    """A simulated target of T frames."""

    uv_px: Array  # (T, 2) true centre
    found: list[Detections]  # the target's own detection is the first row, where there is one
    hidden: Bools  # (T,)


@dataclass(frozen=True, slots=True)
class TrackedScene:
    """What a filter makes of a scene."""

    uv_px: Array  # (T, 2); nan where there is no position
    P: Array  # (T, 2, 2) its covariance; nan where the filter has none
    right: Bools  # (T,) the target's own detection was used


def simulate(seed: int, number: int, clutter: bool) -> PointScene:
    """Scene `number` of a seed; with and without clutter the target and its detections are the same."""
    rng = np.random.default_rng([seed, number])
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(
        [np.pi / 2 / len(TURN) if k in TURN else 0.0 for k in range(FRAMES)]
    )
    jolts = np.cumsum(SIGMA_A_PX * rng.standard_normal((FRAMES, 2)), axis=0)
    velocity = SPEED_PX * np.stack([np.cos(heading), np.sin(heading)], -1) + 0.3 * jolts
    path = np.cumsum(velocity, axis=0)
    uv = path - path.mean(axis=0) + 0.5 * np.array(SIZE_PX)
    noisy = uv + NOISE_PX * rng.standard_normal((FRAMES, 2))
    hidden = np.isin(np.arange(FRAMES), [k for some in HIDDEN for k in some])
    found = []
    for k in range(FRAMES):
        false = rng.uniform((0, 0), SIZE_PX, (5, 2))[rng.random(5) < CLUTTER]
        places = np.concatenate(
            [noisy[k : k + 1] if not hidden[k] else np.zeros((0, 2)), false if clutter else false[:0]]
        )
        at = Detections.at(places, np.tile(NOISE_PX**2 * np.eye(2), (len(places), 1, 1)))
        flux = np.concatenate([np.full(len(places) - (len(false) if clutter else 0), 1000.0),
                               np.full(len(false) if clutter else 0, 500.0)])  # fmt: skip
        found.append(replace(at, flux=flux))
    return PointScene(uv, found, hidden)


def track(scene: PointScene, name: str) -> TrackedScene:
    """A scene through one of FILTERS. Raises KeyError for any other name."""
    return _FILTERS[name](scene)


def _detections(scene: PointScene) -> TrackedScene:
    """The brightest detection of each frame."""
    uv = np.array([f.uv_px[0] if len(f) else [np.nan, np.nan] for f in scene.found])
    P = np.where(np.isnan(uv[:, :1, None]), np.nan, NOISE_PX**2 * np.eye(2))
    return TrackedScene(uv, P, ~scene.hidden)


def _kalman(scene: PointScene, printed: bool) -> TrackedScene:
    """Eqs. (1) to (9) with the detection that is nearest to the prediction, without a gate.

    printed: eq. (5) as printed, P (1 - K H), read with the unit matrix; otherwise (I - K H) P.
    """
    T = len(scene.uv_px)
    uv, P_uv, right = np.full((T, 2), np.nan), np.full((T, 2, 2), np.nan), np.zeros(T, dtype=bool)
    first, second = (scene.found[k].uv_px[0] for k in (0, 1))
    R = NOISE_PX**2 * np.eye(2)
    x, P = kalman.restart(second, R, first, R, 1.0)
    uv[:2], P_uv[:2], right[:2] = (first, second), R, True
    H = np.eye(2, 4)
    for k in range(2, T):
        x, P = kalman.predict(x, P, 1.0, np.asarray(SIGMA_A_PX))
        places = scene.found[k].uv_px
        if len(places):
            row = int(np.argmin(np.linalg.norm(places - x[:2], axis=1)))
            right[k] = row == 0 and not scene.hidden[k]
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            x = x + K @ (places[row] - x[:2])
            P = P @ (np.eye(4) - K @ H) if printed else (np.eye(4) - K @ H) @ P
        uv[k], P_uv[k] = x[:2], P[:2, :2]
    return TrackedScene(uv, P_uv, right)


def _beampose(scene: PointScene) -> TrackedScene:
    steps = np.concatenate([[0.0], np.ones(len(scene.found) - 1)])
    estimates = track_point(steps, scene.found, _PARAMETERS)
    return TrackedScene(
        np.array([e.x[:2] for e in estimates]),
        np.array([e.P[:2, :2] for e in estimates]),
        np.array([e.row == 0 for e in estimates]) & ~scene.hidden,
    )


_FILTERS: dict[str, Callable[[PointScene], TrackedScene]] = {
    "detections": _detections,
    "as printed": lambda scene: _kalman(scene, printed=True),
    "corrected": lambda scene: _kalman(scene, printed=False),
    "beampose": _beampose,
}


# Duan (2020): the filter as printed, corrected, and the tracker of `beampose track point`, on simulated targets.


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


def _curves(seed: int) -> tuple[Section, ...]:
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
            Section(
                f"Errors {'with' if clutter else 'without'} false detections",
                "Green: detections. Orange: as printed. Blue: corrected. Red: beampose. Yellow: hidden; blue: the turn."
                + (
                    " Without a gate the nearest false detection takes the track as soon as the target is hidden."
                    if clutter
                    else " The printed covariance is not symmetric and its gain is wrong after a hidden interval."
                ),
                panels,
            )
        )
    return tuple(out)
