"""Common parts of all commands: error messages and exit statuses, argument types, --set, the progress bar.

SIGTERM and SIGHUP end a command as Ctrl-C does: unfinished results are removed, no traceback is shown. None of them
interrupts LLVM.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import re
import shlex
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn, TextIO

import click

from lab.cycle_search import search_rarely
from lab.errors import BeamposeError
from lab.files.output.part_folder import remove_unfinished
from lab.files.text.error_text import printable
from lab.progress import Lines, Progress, heard

_GRACE_S = 5.0  # for the regular end; Docker kills after 10 s, Slurm after 30 s

_RETRY_S = 0.01  # LLVM loads a function in about that time

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
    ours: list[tuple[int, Any, Any]] = []  # number, handler before, handler in the block
    if threading.current_thread() is threading.main_thread():
        usual: list[tuple[int, Any, Any]] = [(number, signal.SIG_DFL, _first) for number in _SIGNALS]
        usual.append((signal.SIGINT, signal.default_int_handler, _ctrl_c))
        ours = [each for each in usual if signal.getsignal(each[0]) == each[1]]
        for number, _, handler in ours:
            signal.signal(number, handler)
    try:
        yield
    except StoppedBySignal:
        remove_unfinished()  # what a signal at the entry of a block's end has left
        raise
    finally:
        _received.clear()
        for number, before, handler in ours:
            if signal.getsignal(number) == handler:  # no signal came
                signal.signal(number, before)


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


def _outside_llvm(handler: Callable[[int, FrameType | None], None]) -> Callable[[int, FrameType | None], None]:
    """A handler of signals that waits for LLVM: an exception in one of its callbacks crashes the process."""

    def handle(number: int, frame: FrameType | None) -> None:
        files = (each.f_code.co_filename for each, _ in traceback.walk_stack(frame))
        if hasattr(signal, "setitimer") and any("llvmlite" in file for file in files):
            signal.signal(signal.SIGALRM, lambda _, later: handle(number, later))
            signal.setitimer(signal.ITIMER_REAL, _RETRY_S)
        else:
            handler(number, frame)

    return handle


@_outside_llvm
def _ctrl_c(_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


@_outside_llvm
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
    remove_unfinished()
    os._exit(128 + number)


@contextmanager
def stopped_by_ctrl_c(
    then: str = "computing the results (press Ctrl-C again to stop without results)",
) -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets; a second Ctrl-C stops the program as usual. then: what follows, in words."""
    stop = threading.Event()

    def end(*_: object) -> None:
        stop.set()
        signal.signal(signal.SIGINT, before)
        logging.getLogger("beampose").info(f"the recording ends; {then}")

    before = signal.signal(signal.SIGINT, end)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


if TYPE_CHECKING:
    from lab.findings.finding import Done, Outcome

FOLDER = click.Path(file_okay=False, path_type=Path)
ANY_PATH = click.Path(path_type=Path)
_ANY_LENGTH = 10_000  # of a first sentence
PIPE_CLOSED = 141  # 128 + SIGPIPE: the status that a shell reports for a program whose reader has gone


class NumberRange(click.FloatRange):
    """A finite number in a range; click's own range accepts nan."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"expected a finite number, got {value}.", param, ctx)
        return number


class ImageSize(click.ParamType[tuple[int, int]]):
    """Width and height of a picture as WxH, each at least so many px."""

    name = "size"

    def __init__(self, least: int = 1) -> None:
        self._least = least

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        match = re.fullmatch(r"(\d{1,6})[xX](\d{1,6})", str(value))
        if match is None or min(int(match[1]), int(match[2])) < self._least:
            self.fail(f"expected width and height in px such as 1920x1080, got {value!r}", param, ctx)
        return int(match[1]), int(match[2])


def show_line(text: str) -> None:
    """Prints a line on stdout; names of files and runs in it must not control the terminal."""
    click.echo(printable(text))


def _message(line: str) -> None:
    """Shows a message of the libraries below, such as that they compile."""
    print(f"beampose: {line}", file=sys.stderr)  # not by click, which writes into a progress bar


def _show_log_on_a_terminal() -> None:
    """Shows log messages where a progress bar is shown. Elsewhere, any line on stderr indicates a problem."""
    logger = logging.getLogger("beampose")
    if sys.stderr.isatty() and not logger.handlers:
        logger.addHandler(Lines(_message))
        logger.setLevel(logging.INFO)


def _open_standard_streams() -> None:
    """Opens the null device in place of standard streams that the caller closed.

    Otherwise Python sets them to None, and the next file that is opened gets their number: what a library writes to
    standard error would then end up in that file.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115 - open until the end


