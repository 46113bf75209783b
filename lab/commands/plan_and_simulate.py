"""`beampose plan` and `simulate`: before anything is recorded."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from lab.commands.common import (
    ANY_PATH,
    FOLDER,
    NumberRange,
    complete_scenarios,
    conclude,
    progress_bar,
    read_settings,
    seed_option,
    show_line,
)


def _six_numbers(ctx: click.Context, parameter: click.Parameter, text: str | None) -> tuple[float, ...] | None:
    """x, y, z (m), yaw, pitch, roll (deg), separated by commas."""
    if text is None:
        return None
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 6 or not all(abs(number) < 1e6 for number in numbers):
        raise click.BadParameter(
            f"expected six numbers X,Y,Z,YAW,PITCH,ROLL (m and deg), got {text!r}", ctx=ctx, param=parameter
        )
    return numbers


@click.command()
@click.argument("scenario", shell_complete=complete_scenarios)
@click.option("--out", type=FOLDER, help="The run folder to write; it must not exist yet.")
@seed_option
@click.option("--frames", type=click.IntRange(min=1), help="Number of frames; default: that of the scenario.")
@click.option("--video", is_flag=True, help="One lossless video per camera instead of PNG files.")
@click.option("--points", is_flag=True, help="No pictures: a detections.csv with noise of --noise-px.")
@click.option("--noise-px", default=0.1, type=NumberRange(0, 1000), help="With --points: noise of a spot, 1 sigma.")
@click.option("--clutter", type=NumberRange(0, 1), help="Probability of a false spot near each spot.")
@click.option("--light", help="A preset of light and sensor instead of the scenario's.")
@click.option("--scale", default=1.0, type=NumberRange(0.1, 1), help="0.5: pictures half as wide.")
@click.option(
    "--rig", type=ANY_PATH, help="A rig.yaml with the true rig; the motion goes to where it sees the vehicle."
)
@click.option(
    "--known-rig", type=ANY_PATH, help="The rig.yaml for the run folder, such as a calibration of the true rig."
)
@click.option("--start", callback=_six_numbers, help="Middle of the motion: X,Y,Z,YAW,PITCH,ROLL, m and deg.")
@click.option("--trajectory", type=ANY_PATH, help="A table of poses, as truth/pose.csv, instead of the motion.")
@click.option(
    "--rate", "frame_rate_hz", type=NumberRange(0.1, 1e6), help="Frames per second, instead of those of the scenario."
)
@click.option(
    "--exposure",
    "exposure_s",
    type=NumberRange(0, 10, min_open=True),
    help="Exposure time, s, instead of the scenario's.",
)
@click.pass_context
def simulate(
    ctx: click.Context, /, scenario: str, out: Path | None, points: bool, scale: float, start: Any, **options: Any
) -> None:
    """Write a simulated recording with its truth; SCENARIO `list` lists all scenarios.

    \b
    Example:
        beampose simulate sharp-turns --frames 50 --out runs/sharp-turns
    """
    import numpy as np

    from geometry.pose import Pose
    from lab.simulate.scenarios import LIGHTS, SCENARIOS
    from lab.simulate.write import simulate as write_run
    from lab.targets.stereo.simulated_recording import SCENARIO as STEREO
    from lab.targets.stereo.simulated_recording import SUMMARY as STEREO_SUMMARY

    if scenario == "list":
        for listed in SCENARIOS.values():
            show_line(f"{listed.name:24s}{listed.summary}")
        show_line(f"{STEREO:24s}{STEREO_SUMMARY}")
        show_line(f"{'lights:':24s}{', '.join(LIGHTS)}")
        return
    if out is None:
        raise click.UsageError("Missing option '--out'.")
    if scenario == STEREO:
        from lab.targets.stereo.simulated_recording import write_stereo_recording

        known = {name: options.pop(name) for name in ("seed", "frames", "noise_px")}
        for parameter in ctx.command.params:
            if {"start": start, **options}.get(str(parameter.name)) not in (None, False):
                raise click.UsageError(f"{parameter.opts[0]}: scenario {STEREO} does not have this option.")
        folder = write_stereo_recording(out, points=points, scale=scale, **known)
        show_line(f"run: {folder}")
        return
    notes: list[str] = []
    with progress_bar(scenario) as progress:
        folder = write_run(
            scenario,
            out,
            detections_only=points,
            picture_scale=scale,
            start=None if start is None else Pose.from_ypr(np.deg2rad(start[3:]), np.array(start[:3])),
            progress=progress,
            note=notes.append,
            **options,
        )
    for line in notes:
        show_line(line)
    show_line(f"run: {folder}")


def _ranges(
    ctx: click.Context, parameter: click.Parameter, values: Sequence[str]
) -> dict[str, tuple[float, float, int]]:
    """--range name=first:last:count."""
    out: dict[str, tuple[float, float, int]] = {}
    for text in values:
        name, _, value = text.partition("=")
        try:
            first, last, count = value.split(":")
            out[name.strip()] = float(first), float(last), int(count)
        except ValueError:
            raise click.BadParameter(
                f"expected NAME=FIRST:LAST:COUNT, got {text!r}", ctx=ctx, param=parameter
            ) from None
    return out


@click.command()
@click.argument("rig", type=ANY_PATH)
@click.option("--out", required=True, type=FOLDER, help="Gets plan.csv, effects.csv and report.html.")
@click.option(
    "--range",
    "ranges",
    multiple=True,
    metavar="NAME=FIRST:LAST:COUNT",
    callback=_ranges,
    help="Of x_m, y_m, z_m, yaw_deg, pitch_deg, roll_deg; e.g. --range yaw_deg=-30:30:13.",
)
@click.option("--sigma-px", type=NumberRange(min=0, min_open=True), help="Noise of a spot, 1 sigma.")
@click.option("--goal-deg", type=NumberRange(min=0, min_open=True), help="The attitude sigma to reach.")
@click.option("--goal-mm", type=NumberRange(min=0, min_open=True), help="The position sigma to reach.")
@click.option(
    "--expect",
    "expected",
    multiple=True,
    metavar="NAME=VALUE",
    callback=read_settings,
    help="An expected calibration sigma, where the rig file has none; e.g. --expect beam_direction_arcsec=10.",
)
def plan(
    rig: Path,
    out: Path,
    ranges: dict[str, tuple[float, float, int]],
    goal_mm: float | None,
    **options: Any,
) -> None:
    """Predict which spots a planned rig will see, and how well it will measure.

    \b
    Example:
        beampose plan sample_runs/huo2015/rig.yaml --out results/plan
    """
    from lab.setup.plan import plan_rig
    from lab.setup.plan_findings import options_of

    goal_m = None if goal_mm is None else goal_mm / 1000
    conclude(plan_rig(rig, out, options_of(ranges, goal_m=goal_m, **options)))
