"""`beampose check`, `report`, `compare`, `view` and `show`: inputs checked, results shown and compared."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lab.commands.common import ANY_PATH, FOLDER, NumberRange, carry_out, complain, conclude, progress_bar, show_line

# `beampose check` and `report`: inputs checked, results shown.


@click.command()
@click.argument("path", type=ANY_PATH)
def check(path: Path) -> None:
    """Check a rig.yaml or a run folder, and report which spots the cameras can see.

    \b
    Example:
        beampose check sample_runs/huo2015
    """
    from lab.runs.input_check import check as check_path

    carry_out(path.name, lambda progress: check_path(path, progress))


@click.command()
@click.argument("results", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--run", "run_folder", type=FOLDER, help="The run folder, if it has moved.")
@click.option("--video", is_flag=True, help="Also write overlay.mp4: all cameras with what was found drawn over them.")
@click.option("--from", "first", type=int, help="With --video: first frame number.")
@click.option("--to", "last", type=int, help="With --video: last frame number.")
@click.option("--every", type=click.IntRange(min=1), help="With --video: only each so many frames.")
@click.option("--fps", type=NumberRange(1, 240), help="With --video: its frames per second; default: 25.")
@click.option(
    "--certificate", is_flag=True, help="Also write certificate.html: the uncertainty in the form of the GUM."
)
@click.option(
    "--at", type=int, multiple=True, help="With --certificate: a frame number; repeatable. Default: a usual one."
)
def report(
    results: Path, run_folder: Path | None, video: bool, certificate: bool, at: tuple[int, ...], **shown: Any
) -> None:
    """Write report.html of a result folder again, with --video also a video of its pictures.

    With --certificate also the uncertainty budget of attitude and position at chosen frames and over the recording:
    sources, sensitivities, degrees of freedom, expanded uncertainty, traceability, and a Monte Carlo that checks it.

    \b
    Example:
        beampose report results/huo2015
        beampose report results/huo2015 --video --from 0 --to 30
        beampose report results/huo2015 --certificate --at 100
    """
    if at and not certificate:
        raise click.UsageError("--at is of the certificate; add --certificate")
    given = {name: value for name, value in shown.items() if value is not None}
    if not video and given:
        raise click.UsageError("--from, --to, --every and --fps are of the video; add --video")
    from lab.files.run.results import ResultFolder
    from lab.report.run.page import write_report

    ResultFolder.of_run(results)
    show_line(f"report: {write_report(results, run_folder)}")
    if certificate:
        from lab.results.certificate import write_certificate

        for line in write_certificate(results, run_folder, at).lines:
            show_line(line)
    if video:
        from lab.results.show import write_video

        carry_out(results.name, lambda progress: write_video(results, run_folder, progress=progress, **given))


# `beampose compare`: a result against another result of the run, or against a reference.


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
def compare(result: Path, other: Path | None, reference: Path | None, out: Path | None, **options: Any) -> None:
    """Compare a result with another one, or with a reference.

    The time offset, the clock rate and the frames of the reference are estimated. What the motion does not determine is
    reported as such.

    \b
    Example:
        beampose compare results/huo2015 --reference sample_runs/huo2015/truth/pose.csv --out results/compared
    """
    from lab.results.compare_page import compare_and_write

    conclude(compare_and_write(result, other, reference, out, **options))


# `beampose export`: the motion in the files of other programs.


_FORMATS = ("tum", "mcap", "rosbag2", "c3d", "hdf5", "parquet")  # as in lab.results.export, which imports more


@click.command()
@click.argument("results", type=_RESULTS)
@click.option("--to", required=True, type=click.Choice(_FORMATS), help="The format.")
@click.option("--out", type=ANY_PATH, help="The file, or the folder of a rosbag2; default: the name of the results.")
@click.option("--causal", is_flag=True, help="The poses as known at each instant, in place of the smoothed ones.")
def export(results: Path, to: str, out: Path | None, causal: bool) -> None:
    """Write the motion of a result in a format of other programs.

    Times, poses as world_from_body and, as far as the format has places for them, statuses, sigmas and covariances.
    Units and conventions are written into the file. Formats other than tum need a package of their own: pip install
    'beampose[FORMAT]'.

    \b
    Example:
        beampose export results/huo2015 --to tum --out results/huo2015.tum
    """
    from lab.results.export import export as export_motion

    conclude(export_motion(results, to, out, causal=causal))


# `beampose view`: a rig, a run or results in three dimensions.


@click.command()
@click.argument("path", type=ANY_PATH)
@click.option("--out", type=FOLDER, help="Write the files here and open no browser; default: results/view.")
@click.option("--frame", type=int, help="Frame number of the beams and spots; default: the middle one.")
@click.option("--rig", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="Instead of the run's rig.")
@click.option(
    "--sigma-scale",
    type=NumberRange(min=0, max=1e9, min_open=True),
    help="Size of the sigma ellipsoids; default: a round number that makes them visible.",
)
def view(path: Path, out: Path | None, frame: int | None, rig: Path | None, sigma_scale: float | None) -> None:
    """Show a rig.yaml, a run folder or results in three dimensions.

    Screens, cameras with their fields of view, beams, spots and the trajectory with sigma ellipsoids. Writes view.html
    to turn and play in a browser, which opens where there is a display, and scene.glb for other programs.

    \b
    Example:
        beampose view sample_runs/huo2015 --out results/view
    """
    from lab.results.view.page import show

    conclude(show(path, out, frame=frame, rig=rig, sigma_scale=sigma_scale))


# `beampose show`: one annotated picture.


@click.command()
@click.argument("path", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--frame", required=True, type=int, help="Frame number.")
@click.option("--camera", help="Only this camera; default: all, side by side.")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="A .png file; default: frame-N.png.")
@click.option("--run", "run_folder", type=FOLDER, help="The run folder of the results, if it has moved.")
def show(path: Path, frame: int, camera: str | None, out: Path | None, run_folder: Path | None) -> None:
    """Draw what was found in one frame over its pictures.

    PATH is a folder of results; or a run folder, whose frames up to this one are then processed first. The picture
    shows detections, labelled spots with their status, predictions, and for each spot that is not measured where it
    can lie: along the uncertainty of the pose, and along the image of its beam.

    \b
    Example:
        beampose show results/huo2015 --frame 11 --out results/frame-11.png
    """
    from lab.results.show import show_frame, write_picture

    with progress_bar(path.name) as progress:
        shown = show_frame(path, frame, camera=camera, run_folder=run_folder, progress=progress)
    file = out or Path(f"frame-{frame}.png")
    write_picture(shown.image, file)
    show_line(f"picture: {file}")
    for note in shown.notes:
        complain(note)
