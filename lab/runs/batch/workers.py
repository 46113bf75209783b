"""The processes that work on the runs of a batch. A worker that dies (killed, out of memory) costs its own run only."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection
from typing import Any, TypeVar

from lab.cycle_search import search_rarely

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
