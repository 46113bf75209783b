"""`beampose track point`: the centre of one target."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lab.commands.common import ANY_PATH, FOLDER, NumberRange, conclude, progress_bar, read_settings


def _place(ctx: click.Context, parameter: click.Parameter, value: str | None) -> tuple[float, float] | None:
    """U,V as two numbers."""
    if value is None:
        return None
    try:
        u, v = (float(part) for part in value.split(","))
    except ValueError:
        raise click.BadParameter(f"expected U,V in pixels such as 640,512, got {value!r}", ctx, parameter) from None
    if not abs(u) + abs(v) < 1e6:
        raise click.BadParameter(f"expected U,V in pixels such as 640,512, got {value!r}", ctx, parameter)
    return u, v


@click.command()
@click.argument("source", metavar="VIDEO_OR_FOLDER_OR_CSV", type=ANY_PATH)
@click.option("--out", required=True, type=FOLDER, help="Gets track.csv, summary.json and report.html.")
@click.option(
    "--detector",
    default="spots",
    show_default=True,
    type=click.Choice(["spots", "darker", "brighter", "colour"]),
    help="Points of light, or larger targets: darker or brighter than what is around them, or of a colour. Not used for"
    " a table.",
)
@click.option("--colour", metavar="NAME", help="Of a coloured target: red, orange, yellow, green, cyan, blue, magenta,"
              " or #rrggbb.")  # fmt: skip
@click.option("--start", metavar="U,V", callback=_place, help="Where the target is at the start, px; default: the"
              " brightest one.")  # fmt: skip
@click.option(
    "--frame-rate", type=NumberRange(min=1e-6, max=1e6), help="Pictures per second; default: that of the video or t_s."
)
@click.option("--camera", help="The camera, for a table with several.")
@click.option("--limit", type=click.IntRange(min=1), help="Use at most this many pictures.")
@click.option(
    "--min-measured",
    default=0.5,
    show_default=True,
    type=NumberRange(min=0, max=1),
    help="Least share of measured frames; with less the exit status is 4.",
)
@click.option("--overlay", is_flag=True, help="Also write overlay.mp4: the pictures with the track.")
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="NAME=VALUE",
    callback=read_settings,
    help="A parameter, e.g. --set track.sigma_model_px=0.5, detect.threshold_sigma=5 or blobs.max_size_px=100.",
)
def point(
    source: Path,
    out: Path,
    detector: str,
    colour: str | None,
    start: tuple[float, float] | None,
    frame_rate: float | None,
    camera: str | None,
    limit: int | None,
    min_measured: float,
    overlay: bool,
    settings: dict[str, Any],
) -> None:
    """Track the centre of one target: position, velocity and covariance in every frame.

    A video, a folder of pictures, or a CSV table with frame,u_px,v_px (such as detections.csv). A constant-velocity
    Kalman filter predicts the position where the target is hidden, and finds it again.

    \b
    Example:
        beampose track point sample_runs/huo2015/frames/left --out results/point
    """
    from lab.single_target.track_point import PointOptions, track_target

    options = PointOptions(detector, start, frame_rate, camera, limit, min_measured, overlay, settings, colour)
    with progress_bar("pictures") as progress:
        outcome = track_target(source, out, options, progress)
    conclude(outcome)
