"""The runs of a batch, their result folders, and the processes that work on them."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
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
from multiprocessing import connection
from pathlib import Path
from typing import Any, TypeVar

from lab.cycle_search import search_rarely
from lab.errors import InputError
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.json_text import read_json
from lab.files.text.regular_file import bytes_of_file

# The runs of a batch: folders, patterns and lists in files, and the part of them that one shard processes.


def listed_runs(given: Sequence[str | os.PathLike[str]], lists: Sequence[str | os.PathLike[str]] = ()) -> list[Path]:
    """Run folders of the command line, in order.

    given: folders, patterns such as `data/*/run-*` (`**`: folders at any depth), or `@FILE`. lists: files of runs; `-`
    is standard input. A file names a folder or pattern per line; blank lines and lines with # at the start are
    ignored; paths start at the current folder. A folder that several patterns or lists find is processed once.

    Raises:
        InputError: a folder is given more than once by name, a pattern finds no run, a list cannot be read.
    """
    out: dict[str, Path] = {}
    named: set[str] = set()
    for text in (os.fspath(g) for g in given):
        is_list = text.startswith("@") and len(text) > 1 and not os.path.exists(text)
        for folder in _of_file(text[1:]) if is_list else _of_argument(text):
            place = os.path.realpath(folder)
            by_name = not is_list and str(folder) == str(Path(text))
            if by_name and place in named:
                raise InputError(f"batch: the run folder {text} is given more than once")
            if by_name:
                named.add(place)
            out.setdefault(place, folder)
    for text in (os.fspath(g) for g in lists):
        for folder in _of_file(text):
            out.setdefault(os.path.realpath(folder), folder)
    if not out:
        raise InputError("batch: expected one or more run folders, got none")
    return list(out.values())


def _of_file(path: str) -> Iterator[Path]:
    try:
        data = sys.stdin.buffer.read() if path == "-" else bytes_of_file(Path(path))
    except OSError as error:
        raise InputError(f"{path}: expected a text file with a run folder per line: {error.strerror}") from None
    for number, line in enumerate(data.removeprefix(b"\xef\xbb\xbf").splitlines(), start=1):
        text = os.fsdecode(line).strip()
        if "\0" in text:
            raise InputError(f"{path}: line {number}: expected a run folder, got a line with a null byte")
        if text and not text.startswith("#"):
            yield from _of_argument(text)


def _of_argument(text: str) -> list[Path]:
    """The folder, or the run folders that a pattern finds, sorted."""
    if not glob.has_magic(text) or os.path.lexists(text):
        return [Path(text)]
    found = [Path(p) for p in sorted(glob.glob(text, recursive=True)) if os.path.isfile(os.path.join(p, "run.yaml"))]
    if not found:
        raise InputError(f"batch: {text}: no folder with a run.yaml matches this pattern")
    return found


def shard_of(text: str) -> tuple[int, int]:
    """`2/5` as (2, 5): the second of five parts. Raises InputError."""
    number, slash, count = text.partition("/")
    if not (slash and number.isascii() and number.isdigit() and count.isascii() and count.isdigit()):
        raise InputError(f"--shard: expected I/N, such as 2/5 for the second of five parts, got {text!r}")
    if len(count) > 9 or not 1 <= int(number) <= int(count):
        raise InputError(f"--shard: expected I/N with I from 1 to N, got {text!r}")
    return int(number), int(count)


# The result folder of every run of a batch. It stays the same in later batches into the same folder.


FILE_NAME = ".batch-folders.json"
SCHEMA = "beampose/batch-folders/1"
RESERVED = ("batch.csv", "index.html", "errors", "parquet")  # names in the batch's folder that no run may have


def displayed(path: str | os.PathLike[str]) -> str:
    """A path as printable UTF-8 text; other bytes and control characters as `\\xe9`."""
    text = os.fsencode(path).decode("utf-8", "backslashreplace")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def allotted(out: Path, folders: Sequence[Path], resumable: Mapping[str, str]) -> list[str]:
    """The name of the result folder in `out` for each run folder; recorded in `out`. To be called under the lock.

    It is the name of the run folder, with that of its parent where two runs of the batch have one name, and with a
    digest of its place where another run has that name already. A run that has a result folder keeps it. resumable:
    result folders by run folder, of runs that have been moved: the run takes over the results.

    Raises:
        InputError: the record is damaged or cannot be written.
    """
    record = _read(out / FILE_NAME)
    owners = {name.casefold(): place for place, name in record.items()}
    places = [displayed(os.path.realpath(f)) for f in folders]
    simple = [_simple(p) for p in folders]
    names = []
    for place, folder, name in zip(places, folders, simple, strict=True):
        if place not in record and place in resumable:
            taken = resumable[place]
            record = {p: n for p, n in record.items() if n != taken}
            record[place], owners[taken.casefold()] = taken, place
        if place not in record:
            parent = _simple(Path(os.path.realpath(folder)).parent)
            digest = hashlib.sha256(place.encode()).hexdigest()[:8]
            choices = [f"{parent}-{name}", f"{name}-{digest}", f"{name}-{digest}-2"]
            if simple.count(name) == 1:
                choices.insert(0, name)
            record[place] = next(c for c in choices if c.casefold() not in owners and c not in RESERVED)
            owners[record[place].casefold()] = place
        names.append(record[place])
    atomic_write_text(json.dumps({"schema": SCHEMA, "folders": record}, indent=1) + "\n", out / FILE_NAME)
    return names


def moved_runs(out: Path, folders: Sequence[Path]) -> dict[str, tuple[Path, str]]:
    """Runs without a result folder, where one of the same name belongs to a run folder that is gone.

    Returns the run folder and the name of the results, by place.
    """
    record = _read(out / FILE_NAME)
    gone = {name: place for place, name in record.items() if not os.path.isdir(place)}
    found = {}
    for folder in folders:
        place, name = displayed(os.path.realpath(folder)), _simple(folder)
        if place not in record and name in gone:
            found[place] = (folder, name)
    return found


def _simple(folder: Path) -> str:
    """The folder's own name, such that every file system and table can hold it."""
    name = os.fsencode(os.path.basename(os.path.realpath(folder))).decode("utf-8", "replace").replace("\ufffd", "_")
    return "".join(c if c.isprintable() else "_" for c in name) or "run"


def _read(path: Path) -> dict[str, str]:
    try:
        content = read_json(path)
        folders = content["folders"]
        if content["schema"] != SCHEMA or not all(isinstance(v, str) for v in folders.values()):
            raise ValueError
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{path}: expected the result folders of a batch, found another file; delete it") from None
    return dict(folders)


# Worker processes of a batch. A worker that dies (killed, out of memory) costs its own run only.


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
    from lab.runs.frames import frames

    search_rarely()
    frames.THREADS = min(frames.THREADS, threads)
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
