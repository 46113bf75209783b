"""`beampose run`, `watch` and `detect`: from pictures to results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lab.commands.common import (
    ANY_PATH,
    FOLDER,
    NumberRange,
    conclude,
    progress_bar,
    provenance,
    quiet_option,
    set_option,
    shown,
    verbose_option,
)

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
@verbose_option
@quiet_option
@set_option
@click.pass_context
def run(
    ctx: click.Context,
    /,
    run_folder: Path,
    out: Path,
    full_hash: bool,
    verbose: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Process one run folder: tables, summary.json, report.html and run.log.

    \b
    Example:
        beampose run sample_runs/huo2015 --out results/huo2015
    """
    from lab.files.run.fingerprints import fingerprints
    from lab.files.run.run_file import Run
    from lab.runs.process import process_run

    def more(of: Run) -> dict[str, Any]:
        return provenance(ctx) | ({"inputs": fingerprints(of, full=True)} if full_hash else {})

    # Of the earlier results in this folder, with the option that makes it again.
    added = [(p, option) for name, option in _ADDED.items() for p in sorted(out.glob(name))]
    with shown(run_folder.name, verbose=verbose, quiet=quiet) as progress:
        outcome = process_run(run_folder, out, progress=progress, more=more, **options)
    gone = "removed with the earlier results; make it again with `beampose report"
    conclude(outcome, quiet=quiet, notes=[f"{path}: {gone} {out} {option}`" for path, option in added])


@click.command()
@click.argument("pictures", metavar="IMAGES_OR_VIDEO...", nargs=-1, required=True, type=ANY_PATH)
@click.option("--out", required=True, type=FOLDER, help="Gets detections.csv, contact-sheet.png and report.html.")
@click.option("--camera", help="The camera's name in the table; default: that of the folder or file.")
@click.option("--every", default=1, show_default=True, type=click.IntRange(min=1), help="Use every N-th picture only.")
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

    with progress_bar("pictures") as progress:
        outcome = detect_pictures(list(pictures), out, DetectOptions(**options), progress)
    conclude(outcome)


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
    "--idle",
    default=10.0,
    show_default=True,
    type=NumberRange(min=0.1),
    help="Seconds without a new picture after which the recording has ended.",
)
@click.option(
    "--timeout",
    default=0.25,
    show_default=True,
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

    RUN is a run folder whose frame folders receive pictures, or whose run.yaml names a `device` for a camera (a number
    or name that OpenCV opens). Each pose is appended to attitude_live.csv in the folder --out. When the recording
    ends (--idle, Ctrl-C, end of the device), the results of `run` are written from the received pictures.

    \b
    Example:
        beampose watch runs/today --out results/today --stream udp:127.0.0.1:5005
    """
    from lab.runs.watch.live_frames import WatchOptions
    from lab.runs.watch.watch import stopped_by_ctrl_c, watch_run

    with shown(run_folder.name, verbose=verbose, quiet=quiet) as progress, stopped_by_ctrl_c() as stop:
        waiting, typed = WatchOptions(idle, timeout), provenance(ctx)
        outcome = watch_run(run_folder, out, options=waiting, progress=progress, stop=stop, provenance=typed, **options)
    conclude(outcome, quiet=quiet)
