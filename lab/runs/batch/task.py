"""One run of a batch: skipped where its results exist, else processed; its row of batch.csv, whatever happens."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

from lab.errors import BeamposeError, RunError
from lab.files.output.folder_lock import FolderInUseError
from lab.files.run.run_file import Run
from lab.files.text.atomic_write import atomic_write_text
from lab.runs.batch.resumption import fingerprint_of, finished_summary
from lab.runs.batch.run_folders import displayed
from lab.runs.process import process_run
from lab.runs.run_log import collected_lines

COLUMNS = (
    "run", "name", "folder", "status", "exit_status", "frames", "measured_frames", "measured_share", "seconds",
    "results", "message", "report",
)  # fmt: skip
REPORT = "report.html"  # in a result folder
_WAITING_S = 1.0  # between two attempts


@dataclass(frozen=True, slots=True)
class Task:
    """One run to process. It can be sent to another process."""

    folder: Path  # of the run
    out: Path  # of the batch
    results: str  # name of the result folder in `out`
    overrides: Mapping[str, Any] = field(default_factory=dict)
    causal: bool = False
    force: bool = False  # process although results exist
    full_hash: bool = False
    provenance: Mapping[str, Any] = field(default_factory=dict)  # added to summary.json
    patience_s: float = 0.0  # for the end of another process that writes to the result folder

    @property
    def place(self) -> str:
        """The run folder without links, which identifies the run in batch.csv."""
        return displayed(os.path.realpath(self.folder))

    @property
    def error_file(self) -> Path:
        """Where the traceback of an unforeseen error is saved."""
        return self.out / "errors" / f"{self.results}.txt"

    @property
    def error_report(self) -> Path:
        """The report of a run that ended with an error. Its result folder keeps earlier results."""
        return self.error_file.with_suffix(".html")


@dataclass(frozen=True, slots=True)
class TaskOutcome:
    """The row of batch.csv, and whether the results of an earlier batch are used."""

    row: dict[str, Any]
    skipped: bool = False
    code: str = ""  # of the error, for `beampose explain`
    log: tuple[str, ...] = ()  # the lines of the run's log


class _AlreadyDone(Exception):  # noqa: N818 - ends the processing, not an error
    def __init__(self, summary: Mapping[str, Any]) -> None:
        super().__init__()
        self.summary = summary


def perform(task: Task) -> TaskOutcome:
    """Process a run, or use its earlier results. Any error becomes the row of the run."""

    def fingerprint(run: Run) -> dict[str, Any]:
        value = fingerprint_of(run, task.causal, task.full_hash)
        summary = None if task.force else finished_summary(task.out / task.results, value)
        if summary is not None:
            raise _AlreadyDone(summary)
        return {**task.provenance, "fingerprint": value}

    code = ""
    with collected_lines() as log:
        try:
            row, skipped = _processed(task, fingerprint), False
        except _AlreadyDone as done:
            try:
                row, skipped = _row(task, done.summary), True
            except (KeyError, TypeError, AttributeError, ValueError):
                damaged = "summary.json of the earlier results is damaged; delete the folder"
                row, skipped, code = failed_row(task, damaged), False, RunError.code
        except BeamposeError as error:
            row, skipped, code = failed_row(task, str(error), error.exit_status), False, error.code
        except Exception as error:  # unforeseen: it must not stop the other runs
            row, skipped, code = failed_row(task, _unforeseen(task, error)), False, RunError.code
    return TaskOutcome(row, skipped, code, tuple(log))


def _processed(task: Task, more: Callable[[Run], Mapping[str, Any]]) -> dict[str, Any]:
    """The row of a processed run; waits while another process writes to its result folder. Raises as `process_run`."""
    waited = 0.0
    while True:
        try:
            started = time.perf_counter()
            outcome = process_run(
                task.folder, task.out / task.results, overrides=task.overrides, causal=task.causal, more=more
            )
            return {**_row(task, outcome.summary), "seconds": round(time.perf_counter() - started, 3)}
        except FolderInUseError:
            if waited >= task.patience_s:
                raise
            time.sleep(_WAITING_S)
            waited += _WAITING_S


def failed_row(task: Task, message: str, exit_status: int = RunError.exit_status) -> dict[str, Any]:
    """The row of a run without results."""
    row: dict[str, Any] = dict.fromkeys(COLUMNS, "")
    return row | {
        "run": displayed(task.folder),
        "name": displayed(os.path.basename(os.path.realpath(task.folder))),
        "folder": task.place,
        "status": "error",
        "exit_status": exit_status,
        "message": _as_text(" | ".join(message.splitlines())),
    }


def _row(task: Task, summary: Mapping[str, Any]) -> dict[str, Any]:
    """The row of a run with results."""
    verdict, counts = summary["verdict"], summary["counts"]
    frames, measured = int(counts["frames"]), int(counts["pose_status"].get("measured", 0))
    return {
        "run": displayed(task.folder),
        "name": _as_text(str(summary["name"])),
        "folder": task.place,
        "status": str(verdict["status"]),
        "exit_status": int(verdict["exit_status"]),
        "frames": frames,
        "measured_frames": measured,
        "measured_share": round(measured / frames, 6) if frames else 0.0,
        "seconds": round(float(summary["timings"]["wall_s"]), 3),
        "results": task.results,
        "message": _as_text("; ".join(verdict["reasons"])),
        "report": f"{task.results}/{REPORT}",
    }


def _as_text(text: str) -> str:
    """Text that UTF-8 can hold."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def _unforeseen(task: Task, error: Exception) -> str:
    """Save the traceback; returns the message with its place."""
    first = (str(error).splitlines() or [""])[0]
    kind = type(error).__name__
    if isinstance(error, OSError) and error.strerror:
        named = isinstance(error.filename, str | bytes | os.PathLike)
        first = f"{displayed(error.filename)}: {error.strerror}" if named else error.strerror
        kind = ""  # the system's reason is enough
    message = f"unforeseen error: {kind}: {first}" if kind else first
    text = _as_text("".join(traceback.format_exception(error)))
    for path in (task.error_file, Path(tempfile.gettempdir()) / f"beampose-{task.results}-{os.getpid()}.txt"):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            atomic_write_text(text, path)
        except (OSError, BeamposeError):
            continue
        return f"{message}; the traceback is in {displayed(path)}{'; please report it' if kind else ''}"
    return f"{message}; its traceback could not be saved"


