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
        beampose stereo runs/drogue --out results/drogue
    """
    from lab.binocular.process_stereo import process_stereo_run

    with progress_bar(run_folder.name) as progress:
        outcome = process_stereo_run(run_folder, out, progress)
    conclude(outcome)


@click.command()
@click.argument("left", type=ANY_PATH)
@click.argument("right", type=ANY_PATH)
@click.option("--board", required=True, help="The board in the photos: as for `calibrate board`, or a board.yaml.")
@click.option("--out", required=True, type=FOLDER, help="Gets pair.yaml, pairs.csv and report.html.")
@click.option("--names", default="left,right", show_default=True, help="Names of the two cameras.")
@click.option("--lens", default="auto", show_default=True, help="0, 4, 5, 8, 12 or fisheye; auto: by views held out.")
@click.option(
    "--valid-days",
    default=365,
    show_default=True,
    type=click.IntRange(min=1),
    help="Validity of the calibration, days.",
)
def pair(left: Path, right: Path, board: str, out: Path, names: str, lens: str, valid_days: int) -> None:
    """Calibrate two cameras and their relative pose from photos of a board, for `beampose stereo`.

    LEFT and RIGHT: a folder of photos or a pattern. Photos of one instant have the same number in their names.

    \b
    Example:
        beampose calibrate pair boards/left boards/right --board chessboard:9x6:25mm --out results/pair
    """
    from lab.calibrate.pair.pair import PairOptions, calibrate_pair_folder
    from lab.errors import InputError

    both = [name.strip() for name in names.split(",")]
    if len(both) != 2 or not all(both):
        raise InputError(f"--names: expected two names with a comma between them, got {names!r}")
    options = PairOptions((both[0], both[1]), lens, valid_days)
    with progress_bar("photos") as progress:
        shown = None if progress is None else lambda done, total, _: progress(done, total)
        outcome = calibrate_pair_folder(left, right, board, out, options, progress=shown)
    conclude(outcome)
