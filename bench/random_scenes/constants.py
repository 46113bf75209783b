"""Which constants of the tracking matter: `python -m bench.random_scenes.constants [--sample 40] [--seed 1]`.

A constant is a number with a decimal point that a module of tracking/ assigns to a name in capitals. Of a sample of
them, each is multiplied by 2 or 1/2 in a copy of the program, which then processes the same recordings as the
unchanged copy: one scene of each family of points and of pictures. Per constant:
whether a table changed, how the errors changed (ratio of the RMS of the position and of the attitude, geometric mean
over the recordings), NEES/6, measured poses, wrong labels and verdicts.

A constant that changes nothing is one of a rare case, or one that could go: look at it. A changed folder with compiled
functions is compiled again, so that one constant takes 10 s to 2 min of process time.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.random_pictures.command import picture_jobs
from bench.random_pictures.render import Renderer
from bench.random_pictures.scene import picture_scene
from bench.random_pictures.write_folder import write_pictures
from bench.random_scenes.families import FAMILIES as POINT_FAMILIES
from bench.random_scenes.families import family_scene
from bench.random_scenes.write_folder import write_run_folder
from lab.errors import BeamposeError
from lab.runs.process import process_run

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("background", "detection", "labelling", "noise_estimation", "rigid_body", "smoothing")
PACKAGES = ("geometry", "tracking", "calibration", "lab")
POINTS, PICTURES = 71000, 23000  # seeds of the recordings
TABLES = ("attitude.csv", "spots.csv", "attitude_causal.csv")


@dataclass(frozen=True, slots=True)
class Constant:
    """A number in the source: its file, its name, where its digits are, and its value."""

    file: Path
    name: str
    line: int
    columns: tuple[int, int]
    value: float

    def changed(self, source: str, factor: float) -> str:
        """The source with the number multiplied."""
        lines = source.splitlines(keepends=True)
        text, (a, b) = lines[self.line - 1], self.columns
        lines[self.line - 1] = f"{text[:a]}{self.value * factor!r}{text[b:]}"
        return "".join(lines)


def constants(folders: tuple[str, ...]) -> list[Constant]:
    """All constants of the folders of tracking/, in the order of the files."""
    found = []
    for file in sorted(f for folder in folders for f in (ROOT / "tracking" / folder).rglob("*.py")):
        for node in ast.parse(file.read_text()).body:
            if not isinstance(node, ast.Assign):
                continue
            names = [n.id for target in node.targets for n in ast.walk(target) if isinstance(n, ast.Name)]
            if not names or not all(name.isupper() for name in names):
                continue
            name = "/".join(names)
            found += [
                Constant(file.relative_to(ROOT), name, n.lineno, (n.col_offset, n.end_col_offset or 0), n.value)
                for n in ast.walk(node.value)
                if isinstance(n, ast.Constant) and isinstance(n.value, float) and n.value
            ]
    return found


def recordings(place: Path) -> list[Path]:
    """Write the recordings that all copies process: of each family of points and of pictures one."""
    points = [write_run_folder(family_scene(name, POINTS, None), place / f"points-{name}") for name in POINT_FAMILIES]
    pictures = picture_jobs(range(PICTURES, PICTURES + 1), "all", 24, None, False)
    return points + [
        write_pictures(Renderer(picture_scene(job.seed, job.family, job.frames)), place / f"pictures-{job.family}")
        for job in pictures
    ]


def process(runs: list[Path]) -> list[dict]:
    """Process the runs with the code of this process, and what came of each."""
    rows: list[dict] = []
    with tempfile.TemporaryDirectory(prefix="beampose-") as name:
        for k, run in enumerate(runs):
            out = Path(name) / str(k)
            try:
                status = process_run(run, out).exit_status
            except BeamposeError as error:
                rows.append({"refused": str(error)})
                continue
            summary = json.loads((out / "summary.json").read_text())
            errors = summary["errors"]
            pose = (errors.get("pose") or {}).get("measured") or {}
            tables = b"".join((out / t).read_bytes() for t in TABLES if (out / t).is_file())
            rows.append({
                "status": status,
                "tables": hashlib.sha256(tables).hexdigest(),
                "measured": summary["counts"]["pose_status"].get("measured", 0),
                "wrong": (errors.get("spots") or {}).get("wrong_labels", 0),
                "position": (pose.get("position_m") or {}).get("rms"),
                "rotation": (pose.get("rotation_deg") or {}).get("rms"),
                "nees": pose.get("nees_mean"),
            })  # fmt: skip
    return rows


def processed_by(copy: Path, runs: list[Path]) -> list[dict] | str:
    """As `process` with the code of a copy; where it cannot run, the last line of what it says."""
    done = subprocess.run(
        [sys.executable, "-m", "bench.random_scenes.constants", "--process", *map(str, runs)],
        cwd=copy, env={**os.environ, "PYTHONPATH": str(copy)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        return (done.stderr.strip().splitlines() or ["no message"])[-1]
    return json.loads(done.stdout)


def compared(usual: list[dict], rows: list[dict]) -> str:
    """One line: what the change did."""
    both = list(zip(usual, rows, strict=True))
    changed = sum(a.get("tables") != b.get("tables") for a, b in both)
    pairs = [(a, b) for a, b in both if a.get("position") and b.get("position")]
    if not changed or not pairs:
        return f"{changed} of {len(rows)} tables changed"
    ratios = [float(np.exp(np.mean([np.log(b[k] / a[k]) for a, b in pairs]))) for k in ("position", "rotation")]
    totals = [sum(r.get(k) or 0 for r in rows) - sum(r.get(k) or 0 for r in usual) for k in ("measured", "wrong")]
    nees = [float(np.median([r["nees"] / 6 for r in side])) for side in zip(*pairs, strict=True)]
    verdicts = sum(a.get("status") != b.get("status") for a, b in both)
    return (
        f"{changed} of {len(rows)} tables changed; errors x {ratios[0]:.3f}, {ratios[1]:.3f}; NEES/6 in the median "
        f"{nees[0]:.2f} to {nees[1]:.2f}; measured {totals[0]:+d}, wrong labels {totals[1]:+d}, verdicts {verdicts}"
    )


def main() -> None:
    """Draw the sample, process, print a line per constant."""
    parser = argparse.ArgumentParser(prog="bench.random_scenes.constants", description=__doc__)
    parser.add_argument("--sample", type=int, default=40, help="constants drawn (default 40)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folders", nargs="*", default=FOLDERS, choices=FOLDERS)
    parser.add_argument("--process", nargs="*", type=Path, help=argparse.SUPPRESS)
    a = parser.parse_args()
    if a.process is not None:
        print(json.dumps(process(a.process)))
        return
    rng = np.random.default_rng(a.seed)
    every = constants(tuple(a.folders))
    drawn = [every[i] for i in rng.permutation(len(every))[: a.sample]]
    print(f"{len(every)} constants, {len(drawn)} drawn", flush=True)
    with tempfile.TemporaryDirectory(prefix="beampose-") as name:
        copy = Path(name) / "program"
        for package in (*PACKAGES, "bench"):  # with the compiled code that is there
            shutil.copytree(ROOT / package, copy / package)
        runs = recordings(Path(name) / "recordings")
        usual = processed_by(copy, runs)
        assert isinstance(usual, list), usual
        print(f"{len(usual)} recordings; verdicts {[r.get('status') for r in usual]}", flush=True)
        for constant in drawn:
            factor = float(rng.choice([0.5, 2.0]))
            place = copy / constant.file
            source = place.read_text()
            place.write_text(constant.changed(source, factor))
            rows = processed_by(copy, runs)
            place.write_text(source)
            what = rows if isinstance(rows, str) else compared(usual, rows)
            print(
                f"{constant.file}:{constant.line} {constant.name} {constant.value:g} x {factor:g}: {what}", flush=True
            )


if __name__ == "__main__":
    main()
