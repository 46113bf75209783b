"""Processes many runs: a result folder each, batch.csv and index.html. Work that is done already is skipped."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lab.errors import QUALITY_GATE_FAILED, BeamposeError, CalibrationError, InputError, RunError
from lab.files.run.parameter_overrides import with_overrides
from lab.runs.batch.parquet import require_pyarrow, update_data_sets
from lab.runs.batch.resumption import fingerprint_of, finished_summary
from lab.runs.batch.run_folders import allotted, listed_runs, moved_runs
from lab.runs.batch.table import BatchTable, locked, read_rows
from lab.runs.batch.task import Task, TaskOutcome, concluded, failed_row, perform
from lab.runs.batch.workers import performed
from lab.runs.process import ready_run
from tracking.parameters import TrackerParameters

INDEX_SECONDS = 60.0  # between two versions of index.html in a long batch
_INDEX_SHARE = 0.02  # of the time, at most, is spent on them: that of 2,000 runs takes several seconds


@dataclass(frozen=True, slots=True)
class BatchOptions:
    """How a batch is processed."""

    overrides: Mapping[str, Any] | None = None  # as for process_run
    causal: bool = False  # as for process_run
    jobs: int | None = None  # processes; None: all in this process, as is a single run
    force: bool = False  # process again what is done already
    shard: tuple[int, int] = (1, 1)  # (i, n): the i-th of n parts of the runs
    full_hash: bool = False  # large files are read completely for the fingerprint
    parquet: bool = False  # also write Parquet data sets of attitudes and spots
    dask: str | None = None  # address of a Dask cluster that processes the runs, in place of processes
    provenance: Mapping[str, Any] | None = None  # added to every summary.json, such as the command line


@dataclass(frozen=True, slots=True)
class BatchOutcome:
    """The rows of this batch's runs in batch.csv, and the files written."""

    rows: tuple[Mapping[str, Any], ...]
    skipped: int  # runs that were done already
    table: Path
    index: Path

    @property
    def exit_status(self) -> int:
        """1 if a run could not be processed, 3 if its calibration is the only reason; else 4 or 0."""
        found = {row["exit_status"] for row in self.rows}
        failed = found - {0, QUALITY_GATE_FAILED}
        if failed:
            return CalibrationError.exit_status if failed == {CalibrationError.exit_status} else RunError.exit_status
        return QUALITY_GATE_FAILED if QUALITY_GATE_FAILED in found else 0


def process_batch(
    runs: Sequence[str | os.PathLike[str]],
    out: Path,
    options: BatchOptions | None = None,
    *,
    lists: Sequence[str | os.PathLike[str]] = (),
    report: Callable[[str], None] = lambda line: None,
    complain: Callable[[str], None] | None = None,
    log: Callable[[str], None] = lambda line: None,
    progress: Callable[[int, int, int], None] = lambda done, processed, total: None,
) -> BatchOutcome:
    """Process runs into folders in `out`; a run that fails, in whatever way, does not stop the others.

    runs, lists: as for `listed_runs`. report: called with one line per run. complain: in its place for runs that ended
    with an error. log: called with the lines of each run's log when it ends. progress: called with the numbers of runs
    that are done, that were processed (not skipped), and of all. With `jobs`, a script must call this under
    `if __name__ == "__main__"`, since the processes import it.

    Raises:
        InputError: the command as a whole cannot be carried out.
    """
    options, out = options or BatchOptions(), Path(out)
    # A misspelt parameter is the command's mistake, not each run's.
    with_overrides(TrackerParameters(), options.overrides or {})
    if options.parquet:
        require_pyarrow()
    folders = listed_runs(runs, lists)
    _make_folder(out)
    tasks = _tasks(folders, out, options)
    table = BatchTable(out, [task.place for task in tasks])
    number, count = options.shard
    mine = tasks[number - 1 :: count]
    rows: dict[str, Mapping[str, Any]] = {}
    skipped = 0
    progress(0, 0, len(mine))
    with _outcomes(mine, out, options, report) as outcomes, _written(table) as add:
        for task, ended in outcomes:
            outcome = concluded(task, ended)
            rows[task.place] = outcome.row
            skipped += outcome.skipped
            add(outcome)
            for line in outcome.log:
                log(f"{task.results}: {line}")
            (complain if complain and outcome.row["status"] == "error" else report)(_line(task, outcome))
            progress(len(rows), len(rows) - skipped, len(mine))
    if options.parquet:
        with locked(out):
            update_data_sets(read_rows(table.path), out)
    return BatchOutcome(tuple(rows[task.place] for task in mine), skipped, table.path, out / "index.html")


