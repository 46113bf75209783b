"""`beampose batch`: many runs in one command."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click

from lab.commands.common import (
    ANY_PATH,
    FOLDER,
    check_verbosity,
    complain,
    progress_bar,
    provenance,
    quiet_option,
    set_option,
    show_line,
    silenced,
)
from lab.commands.run import causal_option
from lab.errors import BeamposeError

Shown = Callable[[int, int, int], None]


def _shard(ctx: click.Context, parameter: click.Parameter, value: str | None) -> str | None:
    """The text, checked: it is also part of the recorded command."""
    from lab.runs.batch.task import shard_of

    try:
        shard_of(value or "1/1")
    except BeamposeError as error:
        raise click.BadParameter(str(error).removeprefix("--shard: "), ctx=ctx, param=parameter) from None
    return value


@click.command()
@click.argument("runs", metavar="RUN...", nargs=-1, type=ANY_PATH)
@click.option("--list", "lists", multiple=True, type=ANY_PATH, help="A text file with a run per line; - is stdin.")
@click.option("--out", required=True, type=FOLDER, help="Gets one folder per run, batch.csv and index.html.")
@click.option("--jobs", default=1, show_default=True, type=click.IntRange(1, 1024), help="Processes at the same time.")
@click.option("--force", is_flag=True, help="Process all runs again, also those that are done.")
@click.option("--shard", metavar="I/N", callback=_shard, help="Only the I-th of N parts of the runs, for array jobs.")
@click.option("--full-hash", is_flag=True, help="Compare all bytes of pictures and videos with --out, not samples.")
@click.option(
    "--parquet", is_flag=True, help="Also write all attitudes and spots as Parquet data sets (needs pyarrow)."
)
@causal_option
@click.option("--verbose", "-v", is_flag=True, help="Show the lines of each run's log on standard error when it ends.")
@quiet_option
@set_option
@click.pass_context
def batch(
    ctx: click.Context,
    /,
    runs: tuple[Path, ...],
    lists: tuple[Path, ...],
    out: Path,
    shard: str | None,
    verbose: bool,
    quiet: bool,
    **chosen: Any,
) -> None:
    """Process many run folders; a run that fails does not stop the others.

    RUN is a run folder, a pattern such as 'data/*/run-*', or @FILE, a text file with a run per line. A run whose
    results in --out have the same inputs, settings, calibration and version is skipped: after an interruption, the
    same command continues. Several batches may use one --out: on a cluster, start one with --shard I/N on each
    computer.

    \b
    Example:
        beampose batch sample_runs/huo2015 sample_runs/damaged --out results/all
    """
    if not runs and not lists:
        raise click.UsageError("Missing argument 'RUN...'.", ctx)
    check_verbosity(verbose=verbose, quiet=quiet)
    from lab.runs.batch.batch import BatchOptions, process_batch
    from lab.runs.batch.task import shard_of

    options = BatchOptions(shard=shard_of(shard or "1/1"), provenance=provenance(ctx), **chosen)
    line = _printer()

    def log(text: str) -> None:
        if verbose:
            print(text, file=sys.stderr, flush=True)

    with _progress() if not quiet else silenced() as progress:
        outcome = process_batch(
            runs,
            out,
            options,
            lists=lists,
            report=_nowhere if quiet else line,
            complain=complain if quiet else line,
            log=log,
            progress=progress or _nowhere,
        )
    if not quiet:
        if outcome.skipped:
            line(f"done already: {outcome.skipped} of {len(outcome.rows)} runs; --force processes them again")
        line(f"table: {outcome.table}")
        line(f"index: {outcome.index}")
    sys.exit(outcome.exit_status)


def _nowhere(*_: object) -> None:
    """Shows nothing."""


def _printer() -> Callable[[str], None]:
    """Prints lines; when the reader has gone (`beampose batch ... | head`), the batch goes on without them."""
    gone = False

    def line(text: str) -> None:
        nonlocal gone
        if gone:
            return
        try:
            show_line(text)
        except BrokenPipeError:
            gone = True
            with contextlib.suppress(OSError, ValueError):  # what is left in the buffer must go somewhere
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())

    return line


@contextlib.contextmanager
def _progress() -> Iterator[Shown]:
    """A bar with the number of runs, the rate and the remaining time, on a terminal only."""
    begun = time.monotonic()
    with progress_bar("runs") as bar:

        def show(done: int, processed: int, total: int) -> None:
            if bar is not None:
                bar(done, total, pace(processed, total - done, time.monotonic() - begun))

        yield show


def pace(processed: int, left: int, seconds: float) -> str:
    """Rate and remaining time, such as `12.5 runs/min, 1 h 20 min left`; empty before the first run has ended."""
    if processed == 0 or seconds <= 0:
        return ""
    rate = processed / seconds
    minutes = left / rate / 60
    remaining = f"{minutes * 60:.0f} s" if minutes < 1 else f"{minutes:.0f} min"
    if minutes >= 60:
        remaining = f"{int(minutes // 60)} h {int(minutes % 60)} min"
    speed = f"{rate * 60:.1f} runs/min" if rate * 60 >= 1 else f"{rate * 3600:.1f} runs/h"
    return f"{speed}, {remaining} left"
