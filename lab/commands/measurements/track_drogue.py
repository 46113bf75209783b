"""`beampose track drogue`: a refuelling drogue, by the learned detector and the light tracker."""

from __future__ import annotations

from pathlib import Path

import click

from lab.commands.common import ANY_PATH, FOLDER, NumberRange, conclude, progress_bar

_PIXEL = NumberRange(-1e6, 1e6)


@click.command()
@click.argument("pictures", metavar="VIDEO_OR_FOLDER", type=ANY_PATH)
@click.option("--out", required=True, type=FOLDER, help="Gets drogue.csv, summary.json and report.html.")
@click.option("--near", type=(_PIXEL, _PIXEL), metavar="U V", help="Centre of the first drogue, px, within 20 px.")
@click.option(
    "--every",
    default=5,
    show_default=True,
    type=click.IntRange(1, 1000),
    help="Frames between two checks by the detector.",
)
@click.option(
    "--min-diameter",
    default=8.0,
    show_default=True,
    type=NumberRange(8, 10_000),
    help="Smallest diameter to look for, px.",
)
@click.option("--max-diameter", type=NumberRange(8, 10_000), help="Largest one; default: the picture's smaller side.")
@click.option("--rate", type=NumberRange(0.01, 1e6), help="Frames per second; default: the video's, or 25.")
@click.option("--limit", type=click.IntRange(min=1), help="Use at most this many pictures.")
@click.option("--video", is_flag=True, help="Also write overlay.avi: the pictures with the drogue drawn into them.")
@click.pass_context
def drogue(
    ctx: click.Context,
    pictures: Path,
    out: Path,
    near: tuple[float, float] | None,
    every: int,
    min_diameter: float,
    max_diameter: float | None,
    rate: float | None,
    limit: int | None,
    video: bool,
) -> None:
    """Track a refuelling drogue: centre, diameter, sigmas and confidence.

    A learned detector finds the drogue in the whole picture and checks it every few frames; in between, a light tracker
    follows its pattern. Drogues from 9 px on. Where several drogues are in view, none is chosen: state its place
    (--near). For the rim itself, with occlusion and ellipse, use `track circle --detector learned`.

    \b
    Example:
        beampose track drogue drogue.avi --out results/drogue --video
    """
    from lab.commands.command_line import provenance
    from lab.light_tracker.options import DrogueOptions
    from lab.light_tracker.track import track_drogue

    options = DrogueOptions(near, every, min_diameter, max_diameter, rate, video, limit)
    with progress_bar(pictures.name) as progress:
        outcome = track_drogue(pictures, out, options, progress, provenance(ctx))
    conclude(outcome)
