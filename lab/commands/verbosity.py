"""What a run shows while it works: a progress bar, the lines of its log (--verbose), or nothing (--quiet)."""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Callable, Iterator

import click

from lab.commands.common import progress_bar


class _Lines(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        print(record.getMessage(), file=sys.stderr, flush=True)


@contextlib.contextmanager
def shown(name: str, *, verbose: bool, quiet: bool) -> Iterator[Callable[..., None] | None]:
    """The callback for the progress of a run; None without a progress bar.

    Raises:
        click.UsageError: both options are given.
    """
    if verbose and quiet:
        raise click.UsageError("expected --verbose or --quiet, got both")
    if quiet:
        yield None
    elif verbose:
        from lab.runs.run_log import LOGGER

        handler = _Lines()
        LOGGER.addHandler(handler)
        try:
            yield None
        finally:
            LOGGER.removeHandler(handler)
    else:
        with progress_bar(name) as progress:
            yield progress
