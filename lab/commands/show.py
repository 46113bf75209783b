"""`beampose show`: one annotated picture."""

from __future__ import annotations

from pathlib import Path

import click

from lab.commands.common import FOLDER, complain, progress_bar, show_line


@click.command()
@click.argument("path", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--frame", required=True, type=int, help="Frame number.")
@click.option("--camera", help="Only this camera; default: all, side by side.")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="A .png file; default: frame-N.png.")
@click.option("--run", "run_folder", type=FOLDER, help="The run folder of the results, if it has moved.")
def show(path: Path, frame: int, camera: str | None, out: Path | None, run_folder: Path | None) -> None:
    """Draw what was found in one frame over its pictures.

    PATH is a folder of results; or a run folder, whose frames up to this one are then processed first. The picture
    shows detections, labelled spots with their status, predictions, and for each spot that is not measured where it
    can lie: along the uncertainty of the pose, and along the image of its beam.

    \b
    Example:
        beampose show results/huo2015 --frame 11 --out results/frame-11.png
    """
    from lab.overlay.show import show_frame, write_picture

    with progress_bar(path.name) as progress:
        shown = show_frame(path, frame, camera=camera, run_folder=run_folder, progress=progress)
    file = out or Path(f"frame-{frame}.png")
    write_picture(shown.image, file)
    show_line(f"picture: {file}")
    for note in shown.notes:
        complain(note)
