"""Cases of commands that read results (compare, verify, report, view, a batch that continues), and answers to init."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

from bench.fuzz.hostile import OPTION_VALUES
from bench.fuzz.inputs import HAS_PYARROW
from bench.fuzz.mutations import damage_file

_TABLES = ("attitude.csv", "spots.csv", "covariance.csv", "frames.csv", "summary.json", "rig.yaml")


def reference(work: Path, base: Path, rng: random.Random) -> list[str]:
    """A comparison with a damaged reference, as a CSV table or a TUM file."""
    name = rng.choice(("reference.csv", "reference.tum"))
    shutil.copy(base / name, work / name)
    damage_file(work / name, rng)
    return ["compare", str(base / "results"), "--reference", str(work / name), *_out(work, rng), *_options(rng, 0.3)]


def two_results(work: Path, base: Path, rng: random.Random) -> list[str]:
    """A comparison of results with damaged ones."""
    shutil.copytree(base / "results", work / "in")
    _damage_a_table(work / "in", rng)
    first, second = rng.sample([str(base / "results"), str(work / "in")], 2)
    return ["compare", first, second, *_out(work, rng), *_options(rng, 0.2)]


def compare_options(work: Path, base: Path, rng: random.Random) -> list[str]:
    """Options of compare."""
    return ["compare", str(base / "results"), "--reference", str(base / "reference.csv"), *_options(rng, 1.0)]


def results(work: Path, base: Path, rng: random.Random) -> list[str]:
    """Damaged results, reported again or verified."""
    shutil.copytree(base / "results", work / "in")
    _damage_a_table(work / "in", rng)
    return [rng.choice(("report", "verify", "verify", "doctor")), str(work / "in")]


def view(work: Path, base: Path, rng: random.Random) -> list[str]:
    """Damaged results in three dimensions."""
    shutil.copytree(base / "results", work / "in")
    _damage_a_table(work / "in", rng)
    return ["view", str(work / "in"), "--out", str(work / "out"), *rng.choice(([], ["--frame", "3"]))]


def continued_batch(work: Path, base: Path, rng: random.Random) -> list[str]:
    """A batch that continues in a damaged output folder, with Parquet data sets; or a damaged list of runs."""
    shutil.copytree(base / "batch", work / "out")
    if rng.random() < 0.3:
        (work / "runs.txt").write_text(f"{base / 'points'}\n{base / 'points'}/\n# remark\n")
        damage_file(work / "runs.txt", rng)
        return ["batch", "--list", str(work / "runs.txt"), "--out", str(work / "out")]
    files = [p for p in sorted((work / "out").rglob("*")) if p.is_file() and not p.is_symlink()]
    damage_file(rng.choice([*files, work / "out" / "batch.csv"]), rng)
    options = rng.choice(([], ["--parquet"] if HAS_PYARROW else []))
    return ["batch", str(base / "points"), "--out", str(work / "out"), *options]


def init_answers(work: Path, base: Path, rng: random.Random) -> list[str]:
    """Answers to init, as options."""
    numbers = ("1", "2", "3", "4", "5", "8", "12", "16")
    options = []
    for option in ("--screens", "--cameras", "--beams", "--rate", "--distance", "--picture"):
        if rng.random() < 0.4:
            value = rng.choice(numbers) if rng.random() < 0.6 else rng.choice(OPTION_VALUES)
            if option == "--picture" and rng.random() < 0.8:
                value = f"{rng.choice((*numbers, '64', '640', '99999'))}x{rng.choice(('16', '48', '480', '99999', ''))}"
            options.append(f"{option}={value}")
    return ["init", str(work / "out"), *options]


def _damage_a_table(folder: Path, rng: random.Random) -> None:
    files = [p for p in sorted(folder.iterdir()) if p.is_file() and p.suffix != ".html"]
    named = [folder / name for name in _TABLES if (folder / name).is_file()]
    damage_file(rng.choice(named * 2 + files), rng)


def _out(work: Path, rng: random.Random) -> list[str]:
    return ["--out", str(work / "out")] if rng.random() < 0.5 else []


def _options(rng: random.Random, share: float) -> list[str]:
    """Options of compare, with a probability; `--name=value`, since values may begin with a dash."""
    if rng.random() >= share:
        return []
    option = rng.choice(("--align", "--offset", "--sigma-m", "--sigma-deg"))
    values = ("all", "none", "time", "time,rate", "world", "body", "rate", ",", "time,,", "time,time")
    return [f"{option}={rng.choice(values if option == '--align' and rng.random() < 0.7 else OPTION_VALUES)}"]
