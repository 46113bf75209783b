"""Noise models estimated from pictures, compared with the true sensors: `python -m bench.noise_models --scenes 200`.

Each scene of bench/random_pictures gives the pictures of one camera with a constant background and moving spots, at the
frames that a run uses. The figure is estimated over true variance, at the level of the background and at half of full
scale. The truth is measured on exposures of flat fields, including saturation, rounding and compression.
"""

from __future__ import annotations

import argparse
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from bench.random_pictures.adapter import model_of_pictures
from bench.random_pictures.judge import compared
from bench.random_pictures.looks import FAMILIES
from bench.random_pictures.render import Renderer
from bench.random_pictures.report import within
from bench.random_pictures.scene import picture_scene
from bench.random_scenes.processes import shown_results

AT_BACKGROUND, AT_HALF = 1.3, 2.0  # the goals: within these factors
WORST = 15


@dataclass(frozen=True, slots=True)
class Row:
    """The model of one camera."""

    seed: int
    family: str
    background: float  # estimated / true variance; nan after an exception
    half: float
    level_dn: float  # of the background
    estimate_s: float  # process time, without rendering
    text: str
    error: str = ""

    @property
    def off(self) -> float:
        """The error in units of the goals on a logarithmic scale; inf after an exception."""
        if self.error:
            return np.inf
        return float(
            max(abs(np.log(self.background)) / np.log(AT_BACKGROUND), abs(np.log(self.half)) / np.log(AT_HALF))
        )


@dataclass(frozen=True, slots=True)
class Job:
    """One scene."""

    seed: int
    family: str | None


def measured(job: Job) -> Row:
    """The estimate of one scene; the camera alternates with the seed."""
    cv2.setNumThreads(1)
    renderer = Renderer(picture_scene(job.seed, job.family))
    ps = renderer.ps
    c = job.seed % len(renderer.still)
    name = list(ps.scene.rig.cameras)[c]
    frames = [int(k) for k in np.flatnonzero(ps.scene.has_image[:, c])]
    spent = 0.0

    def picture(k: int) -> np.ndarray:
        nonlocal spent
        start = time.process_time()
        made = renderer.picture(frames[k], c)
        spent += time.process_time() - start
        return made

    start = time.process_time()
    try:
        model = model_of_pictures(len(frames), picture)
    except Exception:
        error = traceback.format_exc().strip().splitlines()[-1]
        return Row(job.seed, job.family or "mixed", np.nan, np.nan, np.nan, np.nan, ps.look.text, error)
    took = time.process_time() - start - spent
    figures = compared(renderer, c, name, model)
    return Row(
        job.seed, job.family or "mixed", figures.background, figures.half, figures.background_dn, took, ps.look.text
    )


def line(row: Row) -> str:
    """One line for a scene."""
    if row.error:
        return f"{row.family} {row.seed}: {row.error} | {row.text}"
    return f"{row.family} {row.seed}: background {row.background:.3g}, half {row.half:.3g} | {row.text}"


def summary(rows: Sequence[Row]) -> str:
    """Distributions, shares within the goals, and the worst seeds."""
    good = [r for r in rows if not r.error]
    out = [f"{len(rows)} sensors and scenes; exceptions: {len(rows) - len(good)}"]
    out += [f"  {count} x {error}" for error, count in Counter(r.error for r in rows if r.error).items()]
    for what, goal in (("background", AT_BACKGROUND), ("half", AT_HALF)):
        ratios = np.array([getattr(r, what) for r in good])
        if not ratios.size:
            continue
        quantiles = ", ".join(
            f"{q:.0%} {x:.3g}" for q, x in zip((0, 0.05, 0.25, 0.5, 0.75, 0.95, 1),
                                               np.quantile(ratios, (0, 0.05, 0.25, 0.5, 0.75, 0.95, 1)), strict=True)
        )  # fmt: skip
        out.append(f"estimated / true variance, {what}: {quantiles}")
        shares = ", ".join(f"{f} x {within(ratios, f):.1%}" for f in (1.3, 2.0, 10.0))
        out.append(f"  within {shares}; goal: all within {goal} x")
    seconds = [r.estimate_s for r in good]
    if seconds:
        out.append(f"process time of an estimate: median {np.median(seconds) * 1e3:.0f} ms, at most"
                   f" {np.max(seconds) * 1e3:.0f} ms")  # fmt: skip
    families = list(dict.fromkeys(r.family for r in good))
    if len(families) > 1:
        for name in families:
            mine = [r for r in good if r.family == name]
            b, h = np.array([r.background for r in mine]), np.array([r.half for r in mine])
            out.append(
                f"  {name:20} n {len(mine):3}; background median {np.median(b):.3g}, within {AT_BACKGROUND} x"
                f" {within(b, AT_BACKGROUND):.0%}; half {np.median(h):.3g}, within {AT_HALF} x {within(h, AT_HALF):.0%}"
            )
    out.append("worst:")
    out += [f"  {line(r)}" for r in sorted(rows, key=lambda r: -r.off)[:WORST]]
    return "\n".join(out)


def main() -> None:
    """Run the scenes and print the summary."""
    parser = argparse.ArgumentParser(prog="bench.noise_models", description=__doc__)
    parser.add_argument("--scenes", type=int, default=200, help="default 200")
    parser.add_argument("--first", type=int, default=1, metavar="SEED", help="default 1")
    parser.add_argument("--family", choices=["all", *FAMILIES], help="one family (all: in turn) instead of mixed ones")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    parser.add_argument("-v", "--verbose", action="store_true", help="a line per scene")
    a = parser.parse_args()
    names = [None] if a.family is None else list(FAMILIES) if a.family == "all" else [a.family]
    jobs = [Job(a.first + i, names[i % len(names)]) for i in range(a.scenes)]
    print(summary(shown_results(measured, jobs, a.jobs, line if a.verbose else None)))


if __name__ == "__main__":
    main()
