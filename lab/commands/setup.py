"""`beampose init`, `plan`, `simulate`: before anything is recorded; `schema`, `verify`, `doctor`, `explain`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from lab.commands.common import (
    ANY_PATH,
    FOLDER,
    ImageSize,
    NumberRange,
    carry_out,
    complete_codes,
    complete_scenarios,
    conclude,
    progress_bar,
    read_settings,
    seed_option,
    show_line,
)


@click.command()
@click.argument("files", metavar="[CALIBRATION]...", nargs=-1, type=ANY_PATH)
@click.option("--out", default=".", type=ANY_PATH, help="Where results will be written: its free space is checked.")
def doctor(files: tuple[Path, ...], out: Path) -> None:
    """Check the installation, the machine and calibration files: one line each, PASS, WARN or FAIL, with a remedy.

    CALIBRATION: any number of rig.yaml, camera.yaml and screens.yaml files, or run folders, whose age and verdict are
    checked. Exit status: 0 without a FAIL; 1: the installation is faulty; 2: a file is wrong; 3: a calibration must
    not be used.

    \b
    Example:
        beampose doctor sample_runs/huo2015
    """
    from lab.setup.doctor import examine
    from lab.setup.installation import exit_status, line_of

    findings = examine(files, out)
    for finding in findings:
        show_line(line_of(finding))
    sys.exit(exit_status(findings))


@click.command()
@click.argument("codes", metavar="[CODE]...", nargs=-1, shell_complete=complete_codes)
def explain(codes: tuple[str, ...]) -> None:
    """Explain the code of a warning, a verdict reason, a finding or an error; without a code, list all codes.

    The codes are in reports, in summary.json and in the lines of `beampose doctor`.

    \b
    Example:
        beampose explain BP-V03
    """
    from lab.findings import finding

    texts = [finding.explain(code) for code in codes] if codes else finding.listed()
    show_line(("\n\n" if codes else "\n").join(texts))


_FILES = ("rig", "run", "camera", "board", "calibration", "screens")
_QUESTIONS = {
    "screens": "How many screens are there",
    "cameras": "How many cameras film them, in all",
    "beams": "How many laser beams does the vehicle carry (lines, not spots)",
    "rate": "How many pictures per second",
}
_DEFAULTS = {"screens": 2, "cameras": 2, "beams": 3, "rate": 100.0}


def _on_a_terminal() -> bool:
    return sys.stdin.isatty() and sys.stdout.isatty()


def _asked(given: dict[str, float | None]) -> dict[str, float]:
    """The values that were not given: asked for on a terminal, else the default; a camera per screen at least."""
    ask = _on_a_terminal()
    out: dict[str, float] = {}
    for name in _QUESTIONS:
        value = given[name]
        default = max(_DEFAULTS[name], out["screens"]) if name == "cameras" else _DEFAULTS[name]
        if name == "beams" and out["screens"] != 2:
            default = 3 if out["screens"] == 1 else 4
        if value is None:
            value = click.prompt(_QUESTIONS[name], default=default, type=type(_DEFAULTS[name])) if ask else default
        out[name] = value
    return out


@click.command()
@click.argument("folder", metavar="DIR", type=FOLDER)
@click.option("--screens", type=click.IntRange(1, 4), help="Number of screens; default 2, left and right.")
@click.option(
    "--cameras", type=click.IntRange(1, 16), help="Number of cameras in all; default: one per screen, 2 or more."
)
@click.option("--beams", type=click.IntRange(1, 12), help="Number of laser beams; default 3, of one or two spots each.")
@click.option("--rate", type=NumberRange(0.1, 1e6), help="Pictures per second; default 100.")
@click.option("--distance", default=2.5, type=NumberRange(0.2, 100), help="From vehicle to screens, m.")
@click.option(
    "--picture",
    default="1280x1024",
    type=ImageSize(10),
    metavar="WxH",
    help="Picture size, width and height in pixels.",
)
@click.option(
    "--screen",
    "own_screens",
    multiple=True,
    metavar="NAME={...}",
    help="A screen as it was measured, once for each: 'wall={corner_m: [[0,0,0], [4,0,0], [0,0,3]]}'.",
)
@click.option(
    "--camera",
    "own_cameras",
    multiple=True,
    metavar="NAME={...}",
    help="A camera: 'left={screen: wall, look_at: {eye_m: [2,3,1], target_m: [2,0,1.5]}, field_of_view_deg: 60}'.",
)
@click.option(
    "--beam",
    "own_beams",
    multiple=True,
    metavar="NAME={...}",
    help="A beam: 'A={points_m: [[0,0,0], [1,0.1,0]], plus: wall}'; plus, minus: the screens that its ends meet.",
)
@click.option("--own", is_flag=True, help="Ask where the parts of your rig are, instead of a typical arrangement.")
def init(
    folder: Path,
    distance: float,
    picture: tuple[int, int],
    own: bool,
    own_screens: tuple[str, ...],
    own_cameras: tuple[str, ...],
    own_beams: tuple[str, ...],
    **given: float | None,
) -> None:
    """Write a commented rig.yaml and run.yaml to start from, with a drawing and simulated points to try them.

    On a terminal it asks for what is not given as an option. Without --screen, --camera, --beam and --own the rig is a
    typical one; replace the numbers by those of your lab. A part of your own rig is stated in any form of rig.yaml, and
    what was understood is printed and drawn (rig.html). The files pass `beampose check`.

    \b
    Example:
        beampose init my-lab --screens 2 --cameras 2 --beams 3 --rate 100
    """
    from lab.setup.init import Layout, start

    if own_screens or own_cameras or own_beams:
        from lab.setup.init import parts_of, rig_of_parts

        screens, cameras = parts_of(own_screens, "--screen"), parts_of(own_cameras, "--camera")
        rig = rig_of_parts(screens, cameras, parts_of(own_beams, "--beam"), picture)
        conclude(start(folder, rig, given["rate"] or _DEFAULTS["rate"]))
    if own and not _on_a_terminal():
        raise click.UsageError("--own asks questions, which need a terminal; state --screen, --camera and --beam")
    values = _asked(given)
    if own:
        from lab.setup.init import ask_parts, rig_of_parts

        def ask(question: str, default: str) -> str:
            return str(click.prompt(question, default=default or None, show_default=bool(default)))

        counts = (int(values[name]) for name in ("screens", "cameras", "beams"))
        conclude(start(folder, rig_of_parts(*ask_parts(ask, *counts), picture), values["rate"]))
    layout = Layout(int(values["cameras"]), int(values["screens"]), int(values["beams"]), distance, picture)
    conclude(start(folder, layout, values["rate"]))


@click.command()
@click.argument("results", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--run", "run_folder", type=FOLDER, help="The run folder, if it has moved.")
def verify(results: Path, run_folder: Path | None) -> None:
    """Compute a result again from its recorded inputs and parameters, and compare all tables byte by byte.

    Names each table that differs, with its first row and column, and each input that has changed. Exit status 0: all
    is the same; 4: something differs.

    \b
    Example:
        beampose verify results/huo2015
    """
    from lab.results.verify import verify as verify_results

    carry_out(results.name, lambda progress: verify_results(results, run_folder, progress))


@click.command()
@click.argument("name", metavar="[FILE]", required=False, type=click.Choice(_FILES))
@click.option("--out", type=FOLDER, help="Write FILE.schema.json there; without FILE, the schemas of all files.")
def schema(name: str | None, out: Path | None) -> None:
    """Export JSON schemas of the YAML files, with which editors complete and check them.

    FILE: rig, run, camera, board, calibration or screens. Editors with the YAML language server use a schema that the
    first line of a file names: `# yaml-language-server: $schema=schemas/rig.schema.json`.

    \b
    Example:
        beampose schema --out schemas
    """
    from lab.setup.schema import as_text, write

    if out is None and name is None:
        raise click.UsageError(f"expected a kind of file ({', '.join(_FILES)}) or --out FOLDER, got neither")
    if out is None:
        click.echo(as_text(str(name)), nl=False)
        return
    for path in write([name] if name else list(_FILES), out):
        show_line(f"schema: {path}")


# `beampose plan` and `simulate`: before anything is recorded.


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
    "--rate", "rate_hz", type=NumberRange(0.1, 1e6), help="Frames per second, instead of those of the scenario."
)
@click.option(
    "--exposure",
    "exposure_s",
    type=NumberRange(0, 10, min_open=True),
    help="Exposure time, s, instead of the scenario's.",
)
@click.pass_context
def simulate(ctx: click.Context, /, scenario: str, out: Path | None, start: Any, **options: Any) -> None:
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

        known = {name: options.pop(name) for name in ("seed", "frames", "noise_px", "points", "scale")}
        for parameter in ctx.command.params:
            if {"start": start, **options}.get(str(parameter.name)) not in (None, False):
                raise click.UsageError(f"{parameter.opts[0]}: scenario {STEREO} does not have this option.")
        folder = write_stereo_recording(out, **known)
        show_line(f"run: {folder}")
        return
    notes: list[str] = []
    with progress_bar(scenario) as progress:
        middle = None if start is None else Pose.from_ypr(np.deg2rad(start[3:]), np.array(start[:3]))
        folder = write_run(scenario, out, start=middle, progress=progress, note=notes.append, **options)
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
