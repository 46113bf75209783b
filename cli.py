"""The command line: the group `beampose` with the commands of lab/commands/."""

from __future__ import annotations

import click

from lab.commands import calibrate, results, run, setup, track
from lab.commands.common import Commands
from studies.command import study


@click.group(
    cls=Commands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100, "show_default": True},
)
@click.version_option(package_name="beampose")
def main() -> None:
    """Attitude and position of a vehicle model from pictures of its laser spots.

    Exit status: 0 all done; 1 some run could not be processed; 2 the command, a file or a configuration is wrong;
    3 the calibration is unusable; 4 processed, but a quality gate failed.
    """


for command in (
    run.run,
    run.batch,
    run.detect,
    run.pick,
    run.watch,
    run.record,
    setup.simulate,
    results.check,
    results.report,
    study,
    track.track,
    track.stereo,
    results.compare,
    results.export,
    results.view,
    results.show,
    calibrate.calibrate,
    calibrate.refine,
    setup.plan,
    setup.init,
    setup.schema,
    setup.verify,
    setup.doctor,
    setup.explain,
):
    main.add_command(command)
calibrate.calibrate.add_command(track.pair)

if __name__ == "__main__":
    main()