def _to_nowhere(*streams: TextIO) -> None:
    """Connects streams to the null device: what Python has in their buffers at exit must go somewhere."""
    null = os.open(os.devnull, os.O_WRONLY)
    for stream in streams:
        with contextlib.suppress(OSError, ValueError):
            os.dup2(null, stream.fileno())
    os.close(null)


@contextlib.contextmanager
def _quiet_when_the_reader_has_gone() -> Iterator[None]:
    """Ends the program without a message where the reader of stdout or stderr has gone (`beampose ... | head`)."""
    try:
        yield
    except BrokenPipeError:
        _to_nowhere(sys.stdout, sys.stderr)
        sys.exit(PIPE_CLOSED)


def complain(line: str) -> None:
    """Prints a line about an error to stderr. Where that fails (full disk, terminal closed), the exit status is kept.

    Raises BrokenPipeError.
    """
    try:
        click.echo(printable(f"beampose: {line}"), err=True)
    except BrokenPipeError:
        raise
    except OSError:
        _to_nowhere(sys.stderr)


class Commands(click.Group):
    """A group whose errors (the lab's own, click's and unforeseen ones) end as plain lines and an exit status."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        search_rarely()
        _open_standard_streams()
        _show_log_on_a_terminal()
        with _quiet_when_the_reader_has_gone(), _stop_is_a_line(), stopped_by_signals(), _errors_are_lines():
            sys.exit(super().main(*args, **{**kwargs, "standalone_mode": False}))

    # Here too, since click's own main turns a closed pipe into status 1 and EOFError into an interruption.

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        with _quiet_when_the_reader_has_gone(), _errors_are_lines():  # --help and --version are printed here
            return super().make_context(*args, **kwargs)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Lists the commands with the whole first sentence of each: click cuts it at the width of the terminal."""
        shown = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        rows = [(name, c.get_short_help_str(_ANY_LENGTH)) for name, c in shown if c is not None and not c.hidden]
        if rows:
            with formatter.section("Commands"):
                formatter.write_dl(rows)

    def invoke(self, ctx: click.Context) -> Any:
        with _quiet_when_the_reader_has_gone(), _errors_are_lines(), stops_are_no_errors():
            return super().invoke(ctx)


@contextlib.contextmanager
def _stop_is_a_line() -> Iterator[None]:
    """Says that a signal ended the command."""
    try:
        yield
    except StoppedBySignal as stop:
        complain(f"stopped by {stop.name}")
        raise


@contextlib.contextmanager
def _errors_are_lines() -> Iterator[None]:
    """Turns exceptions into lines on stderr and an exit status."""
    try:
        yield
    except click.exceptions.Exit:
        raise
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        sys.exit(error.exit_code)
    except click.UsageError as error:
        complain(error.format_message())
        if error.ctx:
            click.echo(f"Help: {error.ctx.command_path} --help", err=True)
        sys.exit(error.exit_code)
    except click.ClickException as error:
        complain(error.format_message())
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        complain("stopped")
        sys.exit(1)
    except BeamposeError as error:
        complain(str(error))
        sys.exit(error.exit_status)
    except MemoryError:
        complain("out of memory")
        sys.exit(1)
    except BrokenPipeError:
        raise
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        complain(f"{where}{error.strerror or error}")
        sys.exit(1)
    except Exception as error:
        from lab.files.output.saved_traceback import unexpected_error  # only where there is one

        complain(unexpected_error(error))
        sys.exit(1)


def read_settings(ctx: click.Context, parameter: click.Parameter, values: Sequence[str]) -> dict[str, Any]:
    """NAME=VALUE pairs; a value is read as in run.yaml."""
    from lab.files.text.yaml_text import parse_value  # only where there are such options

    out: dict[str, Any] = {}
    for text in values:
        name, equals, value = text.partition("=")
        if not equals or not name.strip():
            raise click.BadParameter(f"expected NAME=VALUE, got {text!r}", ctx=ctx, param=parameter)
        try:
            out[name.strip()] = parse_value(value, name.strip())
        except BeamposeError as error:
            raise click.BadParameter(str(error), ctx=ctx, param=parameter) from None
    return out


set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="NAME=VALUE",
    callback=read_settings,
    help="A tracker parameter in place of run.yaml's, e.g. --set r1_px=12 or --set detect.threshold_sigma=5.",
)


valid_days_option = click.option(
    "--valid-days", default=365, type=click.IntRange(min=1), help="Validity of the calibration, days."
)
seed_option = click.option("--seed", default=0, type=click.IntRange(min=0), help="The same seed gives the same bytes.")


