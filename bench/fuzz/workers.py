"""Processes that run the cases; one that crashes or hangs is replaced."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from collections.abc import Iterator
from multiprocessing.connection import Connection, wait
from pathlib import Path

from bench.fuzz.judge import Ending, run_case

WAIT_S = 300.0  # wall time: other programs may use the machine; the limit of a case is in process time


def _serve(pipe: Connection, seed: int, base: Path, work: Path) -> None:
    """The worker: runs the cases whose numbers arrive."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)  # messages of the video library
    with contextlib.suppress(EOFError):  # the program that gives the numbers has ended
        while (number := pipe.recv()) is not None:
            pipe.send(run_case(seed, number, base, work))


class _Worker:
    """A process that runs one case at a time."""

    def __init__(self, seed: int, base: Path, work: Path) -> None:
        self.arguments = (seed, base, work)
        self.number = -1
        self.start()

    def start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process = context.Process(
            target=_serve, args=(other, *self.arguments)
        )  # not a daemon: a view starts processes
        self.process.start()
        other.close()

    def give(self, number: int) -> None:
        self.number = number
        self.pipe.send(number)

    def ending(self) -> Ending:
        """The ending of the case that it runs; a crash or a hang restarts the process."""
        try:
            if self.pipe.poll(WAIT_S):
                return self.pipe.recv()  # type: ignore[no-any-return]
            fault = f"no end within {WAIT_S:.0f} s"
        except (EOFError, ConnectionError):
            fault = "the process ended"
        self.process.kill()
        self.process.join()
        self.start()
        return Ending(self.number, "?", (), -1, WAIT_S, fault)

    def end(self) -> None:
        """Ends the process."""
        self.process.kill()
        self.process.join()


def endings(numbers: range, seed: int, base: Path, folder: Path, jobs: int) -> Iterator[Ending]:
    """The endings of all cases, as they come."""
    workers = [_Worker(seed, base, folder / f"work-{n}") for n in range(jobs)]
    try:
        yield from _given(iter(numbers), workers)
    finally:
        for worker in workers:
            worker.end()


def _given(left: Iterator[int], workers: list[_Worker]) -> Iterator[Ending]:
    """Gives every worker a number as soon as it is free."""
    busy: dict[Connection, _Worker] = {}
    for worker in workers:
        if (number := next(left, None)) is not None:
            worker.give(number)
            busy[worker.pipe] = worker
    while busy:
        ready = [busy[p] for p in wait(list(busy), timeout=WAIT_S) if isinstance(p, Connection)]
        for worker in ready or list(busy.values()):
            del busy[worker.pipe]
            yield worker.ending()
            if (number := next(left, None)) is not None:
                worker.give(number)
                busy[worker.pipe] = worker
