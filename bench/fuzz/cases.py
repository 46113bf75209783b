"""One case: a copy of a valid input, damaged, and the command that reads it."""

from __future__ import annotations

import dataclasses
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path

from bench.fuzz import result_cases
from bench.fuzz.hostile import OPTION_VALUES
from bench.fuzz.inputs import PICTURE_SUFFIXES
from bench.fuzz.mutations import damage_file
from tracking.parameters import TrackerParameters

COORDINATES = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")


def _run(work: Path, base: Path, rng: random.Random) -> list[str]:
    """A run with points: run.yaml, rig.yaml or one of its tables is damaged."""
    shutil.copytree(base / "points", work / "in")
    names = ["run.yaml"] * 3 + ["rig.yaml"] * 3 + ["detections.csv"] * 3
    damage_file(work / "in" / rng.choice([*names, "times.csv", "truth/pose.csv", "truth/spots.csv"]), rng)
    if rng.random() < 0.4:
        return ["check", str(work / "in")]
    return ["run", str(work / "in"), "--out", str(work / "out"), *rng.choice(([], ["--causal"]))]


def _pictures_run(work: Path, base: Path, rng: random.Random) -> list[str]:
    """A run with pictures, one of which is damaged."""
    shutil.copytree(base / "pictures", work / "in")
    damage_file(rng.choice(sorted((work / "in" / "frames").rglob("*.png"))), rng)
    return rng.choice((["check", str(work / "in")], ["run", str(work / "in"), "--out", str(work / "out")]))


def _rig(work: Path, base: Path, rng: random.Random) -> list[str]:
    """A plan with a damaged rig."""
    shutil.copy(base / "points" / "rig.yaml", work / "rig.yaml")
    damage_file(work / "rig.yaml", rng)
    few = [part for name in COORDINATES for part in ("--range", f"{name}=-0.1:0.1:{1 if name != 'x_m' else 2}")]
    return ["plan", str(work / "rig.yaml"), "--out", str(work / "out"), *few]


def _project(work: Path, base: Path, rng: random.Random) -> list[str]:
    """A calibration project: calibration.yaml, a camera.yaml or one of the tables is damaged."""
    shutil.copytree(base / "calibration", work / "in")
    files = [p for p in sorted((work / "in").iterdir()) if p.is_file()]
    damage_file(rng.choice([work / "in" / "calibration.yaml"] * 3 + files), rng)
    step = rng.choice(("screen", "screen", "screen", "rig"))
    return ["calibrate", step, str(work / "in" / "calibration.yaml"), "--out", str(work / "out")]


def _drift(work: Path, base: Path, rng: random.Random) -> list[str]:
    """A drift check with damaged points or survey."""
    shutil.copytree(base / "calibration", work / "in")
    shutil.copy(base / "calibration" / "truth" / "rig.yaml", work / "in" / "rig.yaml")
    damage_file(work / "in" / rng.choice(("points.csv", "survey.csv", "rig.yaml")), rng)
    inputs = ["--points", str(work / "in" / "points.csv"), "--survey", str(work / "in" / "survey.csv")]
    return ["calibrate", "check", str(work / "in" / "rig.yaml"), *inputs, "--out", str(work / "out")]


def _lens(work: Path, base: Path, rng: random.Random) -> list[str]:
    """A damaged lens file, converted into another format."""
    source = work / rng.choice([p.name for p in sorted((base / "lenses").iterdir())])
    shutil.copy(base / "lenses" / source.name, source)
    damage_file(source, rng)
    (work / "out").mkdir()
    name, target = rng.choice((("new.camera.yaml", "beampose"), ("new.yml", "opencv"), ("new.txt", "colmap")))
    return ["calibrate", "convert", str(source), str(work / "out" / name), "--to", target, "--camera", "left"]


def _shots(work: Path, base: Path, rng: random.Random) -> list[str]:
    """A folder of pictures, one of which is damaged."""
    suffix = rng.choice(PICTURE_SUFFIXES)
    shutil.copytree(base / "shots" / suffix[1:], work / "in")
    damage_file(rng.choice(sorted((work / "in").iterdir())), rng)
    return ["detect", str(work / "in"), "--out", str(work / "out")]


def _video(work: Path, base: Path, rng: random.Random) -> list[str]:
    """A damaged video."""
    shutil.copy(base / "video.avi", work / "in.avi")
    damage_file(work / "in.avi", rng)
    return ["detect", str(work / "in.avi"), "--out", str(work / "out")]


