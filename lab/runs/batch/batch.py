"""Processes many runs: a result folder each, batch.csv and index.html. Work that is done already is skipped.

A worker process that dies (killed, out of memory) costs its own run only. batch.csv and index.html have the rows of
all batches into one folder, merged under a lock. The tables of all runs are Parquet data sets: a file per run, with the
run's result folder as a column.
"""

from __future__ import annotations

import contextlib
import csv
import io
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import connection
from pathlib import Path
from typing import Any, TypeVar

import filelock

from lab.cycle_search import search_rarely
from lab.errors import QUALITY_GATE_FAILED, BeamposeError, CalibrationError, InputError, RunError
from lab.files.text.atomic_write import atomic_write_bytes, made_folder
from lab.files.text.csv_text import WORD_COLUMNS, text_of_field, write_table
from lab.files.text.dataclass_fields import with_overrides
from lab.files.text.json_text import read_json, require_regular_file, text_of_file
from lab.packages import needed
from lab.runs.batch.task import (
    COLUMNS,
    Task,
    TaskOutcome,
    allotted,
    concluded,
    failed_row,
    fingerprint_of,
    finished_summary,
    listed_runs,
    moved_runs,
    perform,
)
from lab.runs.process import ready_run
from tracking.parameters import TrackerParameters

T = TypeVar("T")
R = TypeVar("R")
# Threads per process of the libraries below; they are read when the library is loaded.
THREAD_VARIABLES = (
    "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM",
    "VECLIB_MAXIMUM_THREADS",
)  # fmt: skip
_GRACE_S = 5.0  # for a worker that is ended: to delete its unfinished files


def performed(tasks: Iterable[T], perform: Callable[[T], R], jobs: int) -> Generator[tuple[T, R | None], None, None]:
    """Tasks with their results, as they end, on `jobs` processes; None for a task whose process died.

    When a process dies, the tasks that were running are tried again, each in a process of its own: only the one that
    kills its process again is given up. The generator must be closed (contextlib.closing): that ends the processes.
    """
    waiting = deque(tasks)
    while waiting:
        interrupted = yield from _until_a_process_dies(waiting, perform, jobs)
        if len(interrupted) == 1:
            yield interrupted[0], None
            continue
        for task in interrupted:
            if (yield from _until_a_process_dies(deque([task]), perform, 1)):
                yield task, None


def _until_a_process_dies(
    waiting: deque[T], perform: Callable[[T], R], jobs: int
) -> Generator[tuple[T, R | None], None, list[T]]:
    """Takes tasks from `waiting`; returns those that were running when a process died, none at the end."""
    running: dict[Future[R], T] = {}
    ended: list[tuple[T, R]] = []  # held back until their processes have new tasks: the caller may take its time
    threads = threads_per_process(jobs)
    with _limited_threads(threads), _pool(jobs, threads) as pool:
        while waiting or running:
            while waiting and len(running) < jobs:
                try:
                    running[pool.submit(_in_worker, perform, waiting[0])] = waiting[0]
                except BrokenProcessPool:
                    break
                waiting.popleft()
            yield from ended
            ended.clear()
            if not running:
                return []  # no process could be started for a task: the caller starts a new pool
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            interrupted = []
            for future in done:
                task = running.pop(future)
                try:
                    ended.append((task, future.result()))
                except BrokenProcessPool:
                    interrupted.append(task)
            if interrupted:
                interrupted += running.values()
                running.clear()
                break
        else:
            interrupted = []
    yield from ended
    return interrupted


def threads_per_process(jobs: int) -> int:
    """Threads that each of `jobs` processes may use, such that all together use the processors once."""
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, available // jobs)