def concluded(task: Task, outcome: TaskOutcome) -> TaskOutcome:
    """The outcome with its report: that of a failure is written here, and that of an earlier failure is removed."""
    if outcome.row["status"] != "error":
        _remove_error_files(task)
        return outcome
    from lab.report.failure import Failure, write_failure_report  # imports the template engine

    row, saved = outcome.row, task.error_file
    failure = Failure(
        name=row["name"],
        message=row["message"],
        run_folder=row["run"],
        code=outcome.code or RunError.code,
        exit_status=row["exit_status"],
        log=outcome.log,
        traceback=quote(os.fsencode(saved.name)) if str(saved) in row["message"] else "",
        earlier=(task.out / task.results / REPORT).is_file(),
    )
    try:
        saved.parent.mkdir(parents=True, exist_ok=True)
        write_failure_report(task.error_report, failure)
    except (OSError, BeamposeError):  # a full disk: the row has the message
        return outcome
    report = f"{saved.parent.name}/{task.error_report.name}"
    return dataclasses.replace(outcome, row={**row, "report": report})


def _remove_error_files(task: Task) -> None:
    """The traceback and the report of an earlier attempt, and the folder where they were the last."""
    with contextlib.suppress(OSError):
        task.error_report.unlink(missing_ok=True)
        task.error_file.unlink(missing_ok=True)
        task.error_file.parent.rmdir()
