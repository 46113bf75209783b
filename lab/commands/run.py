"""`beampose run`, `batch`, `watch`, `record`, `detect` and `pick`: from pictures to results."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click

from lab.commands.common import (
    ANY_PATH,
    FOLDER,
    ImageSize,
    NumberRange,
    carry_out,
    check_verbosity,
    complain,
    conclude,
    progress_bar,
    provenance,
    quiet_option,
    set_option,
    show_line,
    shown,
    silenced,
    stopped_by_ctrl_c,
    verbose_option,
)
from lab.errors import BeamposeError
from lab.findings.finding import Outcome

causal_option = click.option(
    "--causal", is_flag=True, help="No smoothing pass: attitude.csv has the poses as known at each instant."
)


_ADDED = {"overlay.*": "--video", "certificate.html": "--certificate"}  # by `report`, to results


@click.command()
@click.argument("run_folder", metavar="RUN", type=ANY_PATH)
@click.option("--out", required=True, type=FOLDER, help="Where the results go; earlier results there are replaced.")
@causal_option
@click.option(
    "--full-hash", is_flag=True, help="Fingerprint every byte of the inputs; otherwise large ones are sampled."
)
@click.option(
    "--refined",
    is_flag=True,
    help="First refine the rig by this run, into OUT-refined, as `refine` does; exit status 3: there is no better rig.",
)
@verbose_option
@quiet_option
@set_option
@click.pass_context
def run(
    ctx: click.Context,
    /,
    run_folder: Path,
    out: Path,
    refined: bool,
    verbose: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Process one run folder: tables, summary.json, report.html and run.log.

    \b
    Example:
        beampose run sample_runs/huo2015 --out results/huo2015
    """
    from lab.runs.process import process_run

    process: Callable[..., Outcome[Any]] = process_run
    if refined:
        from lab.calibrate.refine.refine import run_with_refined_rig

        process = run_with_refined_rig

    # Of the earlier results in this folder, with the option that makes it again.
    added = [(p, option) for name, option in _ADDED.items() for p in sorted(out.glob(name))]
    with shown(run_folder.name, verbose=verbose, quiet=quiet) as progress:
        outcome = process(run_folder, out, progress=progress, more=provenance(ctx), **options)
    gone = "removed with the earlier results; make it again with `beampose report"
    conclude(outcome, quiet=quiet, notes=[f"{path}: {gone} {out} {option}`" for path, option in added])


@click.command()
@click.argument("pictures", metavar="IMAGES_OR_VIDEO...", nargs=-1, required=True, type=ANY_PATH)
@click.option("--out", required=True, type=FOLDER, help="Gets detections.csv, contact-sheet.png and report.html.")
@click.option("--camera", help="The camera's name in the table; default: that of the folder or file.")
@click.option("--every", default=1, type=click.IntRange(min=1), help="Use every N-th picture only.")
@click.option("--limit", type=click.IntRange(min=1), help="Use at most this many pictures.")
@set_option
def detect(pictures: tuple[Path, ...], out: Path, **options: Any) -> None:
    """Find the spots in pictures or a video, without a rig: table, contact sheet, noise, sizes and signal.

    A folder of pictures, picture files, a pattern such as 'shots/*.png', or one video.

    \b
    Example:
        beampose detect sample_runs/huo2015/frames/left --every 10 --out results/spots
    """
    from lab.runs.detect.detect import DetectOptions, detect_pictures

    chosen = DetectOptions(**options)
    carry_out("pictures", lambda progress: detect_pictures(list(pictures), out, chosen, progress))


@click.command()
@click.argument("photos", metavar="PHOTO...", nargs=-1, required=True)
@click.option(
    "--out",
    default=Path("pick.html"),
    type=click.Path(dir_okay=False, path_type=Path),
    help="The page to write; open it in a browser.",
)
@click.option("--names", type=ANY_PATH, help="Names to choose from: a survey.csv with a column point, or a rig.yaml.")
@click.option("--table", type=ANY_PATH, help="A points.csv or spots.csv to continue with.")
@click.option("--darker", is_flag=True, help="Detect marks that are darker than what is around them.")
@set_option
def pick(photos: tuple[str, ...], out: Path, **options: Any) -> None:
    """Write a page on which points in photos get their names: points.csv and spots.csv by clicks.

    PHOTO is a picture or a folder of pictures, with the name of its camera before it: left=photos/l0.png. Without one
    the camera is called as the folder, or as a single file. The page shows all detected points with their sub-pixel
    positions; click one, type or choose its name, and download the table. It is one file that works without a
    network; nothing leaves the computer.

    \b
    Example:
        beampose pick left=sample_runs/huo2015/frames/left/000000.png --names sample_runs/huo2015/rig.yaml
    """
    from lab.runs.detect.detect import PickOptions, write_pick_page

    chosen = PickOptions(**options)
    carry_out("pictures", lambda progress: write_pick_page(photos, out, chosen, progress))


