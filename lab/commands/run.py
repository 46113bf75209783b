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

    videos = sorted(out.glob("overlay.*"))  # of the earlier results in this folder
    with shown(run_folder.name, verbose=verbose, quiet=quiet) as progress:
        outcome = process_run(run_folder, out, progress=progress, more=more, **options)
    gone = "removed with the earlier results; make it again with `beampose report"
    conclude(outcome, quiet=quiet, notes=[f"{video}: {gone} {out} --video`" for video in videos])


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
@click.argument("photos", metavar="PHOTO...", nargs=-1, required=True)
@click.option(
    "--out",
    default=Path("pick.html"),
    show_default=True,
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
    from lab.runs.detect.pick import PickOptions, write_pick_page

    with progress_bar("pictures") as progress:
        done = write_pick_page(photos, out, PickOptions(**options), progress)
    conclude(done)


@click.command()
@click.argument("run_folder", metavar="RUN", type=ANY_PATH)
@click.option(
    "--out", required=True, type=FOLDER, help="Gets attitude_live.csv during the recording, and the results at the end."
)
@click.option("--udp", metavar="HOST:PORT", help="Also send each frame there, as a line of JSON.")
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
        beampose watch runs/today --out results/today --udp 127.0.0.1:5005
    """
    from lab.runs.watch.live_frames import WatchOptions
    from lab.runs.watch.watch import stopped_by_ctrl_c, watch_run

    with shown(run_folder.name, verbose=verbose, quiet=quiet) as progress, stopped_by_ctrl_c() as stop:
        waiting, typed = WatchOptions(idle, timeout), provenance(ctx)
        outcome = watch_run(run_folder, out, options=waiting, progress=progress, stop=stop, provenance=typed, **options)
    conclude(outcome, quiet=quiet)