@contextlib.contextmanager
def _written(table: BatchTable) -> Iterator[Callable[[TaskOutcome], None]]:
    """A function that puts an outcome into batch.csv; index.html is written now and then, and when the block ends."""
    due = time.monotonic() + INDEX_SECONDS

    def add(outcome: TaskOutcome) -> None:
        nonlocal due
        table.add(outcome.row, outcome.skipped)
        # After every run: if the program is killed, the rows so far are kept. Rows of skipped runs follow from their
        # results. If the disk is full, the next run may find space, and the end reports it.
        if not outcome.skipped:
            begun = time.monotonic()
            index = begun > due
            with contextlib.suppress(InputError):
                table.write(index=index)
            if index:
                now = time.monotonic()
                due = now + max(INDEX_SECONDS, (now - begun) / _INDEX_SHARE)

    try:
        yield add
    finally:
        table.write(index=True)


def _make_folder(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder for the results, found a file; choose another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: the folder cannot be made: {error.strerror}") from None


def _tasks(folders: Sequence[Path], out: Path, options: BatchOptions) -> list[Task]:
    """The tasks of all runs; each gets its result folder, whatever shard processes it."""
    overrides = dict(options.overrides or {})
    with locked(out):
        resumable = {}
        for place, (folder, name) in moved_runs(out, folders).items():
            with contextlib.suppress(BeamposeError, OSError):
                value = fingerprint_of(ready_run(folder, overrides), options.causal, options.full_hash)
                if finished_summary(out / name, value) is not None:
                    resumable[place] = name
        names = allotted(out, folders, resumable)
    return [
        Task(folder, out, name, overrides, options.causal, options.force, options.full_hash, options.provenance or {})
        for folder, name in zip(folders, names, strict=True)
    ]


@contextlib.contextmanager
def _outcomes(
    tasks: Sequence[Task], out: Path, options: BatchOptions, report: Callable[[str], None]
) -> Iterator[Iterator[tuple[Task, TaskOutcome]]]:
    """The tasks with their outcomes, as they end: in this process, in others, or on a cluster."""
    with contextlib.ExitStack() as stack:
        if options.dask is not None:
            from lab.runs.batch.cluster import connected

            cluster = stack.enter_context(connected(options.dask, out))
            if note := cluster.check(tasks):
                report(f"note: {note}")
            outcomes = cluster.performed(tasks)
        elif options.jobs is None or len(tasks) <= 1:
            outcomes = ((task, perform(task)) for task in tasks)
        else:
            outcomes = _by_processes(tasks, min(options.jobs, len(tasks)))
        yield stack.enter_context(contextlib.closing(outcomes))


def _by_processes(tasks: Sequence[Task], jobs: int) -> Generator[tuple[Task, TaskOutcome], None, None]:
    with contextlib.closing(performed(tasks, perform, jobs)) as results:
        for task, outcome in results:
            died = "the process ended without a result: it was killed, or ran out of memory, or a library crashed"
            yield task, outcome or TaskOutcome(failed_row(task, died))


def _line(task: Task, outcome: TaskOutcome) -> str:
    row = outcome.row
    done = "done already; " if outcome.skipped else ""
    line = f"{task.results}: {row['status'].upper()}: {done}{row['message']}"
    return "".join(c if c.isprintable() else "?" for c in line)
