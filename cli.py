"""The command line: reads arguments, calls one function of lab/, prints a line. All of it can be done from Python."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from lab.errors import BeamposeError, InputError

_FOLDER = click.Path(file_okay=False, path_type=Path)
_ANY_PATH = click.Path(path_type=Path)


class _Commands(click.Group):
    """Turns the lab's own exceptions and click's into a plain line or two and an exit status, in one place."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        try:
            sys.exit(super().main(*args, **{**kwargs, "standalone_mode": False}))
        except click.exceptions.NoArgsIsHelpError as error:
            error.show()
            sys.exit(error.exit_code)
        except click.UsageError as error:
            click.echo(f"beampose: {error.format_message()}", err=True)
            if error.ctx:
                click.echo(f"Help: {error.ctx.command_path} --help", err=True)
            sys.exit(error.exit_code)
        except click.Abort:
            click.echo("beampose: stopped", err=True)
            sys.exit(1)

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except BeamposeError as error:
            click.echo(f"beampose: {error}", err=True)
            sys.exit(error.exit_status)
        except MemoryError:
            click.echo("beampose: out of memory", err=True)
            sys.exit(1)
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            click.echo(f"beampose: {where}{error.strerror or error}", err=True)
            sys.exit(1)


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="beampose")
def main() -> None:
    """Attitude and position of a vehicle model from the pictures of its laser spots.

    Exit status: 0 all done; 1 some run could not be processed; 2 the command, a file or a configuration is wrong;
    3 the calibration is unusable; 4 processed, but a quality gate failed.
    """


def _settings(ctx: click.Context, parameter: click.Parameter, values: Sequence[str]) -> dict[str, Any]:
    """--set name=value, the value read as YAML."""
    import yaml

    out: dict[str, Any] = {}
    for text in values:
        name, equals, value = text.partition("=")
        if not equals or not name.strip():
            raise click.BadParameter(f"expected NAME=VALUE, got {text!r}", ctx=ctx, param=parameter)
        try:
            out[name.strip()] = yaml.safe_load(value)
        except yaml.YAMLError:
            raise click.BadParameter(f"{name}: cannot read the value {value!r}", ctx=ctx, param=parameter) from None
    return out


_set_option = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="NAME=VALUE",
    callback=_settings,
    help="A tracker parameter in place of run.yaml's, e.g. --set r1_px=12 or --set detect.threshold_sigma=5.",
)


