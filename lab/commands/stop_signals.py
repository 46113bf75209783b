"""SIGTERM and SIGHUP end a command as Ctrl-C does: unfinished results are removed, no traceback is shown."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from lab.files.output.part_folder import remove_unfinished

_GRACE_S = 5.0  # for the regular end; Docker kills after 10 s, Slurm after 30 s

_SIGNALS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]  # Windows: no SIGHUP


_received: list[int] = []  # number of the signal that came


class StoppedBySignal(SystemExit):
    """Ends the program with the status that a shell reports for a signal: 128 + its number."""

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)
        self.name = signal.Signals(number).name


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Raises StoppedBySignal in the block when SIGTERM or SIGHUP comes. Ignored signals (nohup) stay ignored.

    The exception may be lost (in a callback, in a destructor), and threads may go on. So after some seconds, or at a
    second signal, unfinished results are removed and the process ends at once.
    """
    ours = []
    if threading.current_thread() is threading.main_thread():
        ours = [number for number in _SIGNALS if signal.getsignal(number) == signal.SIG_DFL]
        for number in ours:
            signal.signal(number, _first)
    try:
        yield
    except StoppedBySignal:
        remove_unfinished()  # what a signal at the entry of a block's end has left
        raise
    finally:
        _received.clear()
        for number in ours:
            if signal.getsignal(number) == _first:  # no signal came
                signal.signal(number, signal.SIG_DFL)


@contextmanager
def stops_are_no_errors() -> Iterator[None]:
    """Raises StoppedBySignal in place of an error to which a library has turned it.

    A compiled function in which the signal arrives ends with SystemError ("returned a result with an exception set").
    """
    try:
        yield
    except Exception as error:
        if _received:
            raise StoppedBySignal(_received[0]) from error
        raise


def _first(number: int, _frame: FrameType | None) -> None:
    """Raises StoppedBySignal, and prepares for the case that it does not arrive."""
    _received.append(number)
    for each in _SIGNALS:
        if signal.getsignal(each) == _first:
            signal.signal(each, _last)
    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGALRM, lambda *_: _last(number, None))
        signal.setitimer(signal.ITIMER_REAL, _GRACE_S)
    raise StoppedBySignal(number)


def _last(number: int, _frame: FrameType | None) -> None:
    """Ends the process now."""
    remove_unfinished()
    os._exit(128 + number)