@contextlib.contextmanager
def _pool(jobs: int, threads: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of fresh processes, which end with this block: also in the middle of a task where it ends by an error."""
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), _prepare, (threads,))
    try:
        yield pool
    except BaseException:
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def _limited_threads(threads: int) -> Iterator[None]:
    """Processes that are started in this block use so many threads in each library; a limit of the user is kept."""
    missing = [name for name in THREAD_VARIABLES if name not in os.environ]
    os.environ.update(dict.fromkeys(missing, str(threads)))
    try:
        yield
    finally:
        for name in missing:
            os.environ.pop(name, None)


def _prepare(threads: int) -> None:
    """Prepares a new worker process."""
    from lab.pictures import source

    search_rarely()
    source.THREADS = min(source.THREADS, threads)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent decides
    signal.signal(signal.SIGTERM, _end)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _in_worker(perform: Callable[[T], R], task: T) -> R:
    try:
        return perform(task)
    except SystemExit:  # of `_end`; the pool's loop would catch it and wait for the next task
        os._exit(128 + signal.SIGTERM)


def _end(*_: Any) -> None:
    """Ends the task such that its unfinished files are deleted, and the process in any case."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_exit_soon, daemon=True).start()
    sys.exit(128 + signal.SIGTERM)


def _exit_soon() -> None:
    time.sleep(_GRACE_S)
    os._exit(128 + signal.SIGTERM)


def _end_with_parent() -> None:
    """Ends this process when the parent has gone: a pool's processes would wait for it without end."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    connection.wait([parent.sentinel])
    os.kill(os.getpid(), signal.SIGTERM)


LOCK_SECONDS = 120.0  # the lock is held for milliseconds: longer waiting means a broken file system
FILE_NAME, LOCK_NAME = "batch.csv", ".batch.lock"


@contextlib.contextmanager
def locked(out: Path) -> Iterator[None]:
    """Only one process at a time is in this block for a batch's folder. Raises InputError: the lock cannot be had."""
    lock = filelock.FileLock(out / LOCK_NAME, timeout=LOCK_SECONDS)
    try:
        lock.acquire()
    except filelock.Timeout:
        raise InputError(f"{out / LOCK_NAME}: another program has locked this file for {LOCK_SECONDS:.0f} s") from None
    except (OSError, NotImplementedError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{out / LOCK_NAME}: cannot be locked: {reason}; choose another --out") from None
    try:
        yield
    finally:
        lock.release()


class BatchTable:
    """The table of a folder of batches; `add` puts rows of this batch into it, and rows of other batches stay."""

    def __init__(self, out: Path, places: Sequence[str]) -> None:
        """places: the `folder` of each run of this batch, in order. Raises InputError: batch.csv is another table."""
        self.path = out / FILE_NAME
        self._out, self._order = out, {place: i for i, place in enumerate(places)}
        self._own: dict[str, Mapping[str, Any]] = {}  # rows of this batch that are not yet in the file
        self._skipped: set[str] = set()
        read_rows(self.path)

    def add(self, row: Mapping[str, Any], skipped: bool = False) -> None:
        """Remember a row of this batch for the next `write`. skipped: it was made from earlier results."""
        self._own[row["folder"]] = row
        if skipped:
            self._skipped.add(row["folder"])

    def write(self, index: bool = False) -> None:
        """Merge the rows added since into batch.csv, and with `index` write index.html.

        Raises InputError: a file cannot be written. The rows are kept for the next attempt.
        """
        with locked(self._out):
            there = read_rows(self.path)
            for row in there:  # the time of the processing is better known than from the results
                own = self._own.get(row["folder"])
                if own and row["folder"] in self._skipped and row["results"] == own["results"] and row.get("seconds"):
                    self._own[row["folder"]] = {**own, "seconds": row["seconds"]}
            rows = merged(there, self._own, self._order)
            extra = [c for c in dict.fromkeys(c for row in rows for c in row) if c not in COLUMNS]
            header = [*COLUMNS, *extra]
            write_table(self.path, header, [[row.get(c, "") for c in header] for row in rows])
            self._own.clear()
            if index:
                from lab.report.index import write_index

                write_index([dict(row) for row in rows], self._out)


def merged(
    there: Sequence[Mapping[str, Any]], own: Mapping[str, Mapping[str, Any]], order: Mapping[str, int]
) -> list[Mapping[str, Any]]:
    """Rows of a table with this batch's rows in place of older ones; new ones at the end.

    The rows of this batch's runs are in the order of its runs, whatever the order in which they ended. A row whose
    results another run has taken over is dropped.
    """
    taken = {row["results"]: place for place, row in own.items() if row["results"]}
    rows: dict[str, Mapping[str, Any]] = {
        row["folder"]: row for row in there if taken.get(row["results"], row["folder"]) == row["folder"]
    }
    rows |= {place: {**rows.get(place, {}), **row} for place, row in own.items()}
    in_order = iter(sorted((p for p in rows if p in order), key=order.__getitem__))
    return [rows[next(in_order) if place in order else place] for place in rows]


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of batch.csv; none where there is no such file. Rows of older versions get their `folder`.

    Raises InputError: the file is not a table of a batch.
    """
    try:
        text = text_of_file(path)
        rows = list(csv.DictReader(io.StringIO(text, newline=""), restval="", strict=True))
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, csv.Error):
        rows = [{}]
    for row in rows:
        row.pop(None, None)  # fields beyond the header
        if not {"run", "status", "results"} <= set(row):
            raise InputError(
                f"{path}: expected the table of a batch, found another file; move it or choose another --out"
            )
        row.update({name: text_of_field(field) for name, field in row.items() if isinstance(field, str)})
        row["folder"] = row.get("folder") or str(Path(row["run"]).absolute())
    return rows


FOLDER = "parquet"
TABLES = ("attitude", "spots")


def update_data_sets(rows: Iterable[Mapping[str, Any]], out: Path) -> Path:
    """Write out/parquet/attitude/ and out/parquet/spots/, a file per run; returns out/parquet.

    rows: of batch.csv. A file that was made from the same results stays; that of a run without results is removed.
    `frame` is an integer, names and statuses are text, all other columns are numbers, null where the table is empty.
    Raises InputError: pyarrow is not installed, a table of the results is damaged, or a file cannot be written.
    """
    needed("parquet", "--parquet")
    root = Path(out) / FOLDER
    kept: dict[str, set[str]] = {name: set() for name in TABLES}
    try:
        for row in rows:
            if not row["results"]:
                continue
            results = Path(out) / row["results"]
            for name in TABLES:
                file = root / name / f"{row['results']}.parquet"
                kept[name].add(file.name)
                _update(results, name, file)
        for name in TABLES:
            for file in (root / name).glob("*.parquet"):
                if file.name not in kept[name]:
                    file.unlink()
    except OSError as error:
        raise InputError(f"{error.filename or root}: cannot be written: {error.strerror}") from None
    return root


def _update(results: Path, name: str, file: Path) -> None:
    import pyarrow as pa
    from pyarrow import csv, parquet

    source = results / f"{name}.csv"
    made_from = _identity(results, source)
    if file.is_file():
        try:
            if (parquet.read_schema(file).metadata or {}).get(b"made_from") == made_from:
                return
        except (pa.ArrowException, OSError):
            pass  # a damaged file is written again
    require_regular_file(source)
    try:
        with source.open(encoding="utf-8") as text:
            header = text.readline().strip().split(",")
        types = {c: pa.int64() if c == "frame" else pa.string() if c in WORD_COLUMNS else pa.float64() for c in header}
        table = csv.read_csv(source, convert_options=csv.ConvertOptions(column_types=types, null_values=["", "nan"]))
    except (pa.ArrowException, ValueError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise InputError(f"{source}: expected a table of results, got another file: {reason}") from None
    run = pa.array([results.name] * len(table)).dictionary_encode()
    table = table.add_column(0, "run", run).replace_schema_metadata({b"made_from": made_from})
    content = pa.BufferOutputStream()
    parquet.write_table(table, content)
    made_folder(file.parent)
    atomic_write_bytes(content.getvalue().to_pybytes(), file)


def _identity(results: Path, source: Path) -> bytes:
    """Identifies the contents of a table: the fingerprint of its run, its size and time."""
    try:
        fingerprint = read_json(results / "summary.json").get("fingerprint")
    except (ValueError, AttributeError):
        fingerprint = None
    state = source.stat()
    return f"{fingerprint} {state.st_size} {state.st_mtime_ns}".encode()


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
    that are done, that were processed (not skipped), and of all. With `jobs`, a script must call this under `if
    __name__ == "__main__"`, since the processes import it. Raises InputError: the command as a whole cannot be carried
    out.
    """
    options, out = options or BatchOptions(), Path(out)
    # A misspelt parameter is the command's mistake, not each run's.
    with_overrides(TrackerParameters(), options.overrides or {})
    if options.parquet:
        needed("parquet", "--parquet")
    folders = listed_runs(runs, lists)
    made_folder(out)
    tasks = _tasks(folders, out, options)
    table = BatchTable(out, [task.place for task in tasks])
    number, count = options.shard
    mine = tasks[number - 1 :: count]
    rows: dict[str, Mapping[str, Any]] = {}
    skipped = 0
    progress(0, 0, len(mine))
    with contextlib.closing(_outcomes(mine, options.jobs)) as outcomes, _written(table) as add:
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


def _outcomes(tasks: Sequence[Task], jobs: int | None) -> Generator[tuple[Task, TaskOutcome], None, None]:
    """The tasks with their outcomes, as they end: in this process, or in `jobs` others."""
    if jobs is None or len(tasks) <= 1:
        for task in tasks:
            yield task, perform(task)
        return
    with contextlib.closing(performed(tasks, perform, min(jobs, len(tasks)))) as results:
        for task, outcome in results:
            died = "the process ended without a result: it was killed, or ran out of memory, or a library crashed"
            yield task, outcome or TaskOutcome(failed_row(task, died))


def _line(task: Task, outcome: TaskOutcome) -> str:
    row = outcome.row
    done = "done already; " if outcome.skipped else ""
    line = f"{task.results}: {row['status'].upper()}: {done}{row['message']}"
    return "".join(c if c.isprintable() else "?" for c in line)