def _settings(work: Path, base: Path, rng: random.Random) -> list[str]:
    """Values of --set."""
    names = [f.name for f in dataclasses.fields(TrackerParameters)]
    inner = [f"{n}.{rng.choice(('threshold_sigma', 'x', 'window_px'))}" for n in ("detect", "r1_px", "no")]
    name = rng.choice([*names, *inner, "", ".", "detect." * 500 + "x", "no-such"])
    value = f"{name}={rng.choice(OPTION_VALUES)}"
    if rng.random() < 0.3:
        return ["detect", str(base / "shots" / "png"), "--out", str(work / "out"), "--set", value]
    return ["run", str(base / "points"), "--out", str(work / "out"), "--set", value]


def _plan_options(work: Path, base: Path, rng: random.Random) -> list[str]:
    """Options of plan."""
    few = dict.fromkeys(COORDINATES, "0:0:1")
    ends = ("0", "1", "-1", "-1e300", "1e300", "nan", "inf", "1e-300", "5", "1e4", "360", "word", "")
    few[rng.choice(COORDINATES)] = ":".join(
        (rng.choice(ends), rng.choice(ends), rng.choice(("1", "2", "5", "0", "-1", "1.5", "9" * 5000, "9" * 30, "nan")))
    )
    options = [part for name, value in few.items() for part in ("--range", f"{name}={value}")]
    if rng.random() < 0.5:
        options.append(f"{rng.choice(('--sigma-px', '--goal-deg', '--goal-mm'))}={rng.choice(OPTION_VALUES)}")
    if rng.random() < 0.3:
        options += ["--expect", f"beam_direction_arcsec={rng.choice(OPTION_VALUES)}"]
    return ["plan", str(base / "points" / "rig.yaml"), "--out", str(work / "out"), *options]


def _simulate_options(work: Path, base: Path, rng: random.Random) -> list[str]:
    """Options of simulate."""
    options = ["--points", "--frames", "3"]
    for option in rng.sample(("--noise-px", "--clutter", "--scale", "--seed", "--light", "--rig", "--frames"), 2):
        value = rng.choice(OPTION_VALUES)
        if option != "--frames" or len(value) < 5:
            options.append(f"{option}={value}")
    if rng.random() < 0.4:
        shutil.copy(base / "points" / "rig.yaml", work / "rig.yaml")
        damage_file(work / "rig.yaml", rng)
        options += ["--rig", str(work / "rig.yaml")]
    return ["simulate", rng.choice(("huo2015", "huo2015", "no-such", "")), "--out", str(work / "out"), *options]


def _names(work: Path, base: Path, rng: random.Random) -> list[str]:
    """Names of folders and pictures that are no UTF-8, control a terminal or are a formula."""
    name = os.fsdecode(
        rng.choice(
            (b"caf\xe9", b"\xff\xfe", b"\x1b[2J", b"=cmd()", b"-1+x()", b"a\nb", b"a" * 240, b"<b>&", b" ", b"'\"")
        )
    )
    if rng.random() < 0.5:
        shutil.copytree(base / "points", work / name)
        out = work / rng.choice(("out", f"{name}o"))
        command = rng.choice(("run", "batch", "check"))
        return [command, str(work / name), *([] if command == "check" else ["--out", str(out)])]
    if rng.random() < 0.5:
        shutil.copytree(base / "shots" / "png", work / name)
        return ["detect", str(work / name), "--out", str(work / "out")]
    shutil.copytree(base / "pictures", work / "in")
    picture = rng.choice(sorted((work / "in" / "frames").rglob("*.png")))
    picture.rename(picture.with_name(f"{name[:200]}{picture.stem}.png"))
    return ["check", str(work / "in")]


KINDS: dict[str, tuple[Callable[[Path, Path, random.Random], list[str]], int]] = {
    "run": (_run, 10),
    "run with pictures": (_pictures_run, 1),
    "rig": (_rig, 5),
    "calibration": (_project, 3),
    "drift check": (_drift, 2),
    "lens file": (_lens, 4),
    "pictures": (_shots, 4),
    "video": (_video, 2),
    "--set": (_settings, 3),
    "plan options": (_plan_options, 3),
    "simulate options": (_simulate_options, 3),
    "names": (_names, 2),
    "reference": (result_cases.reference, 5),
    "two results": (result_cases.two_results, 3),
    "compare options": (result_cases.compare_options, 2),
    "results": (result_cases.results, 3),
    "view": (result_cases.view, 1),
    "continued batch": (result_cases.continued_batch, 3),
    "init": (result_cases.init_answers, 3),
}  # what writes the case, and its share


def write_case(seed: int, number: int, base: Path, work: Path) -> tuple[str, list[str]]:
    """Write the damaged input of one case into the empty folder `work`; returns its kind and the command."""
    rng = random.Random(f"{seed}-{number}")
    kind = rng.choices(list(KINDS), [share for _, share in KINDS.values()])[0]
    return kind, KINDS[kind][0](work, base, rng)
