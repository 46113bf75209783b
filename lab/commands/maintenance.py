"""`beampose doctor` and `explain`: the installation, and what codes mean."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from lab.commands.common import ANY_PATH


@click.command()
@click.argument("files", metavar="[CALIBRATION]...", nargs=-1, type=ANY_PATH)
@click.option("--out", default=".", type=ANY_PATH, help="Where results will be written: its free space is checked.")
def doctor(files: tuple[Path, ...], out: Path) -> None:
    """Check the installation, the machine and calibration files: one line each, OK, WARN or FAIL, with a remedy.

    CALIBRATION: any number of rig.yaml, camera.yaml and screens.yaml files, or run folders, whose age and verdict are
    checked. Exit status: 0 without a FAIL; 1: the installation is faulty; 2: a file is wrong; 3: a calibration must
    not be used.

    \b
    Example:
        beampose doctor sample_runs/huo2015
    """
    from lab.doctor.doctor import examine
    from lab.doctor.lines import exit_status

    lines = examine(files, out)
    for line in lines:
        click.echo(str(line))
    sys.exit(exit_status(lines))


@click.command()
@click.argument("codes", metavar="[CODE]...", nargs=-1)
def explain(codes: tuple[str, ...]) -> None:
    """Explain the code of a warning, a verdict reason, a finding or an error; without a code, list all codes.

    The codes are in reports, in summary.json and in the lines of `beampose doctor`.

    \b
    Example:
        beampose explain BP-V03
    """
    from lab.explain import catalogue

    texts = [catalogue.explain(code) for code in codes] if codes else catalogue.listed()
    click.echo(("\n\n" if codes else "\n").join(texts))
