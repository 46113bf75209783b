"""One run of a batch: skipped where its results exist, else processed; its row of batch.csv, whatever happens."""

from __future__ import annotations

import os
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lab.errors import BeamposeError, RunError
from lab.files.output.folder_lock import FolderInUseError
from lab.files.run.run_file import Run
from lab.files.text.atomic_write import atomic_write_text
from lab.runs.batch.result_folders import displayed
from lab.runs.batch.resumption import fingerprint_of, finished_summary
from lab.runs.process import RunOutcome, process_run

COLUMNS = (
    "run", "name", "folder", "status", "exit_status", "frames", "measured_frames", "measured_share", "seconds",
    "results", "message",
)  # fmt: skip


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


@dataclass(frozen=True, slots=True)
class TaskOutcome:
    """The row of batch.csv, and whether the results of an earlier batch are used."""

    row: dict[str, Any]
    skipped: bool = False


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

    try:
        outcome = _processed(task, fingerprint)
        row, skipped = _row(task, outcome), False
    except _AlreadyDone as done:
        try:
            row, skipped = _row_of_summary(task, done.summary), True
        except (KeyError, TypeError, AttributeError, ValueError):
            row, skipped = failed_row(task, "summary.json of the earlier results is damaged; delete the folder"), False
    except BeamposeError as error:
        row, skipped = failed_row(task, str(error), error.exit_status), False
    except Exception as error:  # unforeseen: it must not stop the other runs
        row, skipped = failed_row(task, _unforeseen(task, error)), False
    else:
        _remove_error_file(task)
    if skipped:
        _remove_error_file(task)
    return TaskOutcome(row, skipped)


def _processed(task: Task, more: Callable[[Run], Mapping[str, Any]]) -> RunOutcome:
    """Process the run; waits while another process writes to its result folder. Raises as `process_run`."""
    until = time.monotonic() + task.patience_s
    while True:
        try:
            return process_run(
                task.folder, task.out / task.results, overrides=task.overrides, causal=task.causal, more=more
            )
        except FolderInUseError:
            if time.monotonic() >= until:
                raise
            time.sleep(min(1.0, task.patience_s))


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


def _row(task: Task, outcome: RunOutcome) -> dict[str, Any]:
    return {
        "run": displayed(task.folder),
        "name": _as_text(outcome.name),
        "folder": task.place,
        "status": outcome.verdict.status,
        "exit_status": outcome.exit_status,
        "frames": outcome.frames,
        "measured_frames": outcome.measured,
        "measured_share": _share(outcome.measured, outcome.frames),
        "seconds": round(outcome.seconds, 3),
        "results": task.results,
        "message": _as_text("; ".join(outcome.verdict.texts)),
    }


def _row_of_summary(task: Task, summary: Mapping[str, Any]) -> dict[str, Any]:
    """The row of results that were written earlier."""
    verdict, counts = summary["verdict"], summary["counts"]
    frames, measured = int(counts["frames"]), int(counts["pose_status"].get("measured", 0))
    return {
        "run": displayed(task.folder),
        "name": str(summary["name"]),
        "folder": task.place,
        "status": str(verdict["status"]),
        "exit_status": int(verdict["exit_status"]),
        "frames": frames,
        "measured_frames": measured,
        "measured_share": _share(measured, frames),
        "seconds": round(float(summary["timings"]["wall_s"]), 3),
        "results": task.results,
        "message": "; ".join(verdict["reasons"]),
    }


def _share(measured: int, frames: int) -> float:
    return round(measured / frames, 6) if frames else 0.0


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


def _remove_error_file(task: Task) -> None:
    """The traceback of an earlier attempt, and the folder where it was the last."""
    try:
        task.error_file.unlink(missing_ok=True)
        task.error_file.parent.rmdir()
    except OSError:
        pass