@contextmanager
def _progress(name: str) -> Iterator[Callable[[int, int | None], None] | None]:
    """A bar on a terminal, nothing elsewhere."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    parts = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*parts, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@main.command()
@click.argument("run_folder", metavar="RUN", type=_ANY_PATH)
@click.option("--out", required=True, type=_FOLDER, help="Where the results go; earlier results there are replaced.")
@_set_option
def run(run_folder: Path, out: Path, settings: dict[str, Any]) -> None:
    """Process one run folder: tables, summary.json and report.html.

    \b
    Example:
        beampose run sample_runs/huo2015 --out results/huo2015
    """
    from lab.process import process_run

    with _progress(run_folder.name) as progress:
        outcome = process_run(run_folder, out, overrides=settings, progress=progress)
    click.echo(outcome.line())
    sys.exit(outcome.exit_status)


@main.command()
@click.argument("run_folders", metavar="RUN...", nargs=-1, required=True, type=_ANY_PATH)
@click.option("--out", required=True, type=_FOLDER, help="Gets one folder per run, batch.csv and index.html.")
@_set_option
def batch(run_folders: tuple[Path, ...], out: Path, settings: dict[str, Any]) -> None:
    """Process many run folders; one that fails costs only itself.

    \b
    Example:
        beampose batch sample_runs/huo2015 sample_runs/damaged --out results/all
    """
    from lab.batch import process_batch

    outcome = process_batch(run_folders, out, overrides=settings, tell=click.echo)
    click.echo(f"table: {outcome.table}")
    click.echo(f"index: {outcome.index}")
    sys.exit(outcome.exit_status)


@main.command()
@click.argument("scenario")
@click.option("--out", type=_FOLDER, help="The run folder to write; it must not exist yet.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="The same seed, the same bytes.")
@click.option("--frames", type=click.IntRange(min=1), help="How many; default: the scenario's own number.")
@click.option("--video", is_flag=True, help="One lossless video per camera in place of PNG files.")
@click.option("--points", is_flag=True, help="No pictures: a detections.csv with --noise-px.")
@click.option(
    "--noise-px", default=0.1, show_default=True, type=click.FloatRange(min=0), help="With --points: 1 sigma."
)
@click.option("--clutter", type=click.FloatRange(0, 1), help="Probability of a false spot near each spot.")
@click.option("--light", help="A preset of light and sensor in place of the scenario's.")
@click.option(
    "--scale", default=1.0, show_default=True, type=click.FloatRange(0.1, 1), help="0.5: pictures half as wide."
)
def simulate(
    scenario: str,
    out: Path | None,
    seed: int,
    frames: int | None,
    video: bool,
    points: bool,
    noise_px: float,
    clutter: float | None,
    light: str | None,
    scale: float,
) -> None:
    """Write a simulated recording with its truth; SCENARIO `list` names them all.

    \b
    Example:
        beampose simulate sharp-turns --frames 50 --out runs/sharp-turns
    """
    from lab.simulate.scenarios import LIGHTS, SCENARIOS
    from lab.simulate.write import simulate as write_run

    if scenario == "list":
        for one in SCENARIOS.values():
            click.echo(f"{one.name:24s}{one.summary}")
        click.echo(f"{'lights:':24s}{', '.join(LIGHTS)}")
        return
    if out is None:
        raise click.UsageError("Missing option '--out'.")
    with _progress(scenario) as progress:
        folder = write_run(
            scenario,
            out,
            seed=seed,
            frames=frames,
            video=video,
            detections_only=points,
            light=light,
            clutter=clutter,
            noise_px=noise_px,
            picture_scale=scale,
            progress=None if progress is None else lambda done, total: progress(done, total),
        )
    click.echo(f"run: {folder}")


@main.command()
@click.argument("path", type=_ANY_PATH)
def check(path: Path) -> None:
    """Check a rig.yaml or a run folder, and say what the rig can see.

    \b
    Example:
        beampose check sample_runs/huo2015
    """
    from lab.check import check as check_path

    result = check_path(path)
    for line in result.lines:
        click.echo(line)
    sys.exit(result.exit_status)


@main.command()
@click.argument("results", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--run", "run_folder", type=_FOLDER, help="The run folder, where it has moved since.")
def report(results: Path, run_folder: Path | None) -> None:
    """Make report.html of a result folder anew.

    \b
    Example:
        beampose report results/huo2015
    """
    from lab.process import are_results
    from lab.report import write_report

    if not are_results(results):
        raise InputError(f"{results}: expected a folder that `beampose run` wrote, found no summary.json of one")
    click.echo(f"report: {write_report(results, run_folder)}")


@main.command()
@click.argument("name", type=click.Choice(["huo2015"]))
@click.option("--out", required=True, type=_FOLDER, help="Gets report.html, figures.csv and the run.")
@click.option("--seed", default=1, show_default=True, type=click.IntRange(min=0))
def study(name: str, out: Path, seed: int) -> None:
    """Repeat a published experiment beside its printed figures.

    \b
    Example:
        beampose study huo2015 --out results/study
    """
    from lab.studies import study_huo2015

    outcome = study_huo2015(out, seed=seed)
    for line in outcome.lines:
        click.echo(line)
    click.echo(f"table: {outcome.table}")
    click.echo(f"report: {outcome.report}")


if __name__ == "__main__":
    main()
