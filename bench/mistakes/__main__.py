"""Make each mistake on each of six rigs, and print which ones `check` and `run` name.

    python -m bench.mistakes --seed 1
    python -m bench.mistakes --correct 30000:30300

--correct: wrong alarms on correct random recordings instead. --only: mistakes whose name contains this text.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.mistakes.mistakes import CASES, Case, read, write
from bench.mistakes.recordings import recordings
from bench.random_scenes.__main__ import seed_range
from bench.random_scenes.scene import random_scene
from bench.random_scenes.write_folder import write_run_folder
from lab.errors import BeamposeError
from lab.findings.finding import Outcome
from lab.runs.input_check import check
from lab.runs.process import process_run
from lab.runs.verdict.run_statistics import RunStatistics
from lab.runs.verdict.score import measured_errors, normalised_squares

CODES = ("BP-M06", "BP-M07", "BP-M08", "BP-M10", "BP-V20")  # of findings on mistakes
ALARMS = r"\(BP-M0[678]\)|numbered from"  # in the lines of `check`
FLOOR = 1e-5  # m and rad: poses that agree with the truth to this are right
COLUMNS = ("check", "verdict", "harmless", "CHECK unnamed", "FAIL unnamed", "PASS wrong")


@dataclass(frozen=True)
class Answer:
    """What `check` and `run` report."""

    checked: str  # problems and remarks
    status: str  # of the verdict; or "refused"
    texts: str
    wrong: int  # measured poses beyond 10 sigmas
    measured: int
    seconds: tuple[float, float]  # process time of check and run
    codes: tuple[str, ...] = ()


def answer(folder: Path, out: Path, truth: Path | None) -> Answer:
    """Check and process a run folder, and compare its poses with a truth that is not in it."""
    clock = [time.process_time()]
    with contextlib.redirect_stderr(io.StringIO()):
        lines = check(folder).lines
        clock.append(time.process_time())
        try:
            outcome: Outcome[RunStatistics] | None = process_run(folder, out)
            refusal = ""
        except BeamposeError as error:
            outcome, refusal = None, str(error)
    clock.append(time.process_time())
    seconds = (clock[1] - clock[0], clock[2] - clock[1])
    if outcome is None:
        return Answer("\n".join(lines), "refused", refusal, 0, 0, seconds)
    wrong = 0
    if truth is not None:
        delta, covariance = measured_errors(out, truth)
        nees = normalised_squares(delta, covariance + FLOOR**2 * np.eye(6))
        wrong = int(np.sum(nees > 100))
    verdict = outcome.verdict
    codes = tuple(str(r.as_mapping()["code"]) for r in verdict.findings)
    texts = "\n".join(verdict.texts)
    return Answer("\n".join(lines), verdict.status, texts, wrong, outcome.result.measured, seconds, codes)


def outcome_of(case: Case, a: Answer) -> str:
    """One of COLUMNS."""
    if re.search(case.words, a.checked):
        return "check"
    if re.search(case.words, a.texts):
        return "verdict"
    if a.status == "pass":
        return "PASS wrong" if a.wrong else "harmless"
    if a.status == "check" and not a.wrong:
        return "CHECK unnamed"
    return "CHECK unnamed" if a.status == "check" else "FAIL unnamed"


def run_cases(seed: int, only: str, rigs: str, share: tuple[int, int], verbose: bool) -> None:
    """The table of all mistakes and rigs."""
    folder = Path(tempfile.mkdtemp(prefix="mistakes-"))
    made = {name: run for name, run in recordings(folder, seed).items() if rigs in name}
    table: dict[str, Counter[str]] = {}
    pass_wrong = silent = 0
    seconds = np.zeros(2)
    for c, case in enumerate((Case("none", "BP-M0[678]", lambda f: None), *CASES)):
        if only not in case.name:
            continue
        counts = table.setdefault(case.name, Counter())
        for r, (name, run) in enumerate(made.items()):
            if (c + r) % share[1] != share[0]:
                continue
            files = read(run)
            before = repr((files.rig, files.run, files.rows[:2000]))
            case.make(files)
            if case.name != "none" and repr((files.rig, files.run, files.rows[:2000])) == before:
                counts["not possible"] += 1
                continue
            broken = write(files, folder / "broken")
            a = answer(broken, folder / "out", run)
            kind = outcome_of(case, a)
            counts[kind] += 1
            pass_wrong += a.status == "pass" and a.wrong > 0
            silent += kind == "PASS wrong"
            seconds += a.seconds
            if verbose:
                text = a.checked if kind == "check" else a.texts
                hit = re.search(f".*({case.words}).*", text)
                print(
                    f"{case.name} | {name} | {kind} | {a.status} {a.wrong}/{a.measured} wrong |"
                    f" {a.seconds[0]:.1f} {a.seconds[1]:.1f} s | {(hit[0] if hit else a.texts.splitlines()[0])[:300]}",
                    flush=True,
                )
            shutil.rmtree(broken)
    shutil.rmtree(folder)
    print(f"{'mistake':36s}" + "".join(f"{c:>15s}" for c in COLUMNS))
    for name, counts in table.items():
        print(f"{name:36s}" + "".join(f"{counts[c] or '':>15}" for c in COLUMNS))
    total = Counter[str]()
    for name, counts in table.items():
        total.update(counts if name != "none" else {})
    made_count = sum(total[c] for c in COLUMNS)
    named = total["check"] + total["verdict"]
    harmful = made_count - total["harmless"]
    print(
        f"{made_count} mistakes, {total['harmless']} harmless (PASS, and right); of the {harmful} others {named} are"
        f" named ({named / max(harmful, 1):.1%}), {total['check']} by `check`; PASS with a pose beyond 10 sigmas:"
        f" {pass_wrong}, of which {pass_wrong - silent} are named by `check`; process time of check"
        f" {seconds[0] / max(made_count, 1):.1f} s, of run {seconds[1] / max(made_count, 1):.1f} s"
    )


def run_correct(seeds: Sequence[int]) -> None:
    """Wrong alarms on correct random recordings."""
    folder = Path(tempfile.mkdtemp(prefix="correct-"))
    alarms, seconds = 0, np.zeros(2)
    statuses: Counter[str] = Counter()
    for seed in seeds:
        run = write_run_folder(random_scene(seed), folder / "run")
        truth = folder / "true"
        shutil.rmtree(truth, ignore_errors=True)
        truth.mkdir()
        (run / "truth").rename(truth / "truth")
        a = answer(run, folder / "out", truth)
        statuses[a.status] += 1
        seconds += a.seconds
        said = [line.strip() for line in a.checked.splitlines() if re.search(ALARMS, line)]
        if said or set(a.codes) & set(CODES):
            alarms += 1
            print(f"seed {seed}: {a.status}: {'; '.join(said)} | {a.texts[:400]}", flush=True)
        shutil.rmtree(run)
    shutil.rmtree(folder)
    print(
        f"{len(seeds)} correct recordings: {alarms} alarms; verdicts {dict(statuses)}; process time of check"
        f" {seconds[0] / len(seeds):.2f} s, of run {seconds[1] / len(seeds):.2f} s"
    )


def main() -> None:
    """Print a table per mistake, or the wrong alarms."""
    parser = argparse.ArgumentParser(prog="bench.mistakes", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="")
    parser.add_argument("--rig", default="", help="rigs whose name contains this text")
    parser.add_argument("--share", default="0/1", help="0/3: a third of the pairs of mistake and rig, evenly")
    parser.add_argument("--correct", type=seed_range, metavar="A:B")
    parser.add_argument("-v", "--verbose", action="store_true", help="a line for each mistake and rig")
    a = parser.parse_args()
    if a.correct is not None:
        run_correct(a.correct)
    else:
        part, parts = (int(n) for n in a.share.split("/"))
        run_cases(a.seed, a.only, a.rig, (part, parts), a.verbose)


if __name__ == "__main__":
    main()
