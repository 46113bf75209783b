"""Worker processes of a batch: a process that dies costs its own run only, and none is left behind."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import time

import pytest

from lab.runs.batch.batch import THREAD_VARIABLES, performed, threads_per_process
from tests.marks import further_slow


def square_or_die(number: int) -> int:
    if number < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2


def thread_limits(_: int) -> list[str | None]:
    return [os.environ.get(name) for name in THREAD_VARIABLES]


def sleep(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def test_only_the_task_that_kills_its_process_has_no_result():
    with contextlib.closing(performed([1, -2, 3, 4], square_or_die, 2)) as results:
        assert dict(results) == {1: 1, -2: None, 3: 9, 4: 16}


def test_the_processes_together_use_every_processor_once(monkeypatch):
    for name in THREAD_VARIABLES[1:]:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(THREAD_VARIABLES[0], "7")
    with contextlib.closing(performed([0], thread_limits, 1)) as results:
        ((_, limits),) = results
    assert limits[0] == "7"  # the user's own limit
    assert set(limits[1:]) == {str(threads_per_process(1))}
    assert not set(THREAD_VARIABLES[1:]) & set(os.environ)
    for jobs in range(1, 200):
        assert 1 <= threads_per_process(jobs) <= max(1, threads_per_process(1) // jobs)


def _raise_at_the_first(error: type[BaseException]) -> None:
    with contextlib.closing(performed([0.0, 300.0, 300.0], sleep, 2)) as results:
        assert next(results) == (0.0, 0.0)
        raise error


@pytest.mark.parametrize("error", further_slow([KeyboardInterrupt, SystemExit]))
def test_an_interruption_of_the_parent_in_the_middle_ends_the_processes_at_once(error):
    before = set(multiprocessing.active_children())
    begun = time.monotonic()
    with pytest.raises(error):
        _raise_at_the_first(error)
    assert time.monotonic() - begun < 120
    assert set(multiprocessing.active_children()) <= before
