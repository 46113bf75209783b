"""`python -m bench.random_scenes --seeds 1:301`: process random scenes and count the clean ones.

One scene in detail: `--seeds N -v`; `--keep DIR` writes its run folder. `--family NAME`: see families.py; `--variant
NAME`: see variants.py.

`--pictures`: scenes as pictures, including detection (bench/random_pictures; its families are in looks.py).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from bench.random_pictures.command import picture_jobs, run_pictures
from bench.random_pictures.looks import FAMILIES as PICTURE_FAMILIES
from bench.random_scenes.answers import answers_in_memory, answers_through_files
from bench.random_scenes.families import FAMILIES, family_scene
from bench.random_scenes.judge import Judgement, judge
from bench.random_scenes.oracle import ask_oracle
from bench.random_scenes.report import crashed, details, summary, write_rows
from bench.random_scenes.scene import Scene, random_scene
from bench.random_scenes.variants import CHANGES, varied
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


def run_all(jobs: list[Job], workers: int) -> Iterator[Judgement]:
    """The results in the order of the jobs."""
    if workers == 1:
        yield from map(judged, jobs)
        return
    with get_context("spawn").Pool(workers) as pool:
        yield from pool.imap(judged, jobs)


def seed_range(text: str) -> range:
    """A:B without B, or one seed."""
    first, _, last = text.partition(":")
    return range(int(first), int(last) if last else int(first) + 1)


def main() -> None:
    """Run the seeds and print the summary."""
    parser = argparse.ArgumentParser(prog="bench.random_scenes", description=__doc__)
    parser.add_argument("--seeds", type=seed_range, metavar="A:B", help="default 1:301, of pictures 1:61")
    parser.add_argument("--family", metavar="NAME", help="one difficulty instead of all at random")
    parser.add_argument("--variant", choices=list(CHANGES), help="a property that random scenes do not have")
    parser.add_argument("--pictures", action="store_true", help="render pictures; --family all: one of each per seed")
    parser.add_argument("--state-noise", action="store_true", help="of pictures: rig.yaml states the true noise")
    parser.add_argument("--frames", type=int, help="default 200, in pictures 48; each family has its own")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    parser.add_argument("--out", type=Path, help="a CSV file with a row per scene")
    parser.add_argument("--through-files", action="store_true", help="write run folders and process those")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="write each scene's run folder there")
    parser.add_argument("-v", "--verbose", action="store_true", help="all figures of every scene")
    a = parser.parse_args()
    known = ["all", *PICTURE_FAMILIES] if a.pictures else list(FAMILIES)
    if a.family is not None and a.family not in known:
        parser.error(f"--family: expected one of {', '.join(known)}; found {a.family}")
    if a.seeds is None:
        a.seeds = range(1, 61 if a.pictures else 301)
    if a.pictures:
        picture = picture_jobs(a.seeds, a.family, a.frames, a.keep, a.state_noise)
        run_pictures(picture, a.jobs, a.out, a.verbose)
        return
    jobs = [Job(s, a.frames, a.family, a.through_files, a.keep, a.variant) for s in a.seeds]
    rows: list[Judgement] = []
    for row in run_all(jobs, a.jobs):
        rows.append(row)
        if a.verbose:
            print(details(row), flush=True)
        elif sys.stderr.isatty():
            print(f"\r{len(rows)} of {len(jobs)}", end="", file=sys.stderr, flush=True)
    if a.out is not None:
        write_rows(rows, a.out)
    if a.family is not None:
        print(f"family {a.family}; goal: {FAMILIES[a.family].goal}")
    print(summary(rows))


if __name__ == "__main__":
    main()
