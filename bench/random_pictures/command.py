"""Draw, render, run and score scenes in pictures, for `python -m bench.random_scenes --pictures`."""

from __future__ import annotations

import tempfile
import time
import traceback
from dataclasses import dataclass
from pathlib import Path

import cv2

from bench.random_pictures.judge import PictureJudgement, counted_pairs, judge
from bench.random_pictures.looks import FAMILIES
from bench.random_pictures.render import Renderer
from bench.random_pictures.report import crashed, details, summary, write_rows
from bench.random_pictures.scene import picture_scene
from bench.random_pictures.surroundings import photographs
from bench.random_pictures.write_folder import write_pictures
from bench.random_scenes.processes import shown_results
from lab.errors import BeamposeError
from lab.runs.process import process_run


@dataclass(frozen=True, slots=True)
class PictureJob:
    """One scene to run."""

    seed: int
    family: str | None
    frames: int | None
    keep: Path | None  # folder for its run folder and its results
    state_noise: bool  # the true noise is stated in rig.yaml, for diagnosis only


def judged(job: PictureJob) -> PictureJudgement:
    """Run and score one scene; an exception of the program counts as a class of failure."""
    cv2.setNumThreads(1)
    start = time.process_time()
    renderer = Renderer(picture_scene(job.seed, job.family, job.frames))
    with tempfile.TemporaryDirectory() as name:
        place = Path(name) if job.keep is None else job.keep / f"{job.family or 'mixed'}-{job.seed}"
        folder = write_pictures(renderer, place / "run", job.state_noise)
        rendered = time.process_time()
        try:
            outcome = process_run(folder, place / "out")
        except Exception as error:
            plain = isinstance(error, BeamposeError)
            trace = f"{type(error).__name__}: {error}" if plain else traceback.format_exc()
            return crashed(renderer, int(counted_pairs(renderer).sum()), trace)
        ran = time.process_time()
        return judge(renderer, place / "out", outcome.exit_status, (rendered - start, ran - rendered))


def picture_jobs(
    seeds: range, family: str | None, frames: int | None, keep: Path | None, state_noise: bool
) -> list[PictureJob]:
    """One scene per seed; family `all`: one of each family per seed."""
    names = [None] if family is None else [family]
    if family == "all":  # without the photographs where they are not at hand
        names = [name for name in FAMILIES if name != "photographs" or photographs()]
    return [PictureJob(s, n, frames, keep, state_noise) for s in seeds for n in names]


def run_pictures(jobs: list[PictureJob], workers: int, out: Path | None, verbose: bool) -> None:
    """Run the scenes and print the summary; out: a CSV file with a row per scene."""
    rows = shown_results(judged, jobs, workers, details if verbose else None)
    if out is not None:
        write_rows(rows, out)
    print(summary(rows))
