"""`beampose check` and `report`: inputs checked, results shown."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from lab.commands.common import ANY_PATH, FOLDER, NumberRange, complain, progress_bar, show_line
from lab.errors import InputError


@click.command()
@click.argument("path", type=ANY_PATH)
def check(path: Path) -> None:
    """Check a rig.yaml or a run folder, and report which spots the cameras can see.

    \b
    Example:
        beampose check sample_runs/huo2015
    """
    from lab.runs.input_check.check import check as check_path

    with progress_bar(path.name) as progress:
        result = check_path(path, progress)
    for line in result.lines:
        show_line(line)
    sys.exit(result.exit_status)


@click.command()
@click.argument("results", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--run", "run_folder", type=FOLDER, help="The run folder, if it has moved.")
@click.option("--video", is_flag=True, help="Also write overlay.avi: all cameras with what was found drawn over them.")
@click.option("--from", "first", type=int, help="With --video: first frame number.")
@click.option("--to", "last", type=int, help="With --video: last frame number.")
@click.option("--every", type=click.IntRange(min=1), help="With --video: only each so many frames.")
@click.option("--fps", type=NumberRange(1, 240), help="With --video: its frames per second; default: 25.")
def report(
    results: Path,
    run_folder: Path | None,
    video: bool,
    first: int | None,
    last: int | None,
    every: int | None,
    fps: float | None,
) -> None:
    """Write report.html of a result folder again, with --video also a video of its pictures.

    \b
    Example:
        beampose report results/huo2015
        beampose report results/huo2015 --video --from 0 --to 30
    """
    if not video and (first, last, every, fps) != (None, None, None, None):
        raise click.UsageError("--from, --to, --every and --fps are of the video; add --video")
    from lab.report.run.page import write_report
    from lab.runs.process import are_results

    if not are_results(results):
        raise InputError(f"{results}: expected a folder that `beampose run` wrote, found no summary.json of one")
    show_line(f"report: {write_report(results, run_folder)}")
    if video:
        from lab.overlay.video import DEFAULT_FPS, write_video

        with progress_bar(results.name) as progress:
            done = write_video(
                results, run_folder, first=first, last=last, every=every or 1, fps=fps or DEFAULT_FPS, progress=progress
            )
        show_line(f"video: {done.path} ({done.frames} frames)")
        for note in done.notes:
            complain(note)
