"""The report of a run that ended with an error: it says so, and why, instead of figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lab.errors import RunError
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.error_text import printable
from lab.findings.finding import ENTRIES
from lab.report.html import environment


@dataclass(frozen=True, slots=True)
class Failure:
    """What is known of a run that ended with an error."""

    name: str
    message: str  # the error as the command line shows it: one plain line
    run_folder: str = ""
    code: str = RunError.code  # its explanation is shown
    exit_status: int = RunError.exit_status
    log: Sequence[str] = ()  # lines up to the error
    files: Sequence[str] = ()  # in the folder of the results: of an earlier attempt, or incomplete
    traceback: str = ""  # address of its file, relative to the report
    earlier: bool = False  # the results of an earlier, successful processing were kept elsewhere


def files_beside(report: Path) -> list[str]:
    """The names of the files in the folder of a report, so that they are not taken for results of this attempt."""
    return sorted(p.name for p in report.parent.iterdir() if p.is_file() and p.name != report.name)


def write_failure_report(path: Path, failure: Failure) -> Path:
    """Write the report of a failure as the HTML file `path`; returns the path. Raises InputError."""
    text = environment().get_template("failure.html.j2").render(
        f=failure, explanation=ENTRIES[failure.code], log=[printable(line) for line in failure.log]
    )  # fmt: skip
    atomic_write_text(text, path)
    return path
