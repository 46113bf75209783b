"""A function called for many jobs, in this process or in several."""

from __future__ import annotations

import sys
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


def shown_results(
    function: Callable[[Job], Result], jobs: Sequence[Job], processes: int, in_words: Callable[[Result], str] | None
) -> list[Result]:
    """As `results_of`; each is printed as soon as it is there. in_words None: their number, on a terminal."""
    out: list[Result] = []
    for result in results_of(function, jobs, processes):
        out.append(result)
        if in_words is not None:
            print(in_words(result), flush=True)
        elif sys.stderr.isatty():
            print(f"\r{len(out)} of {len(jobs)}", end="", file=sys.stderr, flush=True)
    return out
