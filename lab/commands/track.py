"""`beampose track`, `stereo` and `calibrate pair`: one target in the pictures of one camera or of two."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lab.commands.common import (
    ANY_PATH,
    FOLDER,
    Commands,
    NumberRange,
    carry_out,
    provenance,
    read_settings,
    valid_days_option,
)

if TYPE_CHECKING:
    from lab.targets.target import Target

# `beampose track`: one target through a video or a folder of pictures.

_PIXEL = NumberRange(-1e6, 1e6)
_near_option = click.option(
    "--near", "near_px", type=(_PIXEL, _PIXEL), metavar="U V", help="The target's centre at the start, within 20 px."
)
_rate_option = click.option(
    "--rate", "rate_hz", type=NumberRange(0.01, 1e6), help="Frames per second; default: the video's or table's, or 25."
)
_video_option = click.option(
    "--video", "overlay", is_flag=True, help="Also write overlay.mp4: the pictures with the target drawn into them."
)
_limit_option = click.option("--limit", type=click.IntRange(min=1), help="Use at most this many pictures.")


@click.group(cls=Commands)
def track() -> None:
    """Track one target through the pictures of one camera, without a rig.

    \b
    Example:
        beampose track circle drogue.avi --out results/drogue
    """


def _track(ctx: click.Context, target: Target[Any], given: Path, out: Path) -> None:
    from lab.targets.track import track_target

    carry_out(given.name, lambda progress: track_target(target, given, out, progress, provenance(ctx)))


@track.command()
@click.argument("pictures", metavar="VIDEO_OR_FOLDER", type=ANY_PATH)
@click.option("--out", required=True, type=FOLDER, help="Gets circle.csv, summary.json and report.html.")
@_near_option
@click.option(
    "--min-radius", "min_radius_px", default=7.0, type=NumberRange(4, 10_000), help="Smallest radius to look for, px."
)
@click.option(
    "--max-radius", "max_radius_px", type=NumberRange(4, 10_000), help="Largest one; default: half of the smaller side."
)
@click.option(
    "--edge",
    default="supported",
    type=click.Choice(["supported", "outer", "inner", "opening"]),
    help="Which edge, where a target has several: of the rim, of a thin rim's inner side, of the opening inside it.",
)
@_rate_option
@click.option(
    "--form",
    default="sound",
    type=click.Choice(["sound", "printed"]),
    help="Equations: corrected with a fit of the rim, or as printed in Zhou (2014).",
)
@click.option(
    "--detector",
    default="classical",
    type=click.Choice(["classical", "learned"]),
    help="What proposes circles: votes of gradients, or a network that was trained on rendered drogues.",
)
@_limit_option
@_video_option
@click.pass_context
def circle(ctx: click.Context, /, pictures: Path, out: Path, **options: Any) -> None:
    """Track a circle (the rim of a drogue, a ring, a disc): centre, radius, rates, sigmas and occlusion.

    The circle is found by itself in the first pictures. Where several circles fit equally well, none is chosen: state
    its place (--near) or its range of radii. Frames in which half of the target or more is hidden are predicted.

    \b
    Example:
        beampose track circle drogue.avi --out results/drogue --video
    """
    from lab.targets.circle import CircleOptions, CircleTarget

    _track(ctx, CircleTarget(CircleOptions(**options)), pictures, out)


# `beampose track drogue`: a refuelling drogue, by the learned detector and the light tracker.


@track.command()
@click.argument("pictures", metavar="VIDEO_OR_FOLDER", type=ANY_PATH)
@click.option("--out", required=True, type=FOLDER, help="Gets drogue.csv, summary.json and report.html.")
@_near_option
@click.option(
    "--every", "check_every", default=5, type=click.IntRange(1, 1000), help="Frames between two checks by the detector."
)
@click.option(
    "--min-diameter", "smallest_px", default=8.0, type=NumberRange(8, 10_000), help="Smallest diameter to look for, px."
)
@click.option(
    "--max-diameter",
    "largest_px",
    type=NumberRange(8, 10_000),
    help="Largest one; default: the picture's smaller side.",
)
@_rate_option
@_limit_option
@_video_option
@click.pass_context
def drogue(ctx: click.Context, /, pictures: Path, out: Path, **options: Any) -> None:
    """Track a refuelling drogue: centre, diameter, sigmas and confidence.

    A learned detector finds the drogue in the whole picture and checks it every few frames; in between, a light tracker
    follows its pattern. Drogues from 9 px on. Where several drogues are in view, none is chosen: state its place
    (--near). For the rim itself, with occlusion and ellipse, use `track circle --detector learned`.

    \b
    Example:
        beampose track drogue drogue.avi --out results/drogue --video
    """
    from lab.targets.drogue import DrogueOptions, DrogueTarget

    _track(ctx, DrogueTarget(DrogueOptions(**options)), pictures, out)


# `beampose track point`: the centre of one target.


@track.command()
@click.argument("source", metavar="VIDEO_OR_FOLDER_OR_CSV", type=ANY_PATH)
@click.option("--out", required=True, type=FOLDER, help="Gets track.csv, summary.json and report.html.")
@click.option(
    "--detector",
    default="spots",
    type=click.Choice(["spots", "darker", "brighter", "colour"]),
    help="Points of light, or larger targets: darker or brighter than what is around them, or of a colour. Not used for"
    " a table.",
)
@click.option("--colour", metavar="NAME", help="Of a coloured target: red, orange, yellow, green, cyan, blue, magenta,"
              " or #rrggbb.")  # fmt: skip
@_near_option
@_rate_option
@click.option("--camera", help="The camera, for a table with several.")
@_limit_option
@click.option(
    "--min-measured",
    default=0.5,
    type=NumberRange(min=0, max=1),
    help="Least share of measured frames; with less the exit status is 4.",
)
@_video_option
@click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="NAME=VALUE",
    callback=read_settings,
    help="A parameter, e.g. --set track.sigma_model_px=0.5, detect.threshold_sigma=5 or blobs.max_size_px=100.",
)
@click.pass_context
def point(ctx: click.Context, /, source: Path, out: Path, **options: Any) -> None:
    """Track the centre of one target: position, velocity and covariance in every frame.

    A video, a folder of pictures, or a CSV table with frame,u_px,v_px (such as detections.csv). A constant-velocity
    Kalman filter predicts the position where the target is hidden, and finds it again. Without --near the target is the
    only one, or the one that moves otherwise than the others; of two the brighter one, with sharp edges.

    \b
    Example:
        beampose track point sample_runs/huo2015/frames/left --out results/point
    """
    from lab.targets.point import PointOptions, PointTarget

    _track(ctx, PointTarget(PointOptions(**options)), source, out)


# `beampose track lamps`: the pose of a target with lamps.


@track.command()
@click.argument("pictures", metavar="VIDEO_OR_FOLDER", type=ANY_PATH)
@click.option(
    "--target",
    required=True,
    type=ANY_PATH,
    help="The lamps: markers: {NAME: {position_m: [X, Y, Z]}, ...}, four or more.",
)
@click.option("--camera", required=True, type=ANY_PATH, help="camera.yaml, or the file of another program.")
@click.option("--camera-name", help="The camera, where that file has several.")
@click.option("--out", required=True, type=FOLDER, help="Gets attitude.csv, covariance.csv, summary.json, report.html.")
@click.option(
    "--detector",
    default="spots",
    type=click.Choice(["spots", "harris"]),
    help="What finds lights: as for laser spots, or the corners of Fu (2016).",
)
@_rate_option
@_limit_option
@_video_option
@click.pass_context
def lamps(ctx: click.Context, /, pictures: Path, out: Path, **options: Any) -> None:
    """Pose of a target with lamps at known places, from the pictures of one calibrated camera.

    The lamps look alike: which light is which follows from their places. Four must be visible in each measured frame;
    among other lights four are found after the lights have moved relative to each other, five at once. With more than
    18 other lights that are brighter than the lamps the target may not be found. The pose is in the camera's frame: x
    to the right, y down, z ahead.

    \b
    Example:
        beampose track lamps tanker.avi --target lamps.yaml --camera camera.yaml --out results/tanker
    """
    from lab.targets.stereo.lamps import LampsOptions, LampsTarget

    _track(ctx, LampsTarget(LampsOptions(**options)), pictures, out)


# `beampose stereo`: the pose of a target with coloured markers from a pair of cameras.


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
    from lab.targets.stereo.process import process_stereo_run

    carry_out(run_folder.name, lambda progress: process_stereo_run(run_folder, out, progress))


@click.command()
@click.argument("left", type=ANY_PATH)
@click.argument("right", type=ANY_PATH)
@click.option("--board", required=True, help="The board in the photos: as for `calibrate board`, or a board.yaml.")
@click.option("--out", required=True, type=FOLDER, help="Gets pair.yaml, pairs.csv and report.html.")
@click.option("--names", default="left,right", help="Names of the two cameras.")
@click.option("--lens", default="auto", help="0, 4, 5, 8, 12 or fisheye; auto: by views held out.")
@valid_days_option
def pair(left: Path, right: Path, board: str, out: Path, names: str, lens: str, valid_days: int) -> None:
    """Calibrate two cameras and their relative pose from photos of a board, for `beampose stereo`.

    LEFT and RIGHT: a folder of photos or a pattern. Photos of one instant have the same number in their names.

    \b
    Example:
        beampose calibrate pair boards/left boards/right --board chessboard:9x6:25mm --out results/pair
    """
    from lab.calibrate.camera.pair import PairOptions, calibrate_pair_folder
    from lab.errors import InputError

    both = [name.strip() for name in names.split(",")]
    if len(both) != 2 or not all(both):
        raise InputError(f"--names: expected two names with a comma between them, got {names!r}")
    options = PairOptions((both[0], both[1]), lens, valid_days)
    carry_out("photos", lambda progress: calibrate_pair_folder(left, right, board, out, options, progress=progress))
