"""The runs of a batch on an existing Dask cluster, whose workers see the same folders as this computer.

A task may be carried out twice, when a worker dies or is lost from sight: it finds the results of the first time, waits
for a process that is still writing them, or replaces unfinished ones. So each run has its results once, and complete.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import os
import secrets
import threading
import time
import warnings
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lab.errors import InputError, RunError
from lab.extras import needed
from lab.files.output.part_folder import removed_at_the_end
from lab.files.text.atomic_write import atomic_write_text
from lab.runs.batch.task import Task, TaskOutcome, displayed, failed_row, perform, program_digest
from lab.versions import versions

if TYPE_CHECKING:
    from distributed import Client

CONNECT_S = 15.0  # for the answer of the scheduler
WORKERS_S = 120.0  # without any worker, after which the batch ends
PATIENCE_S = 900.0  # for a worker that the scheduler has lost from sight and that still writes
_POLL_S, _CHECK_S, _RESULT_S = 0.05, 2.0, 30.0
_one_run_at_a_time = threading.Lock()  # of a worker process, however many threads it has


@dataclass(frozen=True, slots=True)
class _Shared:
    """What a worker must find as this computer does."""

    probe: str  # a file in the folder of the results
    token: str  # its content
    program: str  # digest of the sources
    versions: dict[str, str]

    def problem(self, folders: Sequence[str] = ()) -> str:
        """In which respect this process differs; empty if in none. folders: run folders that must be there."""
        try:
            seen = Path(self.probe).read_text("utf-8") == self.token
        except (OSError, ValueError):
            seen = False
        if not seen:
            return (
                f"expected the folder {displayed(os.path.dirname(self.probe))} of this computer, found none or another"
            )
        missing = [folder for folder in folders if not os.path.isdir(folder)]
        if missing:
            return f"expected the run folder {displayed(missing[0])}, found nothing there"
        own = versions()
        for name, expected in self.versions.items():
            if own.get(name) != expected:
                return f"expected {name} {expected}, found {own.get(name, 'none')}"
        if program_digest() != self.program:
            return "expected the same version of beampose, found other program files"
        return ""


@contextlib.contextmanager
def connected(address: str, out: Path) -> Iterator[Cluster]:
    """A connection to the cluster whose scheduler has this address, during the block.

    address: such as tcp://10.0.0.5:8786, or the file that `dask scheduler --scheduler-file` writes. out: the existing
    folder of the results.

    Raises:
        InputError: distributed is not installed, or the scheduler does not answer.
    """
    needed("cluster", "--dask")
    from distributed import Client

    out = Path(os.path.realpath(out))
    token = secrets.token_hex(16)
    probe = out / f".batch-{token[:8]}.shared"
    with contextlib.ExitStack() as stack:
        stack.enter_context(_quiet_library())
        try:
            client = Client(_address(address), timeout=CONNECT_S, set_as_default=False, name="beampose")
        except (OSError, ValueError, TypeError, ImportError, RuntimeError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(
                f"--dask {address}: expected the address of a Dask scheduler, got no answer ({reason});"
                " start one with `dask scheduler`, and workers with `dask worker`"
            ) from None
        stack.callback(_close, client)
        stack.enter_context(removed_at_the_end(probe))
        atomic_write_text(token, probe)
        yield Cluster(client, address, out, _Shared(str(probe), token, program_digest(), versions()))


def _address(text: str) -> str:
    """The address of the scheduler; that in its file, where the text names one. Raises ValueError, OSError."""
    if not os.path.isfile(text):
        if not text.strip():
            raise ValueError("the address is empty")
        return text
    try:
        address = json.loads(Path(text).read_text("utf-8"))["address"]
    except (ValueError, KeyError, TypeError):
        raise ValueError("this file is not one of `dask scheduler --scheduler-file`") from None
    return str(address)


@contextlib.contextmanager
def _quiet_library() -> Iterator[None]:
    """No log lines and warnings of the library: what the user can act on is a line of ours."""
    logger = logging.getLogger("distributed")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def _close(client: Client) -> None:
    with contextlib.suppress(Exception):  # the cluster may have gone
        client.close(timeout=5)


class Cluster:
    """A connected cluster: `check` it, then `performed` the tasks."""

    def __init__(self, client: Client, address: str, out: Path, shared: _Shared) -> None:
        self._client, self._address, self._out, self._shared = client, address, out, shared

    def check(self, tasks: Sequence[Task]) -> str:
        """Whether there are workers, all with this program, the result folder and the run folders. Returns a note.

        Raises:
            InputError: there is no worker, or one cannot process the runs. The message names it.
        """
        folders = [os.path.realpath(task.folder) for task in tasks]
        folders = [folder for folder in folders if os.path.isdir(folder)]
        try:
            self._client.wait_for_workers(1, timeout=CONNECT_S)
            answers = self._client.run(self._shared.problem, folders, on_error="return")
        except (OSError, TimeoutError, RuntimeError):
            raise InputError(
                f"--dask {self._address}: expected workers, found none in {CONNECT_S:.0f} s; start them with"
                f" `dask worker {self._address}`"
            ) from None
        for worker, answer in answers.items():
            if isinstance(answer, BaseException):
                first = (str(answer).splitlines() or [""])[0]
                answer = f"expected beampose as it is installed here; the worker reports {first}"
            if answer:
                raise InputError(f"--dask {self._address}: worker {worker}: {answer}")
        threads = max(self._client.nthreads().values(), default=1)
        if threads > 1:
            return f"a worker has {threads} threads but processes one run at a time; use --nthreads 1 --nworkers N"
        return ""

    def performed(self, tasks: Sequence[Task]) -> Generator[tuple[Task, TaskOutcome], None, None]:
        """Tasks with their outcomes, as they end. The generator must be closed: that cancels what has not begun.

        Raises:
            RunError: the cluster has gone, or has had no worker for a time.
        """
        from distributed import KilledWorker, as_completed

        sent = [self._sent(task) for task in tasks]
        futures = self._client.map(_in_worker, sent, [self._shared] * len(sent), key="beampose-run", pure=False)
        waiting = {future.key: (future, task) for future, task in zip(futures, tasks, strict=True)}
        done = as_completed(futures, loop=self._client.loop)
        del futures  # a future that is kept keeps its result in the cluster
        try:
            last_seen = last_check = time.monotonic()
            while waiting:
                batch = done.next_batch(block=False)
                for future in batch:
                    task = waiting[future.key][1]
                    try:
                        outcome = _as_here(future.result(timeout=_RESULT_S), task)
                    except KilledWorker:
                        outcome = TaskOutcome(failed_row(task, "the worker died each time: killed, or out of memory"))
                    except TimeoutError:
                        done.add(future)  # its worker died with the result: the task is carried out again
                        continue
                    except Exception as error:
                        if future.cancelled() or self._client.status != "running":
                            raise self._gone(len(waiting)) from None
                        text = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
                        outcome = TaskOutcome(failed_row(task, f"the cluster reports {text}"))
                    del waiting[future.key]
                    yield task, outcome
                now = time.monotonic()
                if now - last_check > _CHECK_S:
                    last_check = now
                    if self._has_workers(len(waiting)):
                        last_seen = now
                    elif now - last_seen > WORKERS_S:
                        raise self._gone(len(waiting), f"has had no worker for {WORKERS_S:.0f} s")
                if not batch:
                    time.sleep(_POLL_S)
        finally:
            with contextlib.suppress(Exception):
                done.clear()
                self._client.cancel([future for future, _ in waiting.values()], force=True)

    def _sent(self, task: Task) -> Task:
        """The task as a worker needs it: its working folder is another."""
        return dataclasses.replace(
            task, folder=Path(os.path.abspath(task.folder)), out=self._out, patience_s=PATIENCE_S
        )

    def _has_workers(self, left: int) -> bool:
        """Raises RunError: the scheduler has gone."""
        try:
            return bool(self._client.nthreads())
        except Exception:
            raise self._gone(left) from None

    def _gone(self, left: int, what: str = "has gone") -> RunError:
        return RunError(
            f"--dask {self._address}: the cluster {what}; {left} run{'s are' if left > 1 else ' is'} left; the same"
            " command continues when it is back"
        )


def _as_here(outcome: TaskOutcome, task: Task) -> TaskOutcome:
    """An outcome with the run folder as the command names it, as from a process of this computer."""
    row = outcome.row
    here, there = displayed(task.folder), row["run"]
    return dataclasses.replace(outcome, row={**row, "run": here, "message": row["message"].replace(there, here)})


def _in_worker(task: Task, shared: _Shared) -> TaskOutcome:
    """Carries out a task in a worker, with as many threads as it has."""
    with _one_run_at_a_time, _threads(_threads_of_worker()):
        problem = shared.problem()  # the worker may have joined after the check
        return TaskOutcome(failed_row(task, f"the worker cannot process it: {problem}")) if problem else perform(task)


def _threads_of_worker() -> int:
    from distributed import get_worker

    return int(get_worker().state.nthreads)


@contextlib.contextmanager
def _threads(most: int) -> Iterator[None]:
    """Pictures are decoded and filtered by at most so many threads in this block."""
    import cv2

    from lab.pictures import source

    before: tuple[Any, ...] = cv2.getNumThreads(), source.THREADS
    cv2.setNumThreads(most)
    source.THREADS = min(source.THREADS, most)
    try:
        yield
    finally:
        cv2.setNumThreads(before[0])
        source.THREADS = before[1]
