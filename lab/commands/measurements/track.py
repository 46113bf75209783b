"""`beampose track`: one target through a video or a folder of pictures."""

from __future__ import annotations

from pathlib import Path

import click

from lab.commands.common import ANY_PATH, FOLDER, Commands, NumberRange, conclude, progress_bar
from lab.commands.measurements.track_drogue import drogue
from lab.commands.measurements.track_point import point

_PIXEL = NumberRange(-1e6, 1e6)


@click.group(cls=Commands)
def track() -> None:
    """Track one target through the pictures of one camera, without a rig.

    \b
    Example:
        beampose track circle drogue.avi --out results/drogue
    """


track.add_command(drogue)
track.add_command(point)


@track.command()
@click.argument("pictures", metavar="VIDEO_OR_FOLDER", type=ANY_PATH)
@click.option("--out", required=True, type=FOLDER, help="Gets circle.csv, summary.json and report.html.")
@click.option("--near", type=(_PIXEL, _PIXEL), metavar="U V", help="Centre of the first circle, px, within 20 px.")
@click.option(
    "--min-radius", default=7.0, show_default=True, type=NumberRange(4, 10_000), help="Smallest radius to look for, px."
)
@click.option("--max-radius", type=NumberRange(4, 10_000), help="Largest one; default: half of the smaller side.")
@click.option("--rate", type=NumberRange(0.01, 1e6), help="Frames per second; default: the video's, or 25.")
@click.option(
    "--form",
    default="sound",
    show_default=True,
    type=click.Choice(["sound", "printed"]),
    help="Equations: corrected with a fit of the rim, or as printed in Zhou (2014).",
)
@click.option(
    "--detector",
    default="classical",
    show_default=True,
    type=click.Choice(["classical", "learned"]),
    help="What proposes circles: votes of gradients, or a network that was trained on rendered drogues.",
)
@click.option("--limit", type=click.IntRange(min=1), help="Use at most this many pictures.")
@click.option("--video", is_flag=True, help="Also write overlay.avi: the pictures with the circle drawn into them.")
@click.pass_context
def circle(
    ctx: click.Context,
    pictures: Path,
    out: Path,
    near: tuple[float, float] | None,
    min_radius: float,
    max_radius: float | None,
    rate: float | None,
    form: str,
    detector: str,
    limit: int | None,
    video: bool,
) -> None:
    """Track a circle (the rim of a drogue, a ring, a disc): centre, radius, rates, sigmas and occlusion.

    The circle is found by itself in the first pictures. Where several circles fit equally well, none is chosen: state
    its place (--near) or its range of radii. Frames in which half of the target or more is hidden are predicted.

    \b
    Example:
        beampose track circle drogue.avi --out results/drogue --video
    """
    from lab.commands.command_line import provenance
    from lab.drogue_circle.options import CircleOptions
    from lab.drogue_circle.track import track_circle

    options = CircleOptions(near, min_radius, max_radius, rate, form, detector, video, limit)
    with progress_bar(pictures.name) as progress:
        outcome = track_circle(pictures, out, options, progress, provenance(ctx))
    conclude(outcome)
