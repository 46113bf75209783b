"""`beampose calibrate`: one command per calibration step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lab.commands.common import (
    ANY_PATH,
    FOLDER,
    Commands,
    ImageSize,
    NumberRange,
    carry_out,
    complete_rigs,
    conclude,
    read_settings,
    seed_option,
    show_line,
    valid_days_option,
)


@click.group(cls=Commands)
def calibrate() -> None:
    """Calibrate cameras, screens and beams, and check an existing calibration.

    Each step writes its numbers with their covariance, and a report with the verdict PASS, WARN or FAIL, the reason and
    the remedy. Exit status: 0 for PASS and WARN, 3 for FAIL.

    \b
    Example:
        beampose calibrate board chessboard:9x6:25mm --out board
    """


@calibrate.command()
@click.argument("board")
@click.option("--out", required=True, type=ANY_PATH, help="A folder, or one file ending in .pdf, .svg or .png.")
@click.option("--page", default="A4", help="A4, A3 ..., or fit: the size of the board.")
@click.option("--dpi", default=300.0, type=NumberRange(50, 2400), help="Resolution of the PNG.")
def board(board: str, out: Path, page: str, dpi: float) -> None:
    """Write a printable board to exact scale, and board.yaml.

    BOARD: chessboard:9x6:25mm (inner corners), circles:10x10:12mm, acircles:4x11:20mm,
    charuco:5x7:40mm:20mm:DICT_4X4_50 (with :inverted for white on black), or a board.yaml.

    \b
    Example:
        beampose calibrate board charuco:5x7:36mm:18mm:DICT_4X4_50 --out board
    """
    from lab.calibrate.board import write_board

    conclude(write_board(board, out, page=page, dpi=dpi))


@calibrate.command()
@click.argument("photos", nargs=-1, required=True, type=ANY_PATH)
@click.option("--board", required=True, help="The board in the photos: as for `calibrate board`, or a board.yaml.")
@click.option("--out", required=True, type=FOLDER, help="Gets camera.yaml, corners.csv and report.html.")
@click.option("--name", help="The camera's name; default: that of the folder --out.")
@click.option("--distance-m", type=NumberRange(min=0, min_open=True), help="Distance to the screen, for figures in mm.")
@click.option("--lens", default="auto", help="0, 4, 5, 8, 12 or fisheye; auto: by the error of directions.")
@click.option("--warp", default="auto", help="auto, on, off: whether the bending of the board is solved for.")
@click.option(
    "--stretch", default="auto", help="auto, on, off: whether the ratio of the board's x and y scales is solved for."
)
@click.option(
    "--image-size", "image_size_px", type=ImageSize(), metavar="WxH", help="Of the pictures of a table of corners, px."
)
@valid_days_option
def camera(photos: tuple[Path, ...], board: str, out: Path, name: str | None, **options: Any) -> None:
    """Calibrate a camera's lens from photos of a board: files, folders, patterns or a video.

    Or from a table of corners: mrcal's corners.vnl, or a CSV with view,id,u_px,v_px; --image-size is then required.

    \b
    Example:
        beampose calibrate camera campaign/photos/left --board campaign/board.yaml --out results/left
    """
    from lab.calibrate.camera.camera import CameraOptions, calibrate_camera

    chosen = CameraOptions(name=name or out.resolve().name, **options)
    carry_out("photos", lambda progress: calibrate_camera(photos, board, out, chosen, progress=progress))


_project = click.argument("project", type=ANY_PATH)


@calibrate.command()
@_project
@click.option("--out", required=True, type=FOLDER, help="Gets screens.yaml, tables and report.html.")
def screen(project: Path, out: Path) -> None:
    """Poses of screens and cameras from surveyed dots, boards and scanned clouds. PROJECT: a calibration.yaml.

    \b
    Example:
        beampose calibrate screen campaign/calibration.yaml --out results/screens
    """
    from lab.calibrate.screens.screen import calibrate_screen

    carry_out("survey", lambda progress: calibrate_screen(project, out, progress=progress))


@calibrate.command()
@_project
@click.option("--out", required=True, type=FOLDER, help="Gets rig.yaml, beams.csv, tables and report.html.")
@click.option("--rig", type=ANY_PATH, help="Calibrated cameras and screens; default: the rig.yaml next to the project.")
def beams(project: Path, out: Path, rig: Path | None) -> None:
    """Beams in the vehicle from recordings at known or unknown poses of the stand.

    \b
    Example:
        beampose calibrate beams campaign/calibration.yaml --rig results/screens/rig.yaml --out results/beams
    """
    from lab.calibrate.beams.beams import calibrate_beams

    conclude(calibrate_beams(project, out, rig))


@calibrate.command()
@_project
@click.option("--out", required=True, type=FOLDER, help="Gets rig.yaml with its joint covariance, and report.html.")
def rig(project: Path, out: Path) -> None:
    """Solve cameras, screens and beams together, and write the rig.yaml that runs use.

    \b
    Example:
        beampose calibrate rig campaign/calibration.yaml --out results/rig
    """
    from lab.calibrate.rig.rig import calibrate_rig

    carry_out("survey, screens and beams", lambda progress: calibrate_rig(project, out, progress=progress))


@calibrate.command("check")
@click.argument("rig", type=ANY_PATH)
@click.option("--out", required=True, type=FOLDER, help="Gets drift.csv and report.html.")
@click.option("--points", type=ANY_PATH, help="Pixels of known points: camera,point,u_px,v_px[,sigma_px].")
@click.option("--survey", type=ANY_PATH, help="Coordinates of the points: point,x_m,y_m,z_m[,sigmas].")
@click.option("--run", type=ANY_PATH, help="Or a recording of a vehicle at rest, or its results ...")
@click.option("--pose", type=ANY_PATH, help="... at a known pose: a CSV like truth/pose.csv.")
@click.option("--history", type=ANY_PATH, help="A CSV to which this check is added, for the trend.")
def check(rig: Path, out: Path, history: Path | None, **inputs: Path | None) -> None:
    """Check whether a calibration still holds: drift per camera in px and mm; exit status 3: do not use it.

    \b
    Example:
        beampose calibrate check results/rig/rig.yaml --points points.csv --survey survey.csv --out results/today
    """
    from lab.calibrate.drift_check.drift_check import check_drift
    from lab.calibrate.drift_check.drift_inputs import DriftInputs

    conclude(check_drift(rig, out, DriftInputs(**inputs), history=history))


def _groups(ctx: click.Context, parameter: click.Parameter, text: str | None) -> tuple[str, ...]:
    """Names separated by commas."""
    return tuple(part.strip() for part in text.split(",")) if text else ()


@click.command()
@click.argument("runs", nargs=-1, required=True, type=ANY_PATH, metavar="RUN...")
@click.option("--rig", "rig_path", required=True, type=ANY_PATH, help="The rig.yaml to refine, in place of the runs'.")
@click.option("--out", required=True, type=FOLDER, help="Gets rig.yaml, residuals.csv and report.html.")
@click.option(
    "--free",
    callback=_groups,
    metavar="GROUP,...",
    help="Of cameras, screens, beams, lens, clocks, shutter: what changes; default: all of which a sigma is known.",
)
@click.option(
    "--sigma",
    "sigmas",
    multiple=True,
    metavar="NAME=VALUE",
    callback=read_settings,
    help="What is known of a part instead of the file's covariance; e.g. --sigma cameras.left.position_m=0.02.",
)
def refine(runs: tuple[Path, ...], rig_path: Path, out: Path, **options: Any) -> None:
    """Refine a rig by recordings, within what is known of it; exit status 3: there is no better rig.

    Poses of all frames and the rig are solved together. The new rig.yaml is written only if it predicts recordings (or
    blocks of time) better that were not used.

    \b
    Example:
        beampose refine runs/a runs/b --rig results/rig/rig.yaml --out results/refined
    """
    from lab.calibrate.refine.refine import refine_rig

    carry_out("recordings", lambda progress: refine_rig(runs, rig_path, out, progress=progress, **options))


@calibrate.command()
@click.argument("source", type=ANY_PATH)
@click.argument("destination", type=ANY_PATH)
@click.option("--from", "origin", help="Format of the source; default: by its content.")
@click.option("--to", "target", help="opencv, kalibr, ros, colmap, mrcal or beampose; default: by the name.")
@click.option("--camera", help="Which camera, if the source has several.")
def convert(source: Path, destination: Path, origin: str | None, target: str | None, camera: str | None) -> None:
    """Convert cameras between formats: OpenCV YAML, Kalibr, ROS, COLMAP, mrcal, camera.yaml; a rig.yaml as source.

    \b
    Example:
        beampose calibrate convert sample_runs/huo2015/rig.yaml camchain.yaml --to kalibr
    """
    from lab.files.rig.interchange import convert as convert_file

    conclude(convert_file(source, destination, origin, target, camera))


@calibrate.command("simulate")
@click.option("--out", required=True, type=FOLDER, help="The folder to write; it must not exist yet.")
@click.option(
    "--rig",
    default="fan",
    shell_complete=complete_rigs,
    help="A rig.yaml as designed, or fan, unequal-fan, two-cameras-per-screen, four-skew-beams.",
)
@seed_option
@click.option("--positions", default=40, type=click.IntRange(min=3), help="Number of stand positions.")
@click.option("--photos", is_flag=True, help="Also board photographs for `calibrate camera`.")
def simulate_campaign(out: Path, rig: str, seed: int, positions: int, photos: bool) -> None:
    """Write a simulated calibration campaign with its truth, to try the commands with.

    \b
    Example:
        beampose calibrate simulate --out campaign
    """
    from lab.simulate.campaign import simulate_calibration

    folder = simulate_calibration(out, seed=seed, rig=rig, positions=positions, photos=photos)
    show_line(f"project: {folder / 'calibration.yaml'}")
