"""`beampose study`: published experiments repeated, their figures beside ours."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import click

from lab.commands.common import FOLDER, conclude

STUDIES = "huo2015", "zhou2014", "fu2016", "duan2020", "zhou2020"


@click.command()
@click.argument("name", type=click.Choice(STUDIES))
@click.option("--out", required=True, type=FOLDER, help="Gets report.html and figures.csv.")
@click.option("--seed", default=1, type=click.IntRange(min=0))
def study(name: str, out: Path, seed: int) -> None:
    """Repeat a published experiment and compare with its printed figures.

    \b
    Example:
        beampose study huo2015 --out results/study
    """
    from studies.comparison import write_comparison

    # From a seed to the table and the figures; other studies need other libraries.
    compare = getattr(import_module(f"studies.{name}"), f"compare_{name}")
    conclude(write_comparison(compare(seed), out))
