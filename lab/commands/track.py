"""`beampose track`: related measurements that follow one target in the pictures of one camera."""

from __future__ import annotations

import click

from lab.commands.common import Commands
from lab.commands.track_point import point


@click.group(cls=Commands)
def track() -> None:
    """Follow one target in the pictures of one camera, without a rig.

    \b
    Example:
        beampose track point sample_runs/huo2015/frames/left --out results/point
    """


track.add_command(point)
