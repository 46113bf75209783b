"""`beampose check` and `report`: inputs checked, results shown."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from lab.commands.common import ANY_PATH, FOLDER, progress_bar, show_line
from lab.errors import InputError


@click.command()
@click.argument("path", type=ANY_PATH)
def check(path: Path) -> None:
    """Check a rig.yaml or a run folder, and report which spots the cameras can see.

    \b
    Example:
        beampose check sample_runs/huo2015
    """
    from lab.runs.input_check.check import check as check_path

    with progress_bar(path.name) as progress:
        result = check_path(path, progress)
    for line in result.lines:
        show_line(line)
    sys.exit(result.exit_status)


@click.command()
@click.argument("results", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--run", "run_folder", type=FOLDER, help="The run folder, if it has moved.")
def report(results: Path, run_folder: Path | None) -> None:
    """Write report.html of a result folder again.

    \b
    Example:
        beampose report results/huo2015
    """
    from lab.report.run.page import write_report
    from lab.runs.process import are_results

    if not are_results(results):
        raise InputError(f"{results}: expected a folder that `beampose run` wrote, found no summary.json of one")
    show_line(f"report: {write_report(results, run_folder)}")