@click.command()
@click.argument("run_folder", metavar="RUN", type=ANY_PATH)
@click.option(
    "--out", required=True, type=FOLDER, help="Gets attitude_live.csv during the recording, and the results at the end."
)
@click.option("--udp", metavar="HOST:PORT", help="As --stream udp:HOST:PORT.")
@click.option(
    "--stream",
    "streams",
    multiple=True,
    metavar="KIND:ADDRESS",
    help="Also send each frame: udp:HOST:PORT or zmq:HOST:PORT (published there), as JSON; lsl:NAME. Repeatable.",
)
@click.option(
    "--page",
    metavar="[HOST:]PORT",
    help="Show pictures, spots, exposure and poses on a page: at this port, for this computer only without a HOST.",
)
@click.option(
    "--idle",
    default=10.0,
    type=NumberRange(min=0.1),
    help="Seconds without a new picture after which the recording has ended.",
)
@click.option(
    "--timeout",
    default=0.25,
    type=NumberRange(min=0.001),
    help="Seconds for which a frame waits for a camera whose picture is missing.",
)
@click.option("--reprocess", is_flag=True, help="At the end, process the finished folders as `run` does.")
@verbose_option
@quiet_option
@set_option
@click.pass_context
def watch(
    ctx: click.Context,
    /,
    run_folder: Path,
    out: Path,
    idle: float,
    timeout: float,
    verbose: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Process a run while it is recorded: the pose of every frame as it arrives.

    RUN is a run folder whose frame folders receive pictures, or whose run.yaml names a `device` for a camera (a source
    as of `record`). Each pose is appended to attitude_live.csv in the folder --out; a line per second has frames,
    measured poses and latency, and --page shows pictures and poses in a browser. When the recording ends (--idle,
    Ctrl-C, end of the device), the results of `run` are written from the received pictures.

    \b
    Example:
        beampose watch runs/today --out results/today --stream udp:127.0.0.1:5005
    """
    from lab.runs.watch.live_frames import WatchOptions
    from lab.runs.watch.watch import watch_run

    with shown(run_folder.name, verbose=verbose, quiet=quiet) as progress, stopped_by_ctrl_c() as stop:
        waiting, typed, line = WatchOptions(idle, timeout), provenance(ctx), None if quiet else show_line
        outcome = watch_run(
            run_folder, out, options=waiting, progress=progress, stop=stop, provenance=typed, line=line, **options
        )
    conclude(outcome, quiet=quiet)


def _sources(ctx: click.Context, parameter: click.Parameter, values: tuple[str, ...]) -> dict[str, str]:
    """NAME=SOURCE pairs; a name becomes a folder and a file."""
    out: dict[str, str] = {}
    for text in values:
        name, equals, source = text.partition("=")
        if not equals or not source or not re.fullmatch(r"\w[\w.-]*", name):
            raise click.BadParameter(f"expected NAME=SOURCE such as left=0, got {text!r}", ctx, parameter)
        if name in out:
            raise click.BadParameter(f"expected each camera once, got {name!r} twice", ctx, parameter)
        out[name] = source
    return out


@click.command()
@click.option("--camera", "cameras", required=True, multiple=True, metavar="NAME=SOURCE", callback=_sources,
              help="A camera and its source; once for each.")  # fmt: skip
@click.option("--out", required=True, type=FOLDER, help="The run folder to write; new or empty.")
@click.option("--rig", type=ANY_PATH, help="The rig.yaml of the run: it is copied, and names and sizes are compared.")
@click.option("--rate", "rate_hz", type=NumberRange(0.01, 1e5), help="Pictures per second, requested from cameras.")
@click.option("--seconds", type=NumberRange(0, 1e7, min_open=True), help="End after this time; default: by Ctrl-C.")
@click.option("--triggered", is_flag=True, help="One signal triggers all cameras: equal numbers are one instant.")
@click.option(
    "--exposure", "exposure_s", type=NumberRange(0, 10, min_open=True), help="Exposure time, s, for run.yaml."
)
@click.option("--size", "image_size_px", type=ImageSize(), metavar="WxH", help="Requested from devices, without --rig.")
@quiet_option
def record(cameras: dict[str, str], out: Path, quiet: bool, **options: Any) -> None:
    """Record cameras into a run folder: lossless pictures with the times of the camera's own clock.

    SOURCE is what OpenCV opens (a device's number or name, an address such as rtsp://..., a video file),
    `genicam:SERIAL` for cameras of the GenICam standard (needs harvesters), or `replay:PATH`: a folder of pictures
    shown as a camera would. A line per second counts pictures that were lost by the camera or not written. The folder
    is a valid run whenever the recording ends: by --seconds, Ctrl-C, an unplugged camera, a full disk.

    \b
    Example:
        beampose record --camera left=replay:sample_runs/huo2015/frames/left --seconds 1 --out recorded
    """
    from lab.runs.watch.record import RecordOptions
    from lab.runs.watch.record import record as record_cameras

    with stopped_by_ctrl_c("writing what is left") as stop:
        done = record_cameras(cameras, out, RecordOptions(**options), stop=stop, line=None if quiet else show_line)
    conclude(done, quiet=quiet)


# `beampose batch`: many runs in one command.


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
@click.option("--jobs", default=1, type=click.IntRange(1, 1024), help="Processes at the same time.")
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
