"""Draw, run and score scenes of points, for `python -m bench.random_scenes`."""

from __future__ import annotations

import tempfile
import traceback
from dataclasses import dataclass
from pathlib import Path

from bench.random_scenes.answers import answers_in_memory, answers_through_files
from bench.random_scenes.families import family_scene
from bench.random_scenes.judge import Judgement, judge
from bench.random_scenes.oracle import ask_oracle
from bench.random_scenes.report import crashed
from bench.random_scenes.scene import Scene, random_scene
from bench.random_scenes.variants import varied
from bench.random_scenes.write_folder import write_run_folder


@dataclass(frozen=True, slots=True)
class Job:
    """One scene to run."""

    seed: int
    frames: int | None
    family: str | None
    through_files: bool
    keep: Path | None
    variant: str | None = None


def make_scene(job: Job) -> Scene:
    """The scene of a job."""
    if job.family is not None:
        return family_scene(job.family, job.seed, job.frames)
    scene = random_scene(job.seed) if job.frames is None else random_scene(job.seed, job.frames)
    return scene if job.variant is None else varied(scene, job.variant)


def judged(job: Job) -> Judgement:
    """Draw, run and score one scene; an exception of the program counts as a class of failure."""
    scene = make_scene(job)
    if job.keep is not None:
        write_run_folder(scene, job.keep / f"seed-{job.seed}")
    oracle = ask_oracle(scene)
    try:
        if job.through_files:
            with tempfile.TemporaryDirectory() as name:
                answers = answers_through_files(scene, write_run_folder(scene, Path(name) / "run"))
        else:
            answers = answers_in_memory(scene)
    except Exception:
        return crashed(scene, oracle, traceback.format_exc())
    return judge(scene, oracle, answers)
