"""Pose errors over their sigmas where errors of the spots repeat from frame to frame: slow motion, several lights.

`python -m bench.place_errors [--lights quiet,narrow] [--speeds 0,1] [--rigs fan] [--seeds 0:4] [--jobs 2]` prints, for
each light and speed, NEES/6 of the smoothed and of the causal poses: the mean over rigs and seeds, and in brackets
that of the worst rig. 1 is expected. A vehicle at rest shows one error per recording, so that the mean over n
recordings scatters by sqrt(2 / (6 n)).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from types import MappingProxyType

import numpy as np

from bench.random_scenes.processes import results_of
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Beam, Rig, Screen, Spot
from lab.files.rig.rig_file import save_rig
from lab.files.run.results import read_summary
from lab.runs.process import process_run
from lab.simulate.scenarios import LIGHTS, RIGS, SCENARIOS, Clutter, Light, Motion, lab_camera, scaled
from lab.simulate.scene import draw_motion
from lab.simulate.write import simulate

FRAMES = 60
SPEEDS_PX = (0.0, 0.1, 0.5, 1.0, 3.0)  # per frame, median of the views
SCALE = 0.5  # of the pictures: 640 x 512
_SHORT_S = 1e-4
WIDE_M = 0.022  # 1/e^2 radius of the beams: with this scale spots of 1.6 px
_PLACE_LIGHTS = {
    **{name: replace(LIGHTS[name], beam_radius_m=WIDE_M) for name in ("clean", "lab", "quiet", "deep")},
    "textured": replace(LIGHTS["clean"], beam_radius_m=WIDE_M, texture=0.04),
    "narrow": replace(LIGHTS["clean"], beam_radius_m=0.008, blur_px=0.45),
}
PLACE_LIGHTS: MappingProxyType[str, Light] = MappingProxyType(_PLACE_LIGHTS)


def wall_and_ceiling() -> Rig:
    """Three beams to a wall in front and three to the ceiling, each screen observed by one camera."""
    wall = Pose.from_quaternion(np.array([0.5, 0.5, 0.5, 0.5]), np.array([3.0, 0.0, 0.0]))
    screens = {"wall": Screen("wall", wall), "ceiling": Screen("ceiling", Pose(np.eye(3), np.array([0.0, 0.0, 2.5])))}
    cameras = {
        "wall": lab_camera("wall", "wall", (-1.2, -0.6, 1.0), (3.0, 0.0, 0.1)),
        "ceiling": lab_camera("ceiling", "ceiling", (-1.4, 0.8, -1.2), (0.2, 0.0, 2.5)),
    }
    to_wall, up = np.deg2rad([-17.0, 1.0, 20.0]), [(-0.3, 0.1), (0.05, 0.3), (0.3, -0.25)]
    directions = [[np.cos(a), np.sin(a), 0.05 * i] for i, a in enumerate(to_wall)] + [[x, y, 1.0] for x, y in up]
    beams, spots = {}, {}
    for i, direction in enumerate(directions):
        name = "ABCDEF"[i]
        beams[name] = Beam(name, np.array(direction), np.array([0.02 * i, 0.01 * i, 0.03]))
        spots[str(i + 1)] = Spot(str(i + 1), name, 1, "wall" if i < 3 else "ceiling")
    return Rig(screens, cameras, beams, spots)


PLACE_RIGS = MappingProxyType({**RIGS, "wall-and-ceiling": wall_and_ceiling})


@dataclass(frozen=True, slots=True)
class Cell:
    """One recording."""

    light: str
    speed_px: float
    rig: str
    seed: int


@dataclass(frozen=True, slots=True)
class Outcome:
    """NEES/6 of one recording, and its verdict."""

    cell: Cell
    smoothed: float
    causal: float
    noise_scale: float
    place_share: float
    verdict: str


def recorded(cell: Cell, folder: Path) -> Path:
    """Write the pictures of a recording into a new folder."""
    rig = scaled(PLACE_RIGS[cell.rig](), SCALE)
    base = replace(SCENARIOS["small-motion"], light=PLACE_LIGHTS[cell.light], clutter=Clutter(per_spot=0.0), rig="fan")
    model = SpotModel.of(rig)
    motion = draw_motion(base, model, cell.seed)
    pixels = model.project(motion.pose(np.array([0.0, _SHORT_S])))[0]
    moved = float(np.nanmedian(np.linalg.norm(pixels[1] - pixels[0], axis=-1)))
    speed = moved / (_SHORT_S * base.frame_rate_hz)  # px per frame
    # A vehicle at rest stays at the first pose of that motion.
    motion = motion.faster(cell.speed_px / speed) if cell.speed_px else Motion(_pose_of(motion), ())
    scenario = replace(base, motion=motion, frames=FRAMES)
    with tempfile.TemporaryDirectory() as work:
        save_rig(rig, Path(work) / "rig.yaml")
        return simulate(scenario, folder, seed=cell.seed, rig=Path(work) / "rig.yaml", threads=1)


def _pose_of(motion: Motion) -> tuple[float, float, float, float, float, float]:
    """The middle of a motion that rests where this one starts."""
    q = motion.at(np.zeros(()))
    x, y, z, yaw, pitch, roll = (float(a) for a in np.concatenate([q[:3], np.rad2deg(q[3:])]))
    return x, y, z, yaw, pitch, roll


def run_cell(cell: Cell) -> Outcome:
    """Record and process one cell."""
    with tempfile.TemporaryDirectory() as work:
        run = recorded(cell, Path(work) / "run")
        process_run(run, Path(work) / "out")
        return outcome_of(cell, Path(work) / "out")


def outcome_of(cell: Cell, results: Path) -> Outcome:
    """The figures of processed pictures."""
    summary = read_summary(results)
    errors = summary["errors"]
    smoothed, causal = (errors[name]["measured"]["nees_mean"] / 6 for name in ("pose", "pose_causal"))
    return Outcome(
        cell, smoothed, causal, summary["rates"]["noise_scale"], summary["smoother"]["place_share"],
        summary["verdict"]["status"],
    )  # fmt: skip


def table(outcomes: Iterable[Outcome]) -> str:
    """A line per light and speed."""
    rows = list(outcomes)
    out = [f"{'light':10s} {'px/frame':>8s} {'smoothed (worst rig)':>22s} {'causal (worst rig)':>22s}   n  not passed"]
    for light, speed in dict.fromkeys((r.cell.light, r.cell.speed_px) for r in rows):
        some = [r for r in rows if (r.cell.light, r.cell.speed_px) == (light, speed)]
        rigs = list(dict.fromkeys(r.cell.rig for r in some))

        def text(name: str, some: list[Outcome] = some, rigs: list[str] = rigs) -> str:
            by_rig = {g: float(np.mean([getattr(r, name) for r in some if r.cell.rig == g])) for g in rigs}
            worst = max(by_rig, key=lambda g: abs(np.log(by_rig[g])))
            return f"{np.mean([getattr(r, name) for r in some]):6.2f} ({by_rig[worst]:.2f} {worst[:8]})"

        failed = sum(r.verdict != "pass" for r in some)
        out.append(f"{light:10s} {speed:8g} {text('smoothed'):>22s} {text('causal'):>22s} {len(some):3d}  {failed}")
    return "\n".join(out)


def main() -> None:
    """Measure the cells and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lights", default=",".join(PLACE_LIGHTS))
    parser.add_argument("--speeds", default=",".join(f"{s:g}" for s in SPEEDS_PX))
    parser.add_argument("--rigs", default=",".join(PLACE_RIGS))
    parser.add_argument("--seeds", default="0:4")
    parser.add_argument("--jobs", type=int, default=1)
    chosen = parser.parse_args()
    first, end = (int(x) for x in chosen.seeds.split(":"))
    cells = [
        Cell(light, speed, rig, seed)
        for light, speed, rig, seed in product(
            chosen.lights.split(","), map(float, chosen.speeds.split(",")), chosen.rigs.split(","), range(first, end)
        )
    ]
    start = time.perf_counter()
    print(table(list(results_of(run_cell, cells, chosen.jobs))))
    print(f"{len(cells)} recordings in {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