@contextlib.contextmanager
def progress_bar(name: str) -> Iterator[Progress | None]:
    """A progress bar on a terminal, None elsewhere."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich import progress as rich
    from rich.console import Console

    shown = rich.TextColumn("{task.description}"), rich.BarColumn(), rich.MofNCompleteColumn()
    with rich.Progress(*shown, rich.TimeRemainingColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, total=None)

        def update(done: int, total: int | None, stage: str = "") -> None:
            bar.update(task, completed=done, total=total, description=f"{name}: {stage}" if stage else name)

        yield update


def conclude(outcome: Outcome[Any] | Done[Any], *, quiet: bool = False, notes: Sequence[str] = ()) -> NoReturn:
    """Prints an outcome and ends with its exit status. notes: further ones, for standard error."""
    if not quiet:
        if line := outcome.line():
            show_line(line)
        for note in (*outcome.notes, *notes):
            complain(note)
    sys.exit(outcome.exit_status)


def carry_out(name: str, work: Callable[[Progress | None], Outcome[Any] | Done[Any]]) -> NoReturn:
    """Does the work with a progress bar, and concludes."""
    with progress_bar(name) as progress:
        outcome = work(progress)
    conclude(outcome)


# What a run shows while it works: a progress bar, the lines of its log (--verbose), or nothing (--quiet).


verbose_option = click.option(
    "--verbose", "-v", is_flag=True, help="Show the lines of run.log on standard error as they come."
)
quiet_option = click.option("--quiet", "-q", is_flag=True, help="Show nothing but errors.")


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
        from lab.runs.run_log import NAME

        with heard(NAME, partial(print, file=sys.stderr, flush=True)):
            yield None
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
    handlers = [h for h in logging.getLogger("beampose").handlers if isinstance(h, Lines)]
    for handler in handlers:
        handler.setLevel(logging.ERROR)
    try:
        yield
    finally:
        for handler in handlers:
            handler.setLevel(logging.NOTSET)


# The command as it was typed, for summary.json and the log.


_MOST_ARGUMENTS = 20  # of a list of runs: each of its results records the command


def command_line(ctx: click.Context) -> str:
    """The command of a context with its arguments and the options that differ from their defaults."""
    words = ["beampose", *ctx.command_path.split()[1:]]
    options: list[str] = []
    for parameter in ctx.command.params:
        value = ctx.params.get(parameter.name or "")
        if isinstance(parameter, click.Argument):
            words += _arguments(value) if isinstance(value, tuple) else [str(value)]
        elif value not in (None, False, (), {}) and value != parameter.get_default(ctx):
            options += _option(max(parameter.opts, key=len), value)
    return shlex.join([*words, *options])


def _arguments(values: tuple[Any, ...]) -> list[str]:
    """The values of an argument; of a long list the first ones, and how many there are."""
    words = [str(v) for v in values]
    if len(words) <= _MOST_ARGUMENTS:
        return words
    return [*words[:_MOST_ARGUMENTS], f"... ({len(words)} in all)"]


def _option(name: str, value: Any) -> list[str]:
    if value is True:
        return [name]
    if isinstance(value, Mapping):  # --set
        return [word for key, inner in value.items() for word in (name, f"{key}={_as_yaml(inner)}")]
    values = value if isinstance(value, tuple) else (value,)
    return [word for v in values for word in (name, str(v))]


def _as_yaml(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value)


def provenance(ctx: click.Context) -> dict[str, Any]:
    """What summary.json records of the command: the line, and the folder that relative paths start from."""
    return {"command": command_line(ctx), "working_folder": str(Path.cwd())}


# Words that the shell completes (docs/shell_completion.md): scenarios, rigs and codes.


def complete_scenarios(ctx: click.Context, parameter: click.Parameter, begun: str) -> list[str]:
    """Scenarios of `simulate` that begin with `begun`."""
    from lab.simulate.scenarios import SCENARIOS

    return [name for name in ("list", *SCENARIOS) if name.startswith(begun)]


def complete_rigs(ctx: click.Context, parameter: click.Parameter, begun: str) -> list[str]:
    """Rigs of `calibrate simulate` that begin with `begun`."""
    from lab.simulate.scenarios import RIGS

    return [name for name in RIGS if name.startswith(begun)]


def complete_codes(ctx: click.Context, parameter: click.Parameter, begun: str) -> list[str]:
    """Codes of `explain` that begin with `begun`, in any case."""
    from lab.findings.finding import entries

    return [code for code in entries() if code.startswith(begun.upper())]
