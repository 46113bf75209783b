"""How a long step reports its progress, one type for all commands and for Python; and who gets lines of a log."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from typing import Protocol


class Progress(Protocol):
    """Called after each item of a long step; may raise, to stop it."""

    def __call__(self, done: int, total: int | None, stage: str = "", /) -> None:
        """done, total: number of items (frames, pictures, changes tried), the total where it is known.

        stage: the name of the step or of the item, where there is one.
        """


class Lines(logging.Handler):
    """Calls a function with each message of a logger."""

    def __init__(self, line: Callable[[str], object]) -> None:
        super().__init__()
        self._line = line

    def emit(self, record: logging.LogRecord) -> None:
        self._line(record.getMessage())


@contextlib.contextmanager
def heard(logger: str, line: Callable[[str], object]) -> Iterator[None]:
    """Calls `line` with the messages of a logger until the block ends."""
    handler = Lines(line)
    logging.getLogger(logger).addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger(logger).removeHandler(handler)
