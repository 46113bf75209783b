"""A function called for many jobs, in this process or in several."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from multiprocessing import get_context
from typing import TypeVar

Job = TypeVar("Job")
Result = TypeVar("Result")


def results_of(function: Callable[[Job], Result], jobs: Sequence[Job], processes: int) -> Iterator[Result]:
    """The results in the order of the jobs. function: not of a `__main__`, which others do not import."""
    if processes == 1:
        yield from map(function, jobs)
        return
    with get_context("spawn").Pool(processes) as pool:
        yield from pool.imap(function, jobs)
