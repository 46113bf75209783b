"""`beampose compare`: a result against another result of the run, or against a reference."""

from __future__ import annotations

from pathlib import Path

import click

from lab.commands.common import FOLDER, NumberRange, show_line

_RESULTS = click.Path(exists=True, file_okay=False, path_type=Path)
_WAYS = ("time", "rate", "world", "body")


def _read_align(ctx: click.Context, parameter: click.Parameter, value: str | None) -> tuple[str, ...] | None:
    """all, none, or names separated by commas; None where the option is not given."""
    if value is None:
        return None
    if value in ("all", "none"):
        return _WAYS if value == "all" else ()
    names = tuple(name.strip() for name in value.split(","))
    for name in names:
        if name not in _WAYS:
            raise click.BadParameter(f"expected all, none or some of {','.join(_WAYS)}, got {name!r}", ctx, parameter)
    if "rate" in names and "time" not in names:
        raise click.BadParameter("rate needs time too: write time,rate", ctx, parameter)
    return names


@click.command()
@click.argument("result", metavar="OUT", type=_RESULTS)
@click.argument("other", metavar="[OTHER]", required=False, type=_RESULTS)
@click.option(
    "--reference",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="A CSV table (t_s with qw,qx,qy,qz or yaw_deg,pitch_deg,roll_deg and x_m,y_m,z_m) or a TUM file.",
)
@click.option("--out", type=FOLDER, help="Gets report.html, differences.csv, allan.csv and comparison.json.")
@click.option(
    "--align",
    metavar="WHAT",
    callback=_read_align,
    help="all, none, or some of time,rate,world,body. Default: all for a reference, none for two results.",
)
@click.option(
    "--offset", "offset_s", type=NumberRange(-1e12, 1e12), help="Reference time minus result time in s, approximately."
)
@click.option(
    "--sigma-m", type=NumberRange(0, 1e6), default=0.0, help="Sigma of the reference's positions, if it has none."
)
@click.option(
    "--sigma-deg", type=NumberRange(0, 1e6), default=0.0, help="Sigma of the reference's angles, if it has none."
)
def compare(
    result: Path,
    other: Path | None,
    reference: Path | None,
    out: Path | None,
    align: tuple[str, ...] | None,
    offset_s: float | None,
    sigma_m: float,
    sigma_deg: float,
) -> None:
    """Compare a result with another one, or with a reference.

    The time offset, the clock rate and the frames of the reference are estimated. What the motion does not determine is
    reported as such.

    \b
    Example:
        beampose compare results/huo2015 --reference sample_runs/huo2015/truth/pose.csv --out results/compared
    """
    from lab.compare.write import compare_and_write

    outcome = compare_and_write(
        result, other, reference, out, align=align, offset_s=offset_s, sigma_m=sigma_m, sigma_deg=sigma_deg
    )
    for line in outcome.lines:
        show_line(line)
    if outcome.report is not None:
        show_line(f"report: {outcome.report}")
