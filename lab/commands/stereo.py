"""`beampose stereo`: the pose of a target with coloured markers from a pair of cameras."""

from __future__ import annotations

from pathlib import Path

import click

from lab.commands.common import ANY_PATH, FOLDER, conclude, progress_bar


@click.command()
@click.argument("run_folder", metavar="RUN", type=ANY_PATH)
@click.option("--out", required=True, type=FOLDER, help="Where the results go; earlier results there are replaced.")
def stereo(run_folder: Path, out: Path) -> None:
    """Pose of a target with coloured markers from the pictures of two cameras.

    RUN is a folder whose run.yaml has the schema beampose/stereo/1: the calibrated pair, the pictures of both cameras,
    and the markers with their colours. `beampose simulate stereo-drogue --out runs/drogue` writes an example. Results:
    attitude.csv, covariance.csv, points.csv, spots.csv, detections.csv, summary.json and report.html.

    \b
    Example:
        beampose stereo sample_runs/stereo-drogue --out results/drogue
    """
    from lab.binocular.process_stereo import process_stereo_run

    with progress_bar(run_folder.name) as progress:
        outcome = process_stereo_run(run_folder, out, progress)
    conclude(outcome)
