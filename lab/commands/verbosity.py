"""What a run shows while it works: a progress bar, the lines of its log (--verbose), or nothing (--quiet)."""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Callable, Iterator

import click

from lab.commands.common import StderrHandler, progress_bar

verbose_option = click.option(
    "--verbose", "-v", is_flag=True, help="Show the lines of run.log on standard error as they come."
)
quiet_option = click.option("--quiet", "-q", is_flag=True, help="Show nothing but errors.")


class _Lines(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        print(record.getMessage(), file=sys.stderr, flush=True)


@contextlib.contextmanager
def shown(name: str, *, verbose: bool, quiet: bool) -> Iterator[Callable[..., None] | None]:
    """The callback for the progress of a run; None without a progress bar.

    Raises:
        click.UsageError: both options are given.
    """
    check_verbosity(verbose=verbose, quiet=quiet)
    if quiet:
        with silenced():
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


def check_verbosity(*, verbose: bool, quiet: bool) -> None:
    """Raises click.UsageError where both options are given."""
    if verbose and quiet:
        raise click.UsageError("expected --verbose or --quiet, got both")


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Messages of the libraries, such as that they compile, are not shown on the terminal in this block."""
    handlers = [h for h in logging.getLogger("beampose").handlers if isinstance(h, StderrHandler)]
    before = [handler.level for handler in handlers]
    for handler in handlers:
        handler.setLevel(logging.ERROR)
    try:
        yield
    finally:
        for handler, level in zip(handlers, before, strict=True):
            handler.setLevel(level)
