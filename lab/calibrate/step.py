"""The steps of `beampose calibrate`: each solves and says what it writes; one runner does what all have in common.

The runner checks the folder, solves, judges by the findings, keeps earlier good results, and writes files, summary.json
and page.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from lab.errors import CalibrationError, InputError
from lab.files.project.project import Project
from lab.files.rig.camera_file import CalibrationState
from lab.files.run.fingerprints import fingerprints_of
from lab.files.text.atomic_write import atomic_folder, check_output_folder, earlier_results, keep_good_results
from lab.files.text.json_text import write_json
from lab.findings.finding import (
    Finding,
    Level,
    Outcome,
    Verdict,
    counted,
    finding,
    first_sentence,
    reasons,
    verdict,
    worst_first,
)
from lab.packages import versions
from lab.report.page import KeyFigure, Page, Section, made_with, write_page

R = TypeVar("R")
SCHEMA = "beampose/calibration-summary/1"  # of summary.json
_SENTENCES = (
    "The result may be used.",
    "The result may be used; note the warnings below.",
    "The result must not be used.",
)


@dataclass(frozen=True, slots=True)
class Step:
    """What all calibrations of one kind share."""

    kind: str  # of the report
    own: tuple[str, ...]  # files by which a folder of earlier results is recognised
    good: str = ""  # file of a usable result, which a FAIL does not replace; empty: each result replaces the last one
    failed_status: int = CalibrationError.exit_status  # exit status of a FAIL
    sentences: tuple[str, str, str] = _SENTENCES  # of the verdict, by level


@dataclass(frozen=True, slots=True)
class Solved(Generic[R]):
    """A solved step, before anything is written."""

    name: str
    result: R
    findings: tuple[Finding, ...]
    figures: str  # key figures in words, for the line on the terminal
    write: Callable[[Path], None]  # writes the tables and files into a folder
    page: Callable[[], tuple[Sequence[KeyFigure], Sequence[Section]]]  # key figures and sections of the report
    day: datetime.date
    inputs: Sequence[Path]  # files of which the report states the checksums
    title: str = ""  # of the report; empty: the name
    advice: str = ""  # what to do after a FAIL; empty: the remedy of the worst finding


def _said(solved: Solved[R], level: Level) -> str:
    """Verdict and key figures; the worst finding, and after a FAIL what to do."""
    worst = max(solved.findings, key=lambda f: f.level)
    reason = "" if level is Level.PASS else f": {first_sentence(worst.what)}"
    if level is Level.FAIL:
        reason += f". {first_sentence(solved.advice or worst.remedy)}"
    return f"{level.name}: {solved.figures}{reason}"


def run_step(step: Step, out: Path, solve: Callable[[], Solved[R]]) -> Outcome[R]:
    """Solve a step and write its files, summary.json and report.html into the folder `out`, all or none.

    A FAIL never replaces an earlier usable result: it goes to `OUT-failed`. Raises BeamposeError: as `solve` does, or
    the folder cannot be written. Nothing is written then.
    """
    own = earlier_results(*step.own)
    check_output_folder(out, own)
    solved = solve()
    level = verdict(solved.findings)
    folder = keep_good_results(out, level is Level.FAIL, step.good) if step.good else Path(out)
    key_figures, sections = solved.page()
    inputs = fingerprints_of_inputs(solved.inputs)
    page = Page(
        f"calibration · {step.kind}", solved.title or solved.name,
        f"{solved.day.isoformat()} · {counted(solved.findings)}",
        sections, key_figures, made=made_of(solved.day, inputs), findings=solved.findings,
        sentence=step.sentences[level], words=("PASS", "WARN", "FAIL"),
    )  # fmt: skip
    judged = Verdict(worst_first(solved.findings))
    said = _said(solved, level)
    outcome = Outcome(solved.name, folder, judged, solved.result, said, failed_status=step.failed_status)
    summary = {
        "schema": SCHEMA,
        "kind": step.kind,
        "name": solved.name,
        "date": solved.day.isoformat(),
        "verdict": {**judged.as_mapping(), "exit_status": outcome.exit_status},
        "versions": versions(),
        "inputs": inputs,
    }
    with atomic_folder(folder, own) as work:
        solved.write(work)
        write_json(summary, work / "summary.json")
        write_page(page, work)
    return outcome


def fingerprints_of_inputs(inputs: Sequence[Path]) -> list[dict[str, Any]]:
    """Path, SHA-256 and size of the input files. Raises InputError for one that cannot be read."""
    try:
        return fingerprints_of(inputs, ())
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be read: {error.strerror}") from None


def made_of(day: datetime.date, inputs: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """The date, the version of the program and the SHA-256 of the input files, for the report."""
    lines = [f"{Path(i['path']).name}  sha256 {i['sha256'][:16]}" for i in inputs]
    named = zip(("inputs", *[""] * len(lines)), lines, strict=False)
    return [("date", day.isoformat()), made_with(), *named]


# State of a calibration: its verdict, its date and the end of its validity.


def state_of(
    findings: Sequence[Finding],
    day: datetime.date,
    valid_until: datetime.date | None,
    notes: str = "",
    made_from: tuple[str, ...] = (),
) -> CalibrationState:
    """What the file of a calibration states: verdict and reasons, the most severe first; date and validity."""
    return CalibrationState(
        date=day,
        verdict=verdict(findings).name,
        valid_until=valid_until,
        reasons=reasons(worst_first(findings)),
        notes=notes,
        made_from=made_from,
    )


def calibration_date(project: Project, today: datetime.date | None) -> datetime.date:
    """Date written into the result: `today` if given, else the date of the measurements, else the current date.

    Raises InputError: if the measurements are dated in the future.
    """
    now = today or datetime.date.today()
    if project.date is not None and project.date > now:
        raise InputError(
            f"{project.path}: date: expected the day of the measurements, got {project.date.isoformat()}, after"
            f" today ({now.isoformat()}); correct the date or the computer's clock"
        )
    return today or project.date or now


def expiry_date(project: Project, day: datetime.date) -> datetime.date | None:
    """Last day on which the result is valid; None: no expiry."""
    return None if project.valid_days is None else day + datetime.timedelta(days=project.valid_days)


def expiry_findings(project: Project, day: datetime.date, today: datetime.date | None) -> list[Finding]:
    """A warning if the result has already expired on the day on which it is written."""
    until, now = expiry_date(project, day), today or datetime.date.today()
    if until is None or until >= now:
        return []
    what = f"the calibration expired on {until.isoformat()}, {(now - until).days} days ago"
    return [finding("BP-K07", Level.WARN, what)]
