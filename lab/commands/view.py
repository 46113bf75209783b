"""`beampose view`: a rig, a run or results in three dimensions."""

from __future__ import annotations

from pathlib import Path

import click

from lab.commands.common import ANY_PATH, FOLDER, NumberRange, complain, show_line


@click.command()
@click.argument("path", type=ANY_PATH)
@click.option("--out", type=FOLDER, help="Write files here and open no window. Without a display: results/view.")
@click.option("--frame", type=int, help="Frame number of the beams and spots; default: the middle one.")
@click.option("--rig", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="Instead of the run's rig.")
@click.option(
    "--sigma-scale",
    type=NumberRange(min=0, max=1e9, min_open=True),
    help="Size of the sigma ellipsoids; default: a round number that makes them visible.",
)
def view(path: Path, out: Path | None, frame: int | None, rig: Path | None, sigma_scale: float | None) -> None:
    """Show a rig.yaml, a run folder or results in three dimensions.

    Screens, cameras with their fields of view, beams, spots and the trajectory with sigma ellipsoids. Opens a window
    where there is a display: space plays, arrow keys step, and with a driver of Vulkan it has a slider. Otherwise, or
    with --out, it writes view.html to turn and play in a browser, scene.glb, scene.ply and pictures.

    \b
    Example:
        beampose view sample_runs/huo2015 --out results/view
    """
    from lab.view.view import show

    done = show(path, out, frame=frame, rig=rig, sigma_scale=sigma_scale)
    for file in done.files:
        show_line(str(file))
    for note in done.notes:
        complain(note)
