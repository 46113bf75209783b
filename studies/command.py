"""`beampose study`: published experiments repeated, their figures beside ours."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from lab.commands.common import FOLDER, conclude

if TYPE_CHECKING:
    from studies.comparison import Comparison


def _huo2015(seed: int) -> Comparison:
    from studies.huo2015 import compare_huo2015

    return compare_huo2015(seed)


def _fu2016(seed: int) -> Comparison:
    from studies.fu2016 import compare_fu2016

    return compare_fu2016(seed)


def _duan2020(seed: int) -> Comparison:
    from studies.duan2020 import compare_duan2020

    return compare_duan2020(seed)


def _zhou2020(seed: int) -> Comparison:
    from studies.zhou2020 import compare_zhou2020

    return compare_zhou2020(seed)


def _zhou2014(seed: int) -> Comparison:
    from studies.zhou2014 import compare_zhou2014

    return compare_zhou2014(seed)


STUDIES: dict[str, Callable[[int], Comparison]] = {  # name: seed -> table and figures
    "huo2015": _huo2015,
    "zhou2014": _zhou2014,
    "fu2016": _fu2016,
    "duan2020": _duan2020,
    "zhou2020": _zhou2020,
}


@click.command()
@click.argument("name", type=click.Choice(list(STUDIES)))
@click.option("--out", required=True, type=FOLDER, help="Gets report.html and figures.csv.")
@click.option("--seed", default=1, type=click.IntRange(min=0))
def study(name: str, out: Path, seed: int) -> None:
    """Repeat a published experiment and compare with its printed figures.

    \b
    Example:
        beampose study huo2015 --out results/study
    """
    from studies.comparison import write_comparison

    conclude(write_comparison(STUDIES[name](seed), out))
